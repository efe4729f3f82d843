"""Peers of the engines: common programs for this task, each as its users would write it.

`rk4`: fixed steps on every cell, no event located. Contact is a test on the position at each stage, an impact a sample
inside the wall after one outside. As fast as numba allows: the inner loop over a block of cells becomes vector
instructions, blocks run in threads, and all cells share one table of the forcing, as all start at one phase.

`dormand_prince`: Dormand and Prince's adaptive pair in numba, events located by repeating the step up to them.

`scipy_events`, `diffrax_chain`: a solver's own terminal events, and a restart after each.

All start and end at phase 0, some periods apart. Only those with located events support rigid walls (kappa None).
"""

import math
from functools import lru_cache
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numba
import numpy as np
import optimistix
from scipy.integrate import solve_ivp

LONGEST = 0.25  # longest adaptive step in flight; an entry and an exit within one step may be missed
ATOL = 1e-2  # absolute tolerance relative to rtol
BLOCK = 16  # cells that advance together: two AVX-512 registers, and still in L1 cache


def _damping(r: float) -> float:
    """Compute mu / kappa, Eq. (19)."""
    return -2 * math.log(r) / math.hypot(math.pi, math.log(r))


def rk4_impacts_per_period(d, kappa, r: float, u0: float, v0: float, periods: int, steps: int) -> np.ndarray:
    """Count impacts per forcing period of each cell, as `rk4` does.

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


def rk4(
    d, kappa, r: float, u0, v0, periods: int, steps: int, gamma: float = 0.0, shaken=lambda t: np.cos(np.pi * t)
) -> tuple[np.ndarray, ...]:
    """Return impacts per period, final displacement and final velocity, each [N].

    The arguments are as in `rk4_impacts_per_period`, but u0 and v0 may differ from cell to cell, gamma is free, and
    `shaken` may be any forcing that repeats every period, as a function of times in [0, 2].
    """
    d, kappa, u0, v0 = np.broadcast_arrays(*(np.asarray(x, dtype=float) for x in (d, kappa, u0, v0)))
    padding = -d.size % BLOCK
    d_padded, kappa_padded, u, v = (np.pad(x, (0, padding), mode="edge") for x in (d, kappa, u0, v0))
    forcing = shaken(np.arange(2 * steps + 1) / steps) - gamma  # at the ends and middles of one period's steps
    impacts = np.empty(d_padded.size)
    _march(d_padded / 2, kappa_padded**2, _damping(r) * kappa_padded, periods, steps, forcing, impacts, u, v)
    return impacts[: d.size] / periods, u[: d.size], v[: d.size]


@numba.njit(parallel=True, fastmath=True)
def _march(half_gap, stiffness, damping, periods, steps, forcing, impacts_out, u_inout, v_inout):
    h = 2.0 / steps
    for block in numba.prange(half_gap.size // BLOCK):
        first, last = block * BLOCK, (block + 1) * BLOCK
        # Private copies: with the shared arrays the compiler must assume aliases, and does not vectorise the inner
        # loop.
        gap, stiff, damp = half_gap[first:last].copy(), stiffness[first:last].copy(), damping[first:last].copy()
        u, v = u_inout[first:last].copy(), v_inout[first:last].copy()
        impacts, inside = np.zeros(BLOCK), np.zeros(BLOCK)
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
        u_inout[first:last] = u
        v_inout[first:last] = v


# --- located events in numba ----------------------------------------------------------------------

# The Dormand-Prince pair: stages, their nodes, and the difference to the embedded fourth order.
_A = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
_C = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1, 1])
_E = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])

_PROBES = 4  # points of a step at which its cubic interpolant is compared with the wall
_ROOT_ITERATIONS = 40  # iterations of Newton's method or bisection, each a repeated step
_CLOSED = 4e-16  # distance to the wall that counts as zero
_STEPS_PER_PERIOD = 1_000_000  # a run that needs more steps has failed


def dormand_prince(d, kappa, r: float, gamma: float, u0, v0, periods: int, rtol: float) -> tuple[np.ndarray, ...]:
    """Return the final displacement and velocity of every cell, by an adaptive pair of order 5 with located events.

    Args:
        d: gap, [N].
        kappa: stiffness ratio, [N] or one for all; None for rigid walls.
        r: coefficient of restitution, one for all.
        gamma: gravity along the capsule, one for all.
        u0, v0: starts in the gap, [N] or one for all.
        periods: forcing periods to run.
        rtol: tolerance relative to displacement and velocity; the absolute one is a hundredth.

    Returns:
        Displacement and velocity, float64 [N]; NaN for a cell with too many steps.
    """
    stiff = 0.0 if kappa is None else kappa
    d, u0, v0, stiff = np.broadcast_arrays(*(np.asarray(x, dtype=float) for x in (d, u0, v0, stiff)))
    u, v = u0.copy(), v0.copy()
    _chain(d / 2, stiff**2, stiff * _damping(r), r, gamma, 2.0 * periods, rtol, u, v)
    return u, v


@numba.njit
def _dormand_prince_step(t, u, v, h, side, half, stiffness, damping, gamma, speeds, pushes):
    """Return displacement and velocity after a step, and their error; side 0 is flight."""
    in_contact = abs(side)
    u_new, v_new = u, v
    for i in range(7):
        u_new, v_new = u, v
        for j in range(i):
            u_new += h * _A[i, j] * speeds[j]
            v_new += h * _A[i, j] * pushes[j]
        speeds[i] = v_new
        pushes[i] = math.cos(math.pi * (t + _C[i] * h)) - gamma
        pushes[i] -= in_contact * (stiffness * (u_new - side * half) + damping * v_new)
    u_error = v_error = 0.0
    for i in range(7):
        u_error += h * _E[i] * speeds[i]
        v_error += h * _E[i] * pushes[i]
    return u_new, v_new, u_error, v_error


@numba.njit
def _violation(u, side, half):
    """Return the distance past the next event: outside the gap in flight, inside it in contact."""
    return abs(u) - half if side == 0 else half - side * u


@numba.njit
def _first_violation(u, v, u_new, v_new, h, side, half):
    """Return the first probed fraction of a step at which the ball is past an event; above 1 if there is none."""
    for probe in range(1, _PROBES + 1):
        s = probe / _PROBES
        change = u_new - u
        position = u + s * (h * v + s * (3 * change - h * (2 * v + v_new) + s * (h * (v + v_new) - 2 * change)))
        if _violation(u_new if probe == _PROBES else position, side, half) > 0:
            return s
    return 2.0


@numba.njit(parallel=True)
def _chain(half_gap, stiffnesses, dampings, r, gamma, end, rtol, u_inout, v_inout):
    for cell in numba.prange(half_gap.size):
        half, u, v, t, side = half_gap[cell], u_inout[cell], v_inout[cell], 0.0, 0
        stiffness, damping = stiffnesses[cell], dampings[cell]
        speeds, pushes = np.empty(7), np.empty(7)
        flight = 1e-3
        contact = 0.1 / math.sqrt(stiffness) if stiffness > 0 else flight
        remaining_steps = int(_STEPS_PER_PERIOD * end)
        while t < end and remaining_steps > 0:
            remaining_steps -= 1
            step_size = flight if side == 0 else contact
            last = step_size >= end - t
            h = end - t if last else step_size
            step = _dormand_prince_step(t, u, v, h, side, half, stiffness, damping, gamma, speeds, pushes)
            u_new, v_new, u_error, v_error = step
            u_error /= rtol * (ATOL + max(abs(u), abs(u_new)))
            v_error /= rtol * (ATOL + max(abs(v), abs(v_new)))
            error = math.sqrt(0.5 * (u_error**2 + v_error**2))
            factor = min(5.0, max(0.2, 0.9 * max(error, 1e-10) ** -0.2))
            if not error <= 1:
                h *= factor if error > 1 else 0.2
            elif not last:
                h *= factor
            else:
                h = step_size
            if side == 0:
                flight = min(h, LONGEST)
            else:
                contact = min(h, LONGEST)
            if not error <= 1:
                continue
            h = end - t if last else step_size
            high = h * _first_violation(u, v, u_new, v_new, h, side, half)
            if high > h:
                t = end if last else t + h
                u, v = u_new, v_new
                continue
            low, s = high - h / _PROBES, high - 0.5 * h / _PROBES
            for _ in range(_ROOT_ITERATIONS):
                step = _dormand_prince_step(t, u, v, s, side, half, stiffness, damping, gamma, speeds, pushes)
                violation = _violation(step[0], side, half)
                if abs(violation) < _CLOSED:
                    break
                if violation > 0:
                    high = s
                else:
                    low = s
                rate = step[1] * (np.sign(step[0]) if side == 0 else -side)
                s = s - violation / rate if rate > 0 else low
                if not low < s < high:
                    s = 0.5 * (low + high)
            wall = side if side != 0 else (1 if step[0] > 0 else -1)
            t, u, v = t + s, wall * half, step[1]
            if stiffness == 0:
                v = -r * v
            else:
                side = 0 if side != 0 else wall
        u_inout[cell] = u if remaining_steps > 0 else np.nan
        v_inout[cell] = v if remaining_steps > 0 else np.nan


# --- restart chains -------------------------------------------------------------------------------


def scipy_events(
    d, kappa, r: float, gamma: float, u0, v0, periods: int, rtol: float, solver: str
) -> tuple[np.ndarray, ...]:
    """Do the same as `dormand_prince` by SciPy's `solve_ivp` with terminal events, cell by cell; NaN if it fails."""
    cells = np.broadcast(d, 0.0 if kappa is None else kappa, u0, v0)
    ends = [
        _scipy_cell(float(d), None if kappa is None else float(stiffness), r, gamma, u, v, periods, rtol, solver)
        for d, stiffness, u, v in cells
    ]
    u, v = np.array(ends).T
    return u, v


