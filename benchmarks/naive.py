"""Straightforward implementations, each a few lines as users would write them; `failures.py` shows that they fail.

All use the pair of Eq. (38) at gamma = 0 with a start at phase 0, and treat the wall only as their docstring states.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from scipy.integrate import solve_ivp

PERIOD = 2.0


def push(t: Any, u: Any, v: Any, d: Any, kappa: Any, r: Any) -> Any:
    """Return u'' with the contact decided by a `where`; automatic differentiation does not see the switching time."""
    log = jnp.log(r)
    mu = -2 * kappa * log / jnp.sqrt(math.pi**2 + log * log)
    side = jnp.where(u < 0, -1.0, 1.0)
    w = side * u - 0.5 * d
    return jnp.cos(math.pi * t) - jnp.where(w >= 0, side * kappa**2 * w + mu * v, 0.0)


@jax.jit
def where_rk4(d: Any, kappa: Any, r: Any, u0: Any, v0: Any, periods: Any, steps: Any) -> tuple[Any, Any]:
    """Return displacement after some periods by classical Runge-Kutta, and its kappa derivative through a `where`."""
    h = PERIOD / jnp.asarray(steps, kappa.dtype)

    def last(kappa):
        def advance(i, state):
            u, v = state
            t = h * jnp.remainder(i, steps).astype(kappa.dtype)
            force = partial(push, d=d, kappa=kappa, r=r)
            a1 = force(t, u, v)
            u2, v2 = u + 0.5 * h * v, v + 0.5 * h * a1
            a2 = force(t + 0.5 * h, u2, v2)
            u3, v3 = u + 0.5 * h * v2, v + 0.5 * h * a2
            a3 = force(t + 0.5 * h, u3, v3)
            u4, v4 = u + h * v3, v + h * a3
            a4 = force(t + h, u4, v4)
            return u + h / 6 * (v + 2 * (v2 + v3) + v4), v + h / 6 * (a1 + 2 * (a2 + a3) + a4)

        return jax.lax.fori_loop(0, periods * steps, advance, (u0 + 0 * kappa, v0 + 0 * kappa))[0]

    return jax.jvp(last, (kappa,), (jnp.ones_like(kappa),))


def where_solver(solver: str, d: Any, kappa: Any, r: float, u0: float, v0: float, periods: int) -> Callable[[int], Any]:
    """Return a function of the steps per period to the displacement [N], by a diffrax solver without events."""
    numbers = jnp.asarray(d), jnp.asarray(r)

    def field(t, y, kappa):
        return jnp.stack([y[1], push(t, y[0], y[1], numbers[0], kappa, numbers[1])])

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None))
    def last(kappa, dt):
        done = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            getattr(diffrax, solver)(),
            0.0,
            PERIOD * periods,
            dt,
            jnp.array([u0, v0]),
            kappa,
            max_steps=None,
        )
        return done.ys[-1, 0]

    return lambda steps: np.asarray(last(jnp.asarray(kappa), PERIOD / steps))


@jax.jit
@jax.vmap
def event_solver(d: Any, u0: Any, v0: Any) -> Any:
    """Return the time of the first impact, [N], by diffrax's event and Newton root finder; inf after two periods."""
    done = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, _: jnp.stack([y[1], jnp.cos(math.pi * t)])),
        diffrax.Tsit5(),
        0.0,
        2 * PERIOD,
        None,
        jnp.stack([u0, v0]),
        stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-10),
        event=diffrax.Event(lambda t, y, args, **_: 0.5 * d - jnp.abs(y[0]), optimistix.Newton(1e-10, 1e-10)),
        throw=False,
    )
    return jnp.where(done.event_mask, done.ts[-1], jnp.inf)


class Chain(NamedTuple):
    """End of a chain of restarts: time, number of restarts, solves without progress."""

    t: float
    restarts: int
    still: int  # solves that did not advance time


def restart_chain(d: float, r: float, u0: float, v0: float, periods: int, restarts: int) -> Chain:
    """Chain SciPy solves to a rigid wall, each with reversed velocity from the wall, up to a number of restarts."""

    def clearance(t, y):
        return 0.5 * d - abs(y[0])

    clearance.terminal, clearance.direction = True, -1  # type: ignore[attr-defined]
    t, y, still = 0.0, [u0, v0], 0
    for restart in range(restarts):
        run = solve_ivp(
            lambda t, y: [y[1], math.cos(math.pi * t)],
            (t, PERIOD * periods),
            y,
            method="DOP853",
            rtol=1e-9,
            atol=1e-11,
            events=clearance,
        )
        if run.status != 1:
            return Chain(float(run.t[-1]), restart, still)
        still += run.t[-1] == t
        t, y = float(run.t[-1]), [math.copysign(0.5 * d, run.y[0, -1]), -r * run.y[1, -1]]
    return Chain(t, restarts, still)


def contact(kappa: Any, r: Any, speed: Any, s: Any, xp: Any = math) -> Any:
    """Return penetration a time s after an entry at phase 0, by the textbook's steady and free oscillations.

    `xp` is a module with pi, log, exp, sqrt, sin and cos: `math`, or `mpmath` for the same formula in more digits.
    """
    log = xp.log(r)
    omega1 = kappa * xp.pi / xp.sqrt(xp.pi**2 + log**2)
    zeta = -log * omega1 / xp.pi
    stiffness, loss = kappa**2 - xp.pi**2, 2 * zeta * xp.pi
    size = stiffness**2 + loss**2
    in_phase, behind = stiffness / size, loss / size
    steady = in_phase * xp.cos(xp.pi * s) + behind * xp.sin(xp.pi * s)
    rate = (speed - behind * xp.pi - zeta * in_phase) / omega1
    return steady + xp.exp(-zeta * s) * (-in_phase * xp.cos(omega1 * s) + rate * xp.sin(omega1 * s))
