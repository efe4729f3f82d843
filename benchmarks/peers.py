"""What the engines are measured against: the usual programs for this job, each as its users would write it.

`rk4`: fixed steps on every cell, no event located: contact is a test on the position at each stage, an impact a sample
inside the wall after one outside. As fast as numba allows: cells go in blocks whose inner loop the compiler turns into
vector instructions, blocks go to threads, and all cells share one table of the forcing, since all start at one phase.

`dormand_prince`: Dormand and Prince's adaptive pair in numba, events located by repeating the step up to them.

`scipy_events`, `diffrax_chain`: a solver's own terminal events, and a restart behind each.

All start at phase 0 and end at phase 0, some periods later. Only the located ones know rigid walls (kappa None).
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

LONGEST = 0.25  # of an adaptive step in flight: what enters and leaves a wall within it may be missed
ATOL = 1e-2  # of rtol
BLOCK = 16  # cells that advance together: two AVX-512 registers, and still in L1


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
    """Count impacts per period, and find final displacement and final velocity, each [N].

    Args of `rk4_impacts_per_period`, but that u0 and v0 may differ from cell to cell, that gamma is free, and that
    `shaken` may be any forcing which repeats every period, as a function of times in [0, 2].
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
        # Private copies: through the shared arrays the compiler must fear aliases and leaves the inner loop scalar.
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

# The pair of Dormand and Prince: stages, their places, and the difference to the embedded fourth order.
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

_LOOKS = 4  # places of a step at which its cubic is compared with the wall
_ROOT_ITERATIONS = 40  # Newton or bisection, each a repeated step
_CLOSED = 4e-16  # distance to the wall that is none
_STEPS_PER_PERIOD = 1_000_000  # a run that needs more has failed


def dormand_prince(d, kappa, r: float, gamma: float, u0, v0, periods: int, rtol: float) -> tuple[np.ndarray, ...]:
    """Find displacement and velocity of every cell at last by an adaptive pair of order 5 with located events.

    Args:
        d: gap, [N].
        kappa: stiffness ratio, [N] or one for all; None for rigid walls.
        r: coefficient of restitution, one for all.
        gamma: gravity along the capsule, one for all.
        u0, v0: starts in the gap, [N] or one for all.
        periods: forcing periods to run.
        rtol: tolerance relative to displacement and velocity; the absolute one is a hundredth.

    Returns:
        Displacement and velocity, float64 [N]; NaN where a cell took too many steps.
    """
    stiff = 0.0 if kappa is None else kappa
    d, u0, v0, stiff = np.broadcast_arrays(*(np.asarray(x, dtype=float) for x in (d, u0, v0, stiff)))
    u, v = u0.copy(), v0.copy()
    _chain(d / 2, stiff**2, stiff * _damping(r), r, gamma, 2.0 * periods, rtol, u, v)
    return u, v


@numba.njit
def _dormand_prince_step(t, u, v, h, side, half, stiffness, damping, gamma, speeds, pushes):
    """Compute displacement and velocity after a step, and their error; side 0 is flight."""
    held = abs(side)
    u_new, v_new = u, v
    for i in range(7):
        u_new, v_new = u, v
        for j in range(i):
            u_new += h * _A[i, j] * speeds[j]
            v_new += h * _A[i, j] * pushes[j]
        speeds[i] = v_new
        pushes[i] = math.cos(math.pi * (t + _C[i] * h)) - gamma
        pushes[i] -= held * (stiffness * (u_new - side * half) + damping * v_new)
    u_error = v_error = 0.0
    for i in range(7):
        u_error += h * _E[i] * speeds[i]
        v_error += h * _E[i] * pushes[i]
    return u_new, v_new, u_error, v_error


@numba.njit
def _beyond(u, side, half):
    """Say how far the ball is past the next event: outside the gap in flight, inside it in contact."""
    return abs(u) - half if side == 0 else half - side * u


@numba.njit
def _first_look(u, v, u_new, v_new, h, side, half):
    """Find the first place of a step, as a part of it, at which the ball is past an event; above 1 if there is none."""
    for look in range(1, _LOOKS + 1):
        s = look / _LOOKS
        rise = u_new - u
        place = u + s * (h * v + s * (3 * rise - h * (2 * v + v_new) + s * (h * (v + v_new) - 2 * rise)))
        if _beyond(u_new if look == _LOOKS else place, side, half) > 0:
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
        left = int(_STEPS_PER_PERIOD * end)
        while t < end and left > 0:
            left -= 1
            own = flight if side == 0 else contact
            last = own >= end - t
            h = end - t if last else own
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
                h = own
            if side == 0:
                flight = min(h, LONGEST)
            else:
                contact = min(h, LONGEST)
            if not error <= 1:
                continue
            h = end - t if last else own
            high = h * _first_look(u, v, u_new, v_new, h, side, half)
            if high > h:
                t = end if last else t + h
                u, v = u_new, v_new
                continue
            low, s = high - h / _LOOKS, high - 0.5 * h / _LOOKS
            for _ in range(_ROOT_ITERATIONS):
                step = _dormand_prince_step(t, u, v, s, side, half, stiffness, damping, gamma, speeds, pushes)
                past = _beyond(step[0], side, half)
                if abs(past) < _CLOSED:
                    break
                if past > 0:
                    high = s
                else:
                    low = s
                rate = step[1] * (np.sign(step[0]) if side == 0 else -side)
                s = s - past / rate if rate > 0 else low
                if not low < s < high:
                    s = 0.5 * (low + high)
            wall = side if side != 0 else (1 if step[0] > 0 else -1)
            t, u, v = t + s, wall * half, step[1]
            if stiffness == 0:
                v = -r * v
            else:
                side = 0 if side != 0 else wall
        u_inout[cell] = u if left > 0 else np.nan
        v_inout[cell] = v if left > 0 else np.nan