def _scipy_cell(d, kappa, r, gamma, u, v, periods, rtol, solver) -> tuple[float, float]:
    half, t, end, side = d / 2, 0.0, 2.0 * periods, 0
    stiffness, damping = (0.0, 0.0) if kappa is None else (kappa**2, kappa * _damping(r))

    def field(t, y):
        force = math.cos(math.pi * t) - gamma
        return y[1], force - (stiffness * (y[0] - side * half) + damping * y[1] if side else 0.0)

    def wall_event(wall, direction):
        def distance(t, y):
            return y[0] - wall

        distance.terminal, distance.direction = True, direction
        return distance

    onsets = [wall_event(half, 1), wall_event(-half, -1)]
    while t < end:
        events = [wall_event(side * half, -side)] if side else onsets
        solution = solve_ivp(
            field, (t, end), (u, v), solver, events=events, max_step=LONGEST, rtol=rtol, atol=ATOL * rtol
        )
        if not solution.success:
            return math.nan, math.nan
        t, (u, v) = solution.t[-1], solution.y[:, -1]
        if solution.status == 1:
            wall = side or (1 if len(solution.t_events[0]) else -1)
            u = wall * half
            if kappa is None:
                v = -r * v
            else:
                side = 0 if side else wall
    return u, v


def diffrax_chain(d, kappa, r: float, gamma: float, u0, v0, periods: int, rtol: float) -> tuple[np.ndarray, ...]:
    """Do the same as `dormand_prince` by diffrax: `diffeqsolve` with an `Event`, restarted until the end, vmapped."""
    stiff = np.asarray(0.0 if kappa is None else kappa, dtype=float)
    d, u0, v0, stiff = np.broadcast_arrays(*(np.asarray(x, dtype=float) for x in (d, u0, v0)), stiff)
    cells = [jnp.asarray(x) for x in (d / 2, u0, v0, stiff**2, stiff * _damping(r))]
    u, v = _restarts(kappa is None)(*cells, *(jnp.asarray(x, float) for x in (r, gamma, 2.0 * periods, rtol)))
    return np.asarray(u), np.asarray(v)


