"""What the engine is measured against: the usual program for this job, written as fast as numba allows.

Fixed-step RK4 on every cell, no event located: contact is a test on the position at each stage, an impact a sample
inside the wall after one outside. Cells go in blocks whose inner loop the compiler turns into vector instructions,
blocks go to threads, and all cells share one table of the forcing, since all start at the same phase.
"""

import math

import numba
import numpy as np

BLOCK = 16  # cells that advance together: two AVX-512 registers, and still in L1


def rk4_impacts_per_period(d, kappa, r: float, u0: float, v0: float, periods: int, steps: int) -> np.ndarray:
    """Impacts per forcing period of each cell, as `rk4` counts them.

    Args:
        d: gap, [N].
        kappa: stiffness ratio of the soft walls, [N].
        r: effective coefficient of restitution, one for all cells; gamma is 0.
        u0: displacement at t = 0.
        v0: velocity at t = 0.
        periods: forcing periods (of length 2) to run.
        steps: RK4 steps per period.

    Returns:
        Impacts per period, float64 [N].
    """
    return rk4(d, kappa, r, u0, v0, periods, steps)[0]


def rk4(d, kappa, r: float, u0: float, v0: float, periods: int, steps: int) -> tuple[np.ndarray, ...]:
    """Impacts per period, final displacement and final velocity, each [N]; Args of `rk4_impacts_per_period`."""
    d, kappa = np.broadcast_arrays(np.asarray(d, dtype=float), np.asarray(kappa, dtype=float))
    padding = -d.size % BLOCK
    d_padded, kappa_padded = (np.pad(x, (0, padding), mode="edge") for x in (d, kappa))
    damping = -2 * math.log(r) / math.hypot(math.pi, math.log(r))  # mu / kappa, Eq. (19)
    forcing = np.cos(np.pi * np.arange(2 * steps + 1) / steps)  # at the ends and middles of one period's steps
    impacts, u, v = (np.empty(d_padded.size) for _ in range(3))
    _march(d_padded / 2, kappa_padded**2, damping * kappa_padded, u0, v0, periods, steps, forcing, impacts, u, v)
    return impacts[: d.size] / periods, u[: d.size], v[: d.size]


@numba.njit(parallel=True, fastmath=True)
def _march(half_gap, stiffness, damping, u0, v0, periods, steps, forcing, impacts_out, u_out, v_out):
    h = 2.0 / steps
    for block in numba.prange(half_gap.size // BLOCK):
        first, last = block * BLOCK, (block + 1) * BLOCK
        # Private copies: through the shared arrays the compiler must fear aliases and leaves the inner loop scalar.
        gap, stiff, damp = half_gap[first:last].copy(), stiffness[first:last].copy(), damping[first:last].copy()
        u, v, impacts, inside = np.full(BLOCK, u0), np.full(BLOCK, v0), np.zeros(BLOCK), np.zeros(BLOCK)
        for _ in range(periods):
            for step in range(steps):
                start, middle, end = forcing[2 * step], forcing[2 * step + 1], forcing[2 * step + 2]
                for j in range(BLOCK):
                    u1, v1, D, K, M = u[j], v[j], gap[j], stiff[j], damp[j]
                    w = u1 - min(max(u1, -D), D)
                    a1 = start - K * w - (M * v1 if w != 0 else 0.0)
                    u2, v2 = u1 + 0.5 * h * v1, v1 + 0.5 * h * a1
                    w = u2 - min(max(u2, -D), D)
                    a2 = middle - K * w - (M * v2 if w != 0 else 0.0)
                    u3, v3 = u1 + 0.5 * h * v2, v1 + 0.5 * h * a2
                    w = u3 - min(max(u3, -D), D)
                    a3 = middle - K * w - (M * v3 if w != 0 else 0.0)
                    u4, v4 = u1 + h * v3, v1 + h * a3
                    w = u4 - min(max(u4, -D), D)
                    a4 = end - K * w - (M * v4 if w != 0 else 0.0)
                    u_next = u1 + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
                    v_next = v1 + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
                    now = 1.0 if abs(u_next) > D else 0.0
                    impacts[j] += now * (1.0 - inside[j])
                    inside[j], u[j], v[j] = now, u_next, v_next
        impacts_out[first:last] = impacts
        u_out[first:last] = u
        v_out[first:last] = v