# --- restart chains -------------------------------------------------------------------------------


def scipy_events(
    d, kappa, r: float, gamma: float, u0, v0, periods: int, rtol: float, solver: str
) -> tuple[np.ndarray, ...]:
    """Do as `dormand_prince`, by SciPy's `solve_ivp` with terminal events, cell by cell; NaN where it gives up."""
    cells = np.broadcast(d, 0.0 if kappa is None else kappa, u0, v0)
    ends = [
        _scipy_cell(float(d), None if kappa is None else float(own), r, gamma, u, v, periods, rtol, solver)
        for d, own, u, v in cells
    ]
    u, v = np.array(ends).T
    return u, v


def _scipy_cell(d, kappa, r, gamma, u, v, periods, rtol, solver) -> tuple[float, float]:
    half, t, end, side = d / 2, 0.0, 2.0 * periods, 0
    stiffness, damping = (0.0, 0.0) if kappa is None else (kappa**2, kappa * _damping(r))

    def field(t, y):
        force = math.cos(math.pi * t) - gamma
        return y[1], force - (stiffness * (y[0] - side * half) + damping * y[1] if side else 0.0)

    def meets(wall, direction):
        def gap(t, y):
            return y[0] - wall

        gap.terminal, gap.direction = True, direction
        return gap

    onsets = [meets(half, 1), meets(-half, -1)]
    while t < end:
        events = [meets(side * half, -side)] if side else onsets
        found = solve_ivp(field, (t, end), (u, v), solver, events=events, max_step=LONGEST, rtol=rtol, atol=ATOL * rtol)
        if not found.success:
            return math.nan, math.nan
        t, (u, v) = found.t[-1], found.y[:, -1]
        if found.status == 1:
            wall = side or (1 if len(found.t_events[0]) else -1)
            u = wall * half
            if kappa is None:
                v = -r * v
            else:
                side = 0 if side else wall
    return u, v


def diffrax_chain(d, kappa, r: float, gamma: float, u0, v0, periods: int, rtol: float) -> tuple[np.ndarray, ...]:
    """Do as `dormand_prince`, by diffrax: `diffeqsolve` with an `Event`, restarted to the end of the run, vmapped."""
    stiff = np.asarray(0.0 if kappa is None else kappa, dtype=float)
    d, u0, v0, stiff = np.broadcast_arrays(*(np.asarray(x, dtype=float) for x in (d, u0, v0)), stiff)
    cells = [jnp.asarray(x) for x in (d / 2, u0, v0, stiff**2, stiff * _damping(r))]
    u, v = _restarts(kappa is None)(*cells, *(jnp.asarray(x, float) for x in (r, gamma, 2.0 * periods, rtol)))
    return np.asarray(u), np.asarray(v)


_MOST_STEPS = 1_000_000  # of one spell


@lru_cache
def _restarts(rigid: bool) -> Any:
    def field(t, y, args):
        half, side, stiffness, damping, gamma = args
        pull = stiffness * (y[0] - side * half) + damping * y[1]
        return y[1], jnp.cos(jnp.pi * t) - gamma - jnp.where(side == 0, 0.0, pull)

    def past(t, y, args, **_):
        half, side, *_ = args
        return jnp.where(side == 0, jnp.abs(y[0]) - half, half - side * y[0])

    def run(half, u0, v0, stiffness, damping, r, gamma, end, rtol):
        def spell(carry):
            t, u, v, side = carry
            found = diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                diffrax.Tsit5(),
                t,
                end,
                None,
                (u, v),
                (half, side, stiffness, damping, gamma),
                stepsize_controller=diffrax.PIDController(rtol=rtol, atol=ATOL * rtol, dtmax=LONGEST),
                event=diffrax.Event(past, optimistix.Newton(rtol, ATOL * rtol), direction=True),
                max_steps=_MOST_STEPS,
                throw=False,
            )
            t, (u, v) = found.ts[-1], (found.ys[0][-1], found.ys[1][-1])
            met = found.event_mask
            wall = jnp.where(side == 0, jnp.sign(u), side)
            u = jnp.where(met, wall * half, u)
            if rigid:
                return t, u, jnp.where(met, -r * v, v), side
            return t, u, v, jnp.where(met, jnp.where(side == 0, wall, 0.0), side)

        carry = (jnp.zeros_like(u0), u0, v0, jnp.zeros_like(u0))
        _, u, v, _ = jax.lax.while_loop(lambda carry: carry[0] < end, spell, carry)
        return u, v

    return jax.jit(jax.vmap(run, in_axes=(*[0] * 5, *[None] * 4)))