_MOST_STEPS = 1_000_000  # of one interval between events


@lru_cache
def _restarts(rigid: bool) -> Any:
    def field(t, y, args):
        half, side, stiffness, damping, gamma = args
        pull = stiffness * (y[0] - side * half) + damping * y[1]
        return y[1], jnp.cos(jnp.pi * t) - gamma - jnp.where(side == 0, 0.0, pull)

    def violation(t, y, args, **_):
        half, side, *_ = args
        return jnp.where(side == 0, jnp.abs(y[0]) - half, half - side * y[0])

    def run(half, u0, v0, stiffness, damping, r, gamma, end, rtol):
        def interval(carry):
            t, u, v, side = carry
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                diffrax.Tsit5(),
                t,
                end,
                None,
                (u, v),
                (half, side, stiffness, damping, gamma),
                stepsize_controller=diffrax.PIDController(rtol=rtol, atol=ATOL * rtol, dtmax=LONGEST),
                event=diffrax.Event(violation, optimistix.Newton(rtol, ATOL * rtol), direction=True),
                max_steps=_MOST_STEPS,
                throw=False,
            )
            t, (u, v) = solution.ts[-1], (solution.ys[0][-1], solution.ys[1][-1])
            hit = solution.event_mask
            wall = jnp.where(side == 0, jnp.sign(u), side)
            u = jnp.where(hit, wall * half, u)
            if rigid:
                return t, u, jnp.where(hit, -r * v, v), side
            return t, u, v, jnp.where(hit, jnp.where(side == 0, wall, 0.0), side)

        carry = (jnp.zeros_like(u0), u0, v0, jnp.zeros_like(u0))
        _, u, v, _ = jax.lax.while_loop(lambda carry: carry[0] < end, interval, carry)
        return u, v

    return jax.jit(jax.vmap(run, in_axes=(*[0] * 5, *[None] * 4)))
