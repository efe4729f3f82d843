"""An adaptive method: diffrax's Runge-Kutta steps with located events.

One `step` of a lane is one attempt of a solver step, accepted, rejected or cut short, so that no lane waits for
another's solve. A cell's motion is a chain of smooth spells: flight in the displacement u, contact in the penetration
w = side u - d/2; `mode` says which, and no sign of a rounded number is asked. The wall is met where the dense output of
a step first crosses it; the step is then repeated up to there, and what is missing is closed by the Taylor polynomial
of the repeated step, so that the state has the order of the solver and not that of the dense output. This is the only
file that imports diffrax.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from vijax.engine.dense_output import Dense, SolverState, dense_output, root
from vijax.engine.method import ImpactOutcome, Method, decided
from vijax.model.flow import PI
from vijax.model.membrane import Wall
from vijax.model.pair import ImpactPair, MembranePair, Real
from vijax.model.records import Impact, State
from vijax.runtime.arrays import Flag, Scalar
from vijax.runtime.xla import share

Solver = Any  # a Runge-Kutta solver of diffrax
_LONGEST = 0.25  # longest step: the acceleration changes its sign at most once within it, but for |gamma| close to 1
_CLOSED = 1e-4  # of the repeated step: the Taylor polynomial of second order closes what is less, to 1e-13 of the step
_ATTEMPTS = 6  # repeats after which a crossing is taken as it is: rounding holds it from closing
# The first step, in half periods of the forcing; in a contact at most 0.1/kappa. The method chooses all others: a
# longer one is refused where it is too long, a shorter one costs a few steps.
_FIRST_STEP = 1e-3
_CREST = 2.0  # an aim that is no wall: the deepest point of a contact
_VANISHING = 4  # roundings: a shorter step does not advance time


class FieldArguments(eqx.Module):
    """What a smooth spell of the motion depends on: the wall it is at, and its side (0: flight)."""

    gamma: Scalar
    mode: Int[Array, ""]
    wall: Wall


def _field(t: Any, y: SolverState, spell: FieldArguments) -> SolverState:
    held = spell.mode != 0
    force = jnp.where(spell.mode < 0, -1.0, 1.0) * (jnp.cos(PI * t) - spell.gamma)
    pull = jnp.where(held, spell.wall(y.x, y.z), 0.0)
    work = tangent = None
    if y.work is not None:
        work = -pull * y.z
    if y.tangent is not None:
        a, b, c, d = y.tangent
        rows = [jax.jvp(spell.wall, (y.x, y.z), column)[1] for column in ((a, c), (b, d))]
        tangent = (c, d, *(jnp.where(held, row, 0.0) for row in rows))
    return SolverState(y.z, force + pull, work, tangent)


equation_38 = diffrax.ODETerm(_field)
"""Eq. (38) in one spell: x'' = side (cos(pi t) - gamma) + membrane(w, w'), for `SolverState` and `FieldArguments`."""


def _field_39(t: Any, y: SolverState, args: tuple[MembranePair, Int[Array, ""]]) -> SolverState:
    pair, mode = args
    side = jnp.sign(mode).astype(y.x.dtype)
    pull = jnp.where(mode == 0, 0.0, y.x - 0.5 * side + pair.c_star * y.z)
    return SolverState(y.z, pair.A_star * jnp.cos(pair.omega_star * t) - pair.g_star - pull)


equation_39 = diffrax.ODETerm(_field_39)
"""Eq. (39), lengths in units of s, times in units of 1/omega0: for `SolverState` (x, x') and (`MembranePair`, mode)."""


class OdeCarry(eqx.Module):
    """The carry of a lane: where the ball is, the step it will try, and what its contact has seen so far."""

    y: SolverState
    t: Scalar
    n: Int[Array, ""]
    mode: Int[Array, ""]
    h: Scalar
    full: Scalar  # step to go on with after one that was cut short
    other: Scalar  # step to go on with after the next change of mode
    cut: Flag  # this step was cut short, to end at an event or before a second turning
    aim: Scalar  # the event it was cut for: a wall in the direction -1 or +1, or a crest; 0 for none
    attempts: Int[Array, ""]
    onset_t: Scalar
    onset_n: Int[Array, ""]
    entered: Flag  # the contact had an onset
    v_in: Scalar
    depth: Scalar
    left_t: Scalar  # when the ball left a wall last
    left_n: Int[Array, ""]
    steps: Int[Array, ""]


class Ode(Method[OdeCarry]):
    """An adaptive Runge-Kutta method of diffrax with located events.

    Attributes:
        solver: One of `method_choice.SOLVERS`.
        rtol, atol: Tolerances of position and velocity, step by step.
        dt: A constant step instead, for measuring orders of convergence.
    """

    solver: str = eqx.field(static=True)
    rtol: Real
    atol: Real
    dt: Real | None = None

    @property
    def arithmetic(self) -> bool:
        """Say whether a step calls no library: the implicit solvers leave their linear systems to LAPACK."""
        return not self.solver.startswith("Kvaerno")

    @property
    def grain(self) -> Scalar | float:
        """Say how far apart two motions from one point may end: steps of other lengths, each as wrong as is allowed."""
        return self.rtol

    def taken(self, m: OdeCarry) -> Int[Array, ""]:
        """Count the steps so far, those that were refused among them."""
        return m.steps

    def start(self, pair: ImpactPair, state: State, *, deep: bool, tangent: bool) -> OdeCarry:
        """Make the carry of a start."""
        zero, whole = jnp.zeros_like(state.u), jnp.zeros_like(state.n)
        side = state.mode.astype(zero.dtype)
        held = state.mode != 0
        x = jnp.where(held, side * state.u - 0.5 * pair.d, state.u)
        if self.dt is None:
            first, inside = zero + _FIRST_STEP, jnp.minimum(_FIRST_STEP, 0.1 / pair._soft_kappa())
        else:
            first = inside = zero + self.dt
        no = jnp.zeros_like(held)
        return OdeCarry(
            y=SolverState(
                x,
                jnp.where(held, side * state.v, state.v),
                zero if deep else None,
                (zero + 1, zero, zero, zero + 1) if tangent else None,
            ),
            t=state.t,
            n=state.n,
            mode=state.mode,
            h=jnp.where(held, inside, first),
            full=first,
            other=jnp.where(held, first, inside),
            cut=no,
            aim=zero,
            attempts=whole,
            onset_t=state.t,
            onset_n=state.n,
            entered=no,
            v_in=state.v,
            depth=jnp.where(held, x, 0.0),
            left_t=state.t,
            left_n=state.n,
            steps=whole,
        )

    def step(
        self, pair: ImpactPair, wall: Wall, m: OdeCarry, *, recorded: bool = False
    ) -> tuple[OdeCarry, ImpactOutcome, Flag]:
        """Try one step of the solver; one that vanishes beside the time, or is not finite, makes an impact of NaN."""
        half, held = 0.5 * pair.d, m.mode != 0
        trial = _try(self, _solver(self, recorded), m, FieldArguments(pair.gamma, m.mode, wall), recorded)
        landing = _land(m, half, trial)
        sight = _look(trial.dense, held, half, m.y.work is not None, m.cut & (m.aim == 0))
        landing, sight = share((landing, sight))
        shut = landing.onset | landing.exits
        seen = trial.passes & sight.seen & ~shut & ~landing.crest
        seen, moved = decided((seen, trial.passes & ~seen))
        side = jnp.where(held, m.mode.astype(half.dtype), lax.stop_gradient(m.aim))
        y = _meet(m, half, side, wall, trial, landing)
        t = trial.t + landing.delay
        over = decided(t >= 2)
        t = jnp.where(moved, jnp.where(over, t - 2, t), m.t)
        n = m.n + (moved & over).astype(m.n.dtype)
        outcome = _outcome(m, half, side, y, t, n, landing.speed)
        lost = ~moved & ~(trial.h > _VANISHING * jnp.finfo(half.dtype).eps)
        outcome = eqx.tree_at(lambda p: p.impact.v_out, outcome, jnp.where(lost, jnp.nan, outcome.impact.v_out))

        if y.tangent is not None:
            unit = (1.0, 0.0, 0.0, 1.0)
            fresh = tuple(jnp.where(landing.exits, one, value) for one, value in zip(unit, y.tangent, strict=True))
            y = eqx.tree_at(lambda y: y.tangent, y, fresh)
        h, full, other = decided(_lengths(self, m, trial, sight, seen, moved, shut))
        depth = jnp.where(landing.crest, jnp.maximum(m.depth, y.x), m.depth)
        new = OdeCarry(
            y=jax.tree.map(lambda new, old: jnp.where(moved, new, old), y, m.y),
            t=t,
            n=n,
            mode=jnp.where(landing.onset, side.astype(m.mode.dtype), jnp.where(landing.exits, 0, m.mode)),
            h=h,
            full=full,
            other=other,
            cut=seen,
            aim=decided(lax.stop_gradient(jnp.where(seen, sight.aim, 0.0))),
            attempts=jnp.where(seen, m.attempts + 1, 0),
            onset_t=jnp.where(landing.onset, t, m.onset_t),
            onset_n=jnp.where(landing.onset, n, m.onset_n),
            entered=(m.entered | landing.onset) & ~landing.exits,
            v_in=jnp.where(landing.onset, side * landing.speed, m.v_in),
            depth=jnp.where(landing.onset, 0.0, depth),
            left_t=jnp.where(landing.exits, t, m.left_t),
            left_n=jnp.where(landing.exits, n, m.left_n),
            steps=m.steps + 1,
        )
        return new, outcome, (landing.exits & m.entered) | lost

    def ball(self, pair: ImpactPair, m: OdeCarry) -> State:
        """Say where the ball of a carry is."""
        side = m.mode.astype(m.y.x.dtype)
        held = m.mode != 0
        u = jnp.where(held, side * (0.5 * pair.d + m.y.x), m.y.x)
        return State(u, jnp.where(held, side * m.y.z, m.y.z), m.t, m.n, m.mode)


def _solver(engine: Ode, recorded: bool) -> Solver:
    """Make diffrax's solver; its loop over stages is differentiable in reverse where a run is recorded."""
    solver, kind = getattr(diffrax, engine.solver), "bounded" if recorded else "lax"
    if issubclass(solver, diffrax.AbstractImplicitSolver):
        tolerances: Any = (engine.rtol, engine.atol)
        return solver(scan_kind=kind, root_finder=diffrax.VeryChord(*tolerances))
    return solver(scan_kind=kind)


def _control(engine: Ode, order: Any, t0: Scalar, t1: Scalar, y0: SolverState, y1: SolverState, error: SolverState):
    """Say whether a step is accepted, and how long the next is; the error of position and velocity alone decides."""
    if engine.dt is not None:
        return jnp.ones_like(t0, bool), jnp.full_like(t0, engine.dt)
    controller = diffrax.PIDController(rtol=engine.rtol, atol=engine.atol)
    t0, t1, y0, y1, error = lax.stop_gradient((t0, t1, y0, y1, error))
    (x0, z0), (x1, z1), (e_x, e_z) = ((y.x, y.z) for y in (y0, y1, error))
    one = jnp.ones_like(t0)
    keep, begin, end, _, _, _ = controller.adapt_step_size(
        t0, t1, (x0, z0), (x1, z1), None, (e_x, e_z), order, (one, one, jnp.asarray(False))
    )
    h = end - begin
    return keep, jnp.where(jnp.isfinite(h), h, 0.2 * (t1 - t0))


class _Trial(eqx.Module):
    """A step that was tried: where it leads, whether its error lets it pass, and the length to try next."""

    h: Scalar
    t: Scalar
    y: SolverState
    f: SolverState
    passes: Flag
    h_next: Scalar
    dense: Dense


def _try(engine: Ode, solver: Solver, m: OdeCarry, spell: FieldArguments, recorded: bool) -> _Trial:
    """Try one step of the solver, at most to the end of the period if it is recorded."""
    h = jnp.minimum(lax.stop_gradient(m.h), _LONGEST)
    t = m.t + h
    if recorded:
        room = lax.stop_gradient(2 - m.t)
        ends = decided(h >= room)
        t, h = jnp.where(ends, 2.0, t), jnp.where(ends, room, h)
    no = jnp.zeros_like(m.cut)
    f0 = _field(m.t, m.y, spell)
    fsal = solver.tableau.fsal
    y, error, _, last, _ = solver.step(equation_38, m.t, t, m.y, spell, (no, f0) if fsal else None, no)
    f = last[1] if fsal else _field(t, y, spell)
    y, error, f0, f = share((y, error, f0, f))
    passes, h_next = _control(engine, solver.error_order(equation_38), m.t, t, m.y, y, error)
    dense = share(dense_output(h, *lax.stop_gradient((m.y, f0, y, f))))
    return _Trial(h, t, y, f, passes, h_next, dense)


class _Sight(eqx.Module):
    """What the dense output of a step shows: whether to try it shorter, how much, and the event it should end at."""

    seen: Flag
    theta: Scalar
    aim: Scalar


def _look(dense: Dense, held: Flag, half: Scalar, deep: bool, untwisted: Flag) -> _Sight:
    """Find the first wall crossing of a step, the crest of a contact before it, or a second turning of the velocity.

    A velocity that changes sign between the ends turns once; the position is monotone up to there and from there on,
    so each crossing is bracketed, and of two the earlier is found. Where the acceleration changes sign (at most once,
    as a step is at most _LONGEST) the velocity is extreme: if it has changed sign there and back, the step is cut at
    that place, and the next look sees one turning at a time (`untwisted`: it was cut so).
    """
    one, zero = jnp.ones_like(half), jnp.zeros_like(half)
    z0, z1, bend0, bend1 = dense.c1, dense.rate(one), dense.c2, dense.bend(one)
    heading = jnp.where(z0 == 0, jnp.sign(z1), jnp.sign(z0))
    turns = heading * z1 < 0
    turning = root(lambda s: (-heading * dense.rate(s), -heading * dense.bend(s)), zero, one)
    rising = jnp.sign(bend1)
    extreme = root(lambda s: (rising * dense.bend(s), rising * dense.jerk(s)), zero, one)
    twice = (bend0 * bend1 < 0) & ~turns & ~untwisted & (heading * dense.rate(extreme) < 0)
    # What may be met: either wall in flight, and in contact the membrane's rest from above.
    wall = jnp.where(held, 0.0, half)
    middle = jnp.where(turns, turning, one)
    first = (~held | (heading < 0)) & (heading * dense.place(middle) > wall)
    second = turns & ~first & (~held | (heading > 0)) & (-heading * dense.place(one) > wall)
    aim = jnp.where(first, heading, -heading)
    low, high = jnp.where(first, 0.0, middle), jnp.where(first, middle, 1.0)
    crossing = root(lambda s: (aim * dense.place(s) - wall, aim * dense.rate(s)), low, high)
    crest = turns & held & (heading > 0) if deep else jnp.zeros_like(turns)
    return _Sight(
        twice | crest | first | second,
        jnp.where(twice, extreme, jnp.where(crest, turning, crossing)),
        jnp.where(twice, 0.0, jnp.where(crest, _CREST, aim)),
    )


class _Landing(eqx.Module):
    """Whether a step that was cut for an event has met it, how much later in time it is, and the speed there."""

    onset: Flag
    exits: Flag
    crest: Flag
    delay: Scalar
    speed: Scalar  # towards the wall at an onset, away from it at an exit


def _land(m: OdeCarry, half: Scalar, trial: _Trial) -> _Landing:
    """Close the gap that the repeated step leaves, to second order: aim (x + z s + push s^2/2) = wall.

    The root is -2 gap/(speed + sqrt(speed^2 - 2 push gap)), and the speed there is that square root. A ball that turns
    just before the wall has none, and has not met it. Derivatives are those of the true event: the lengths of steps are
    constants to them.
    """
    held, aim = m.mode != 0, lax.stop_gradient(m.aim)
    x, z, push = trial.y.x, trial.y.z, trial.f.z
    gap, speed, drive = aim * x - jnp.where(held, 0.0, half), aim * z, aim * push
    square = speed * speed - 2 * drive * gap
    root = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    both = speed + root
    real = ((square >= 0) | (gap > 0)) & ((root > 0) | (drive > 0))
    tops = (aim == _CREST) & (push < 0)
    delay = jnp.where(tops, -z / jnp.where(tops, push, -1.0), -2 * gap / jnp.where(both > 0, both, jnp.inf))
    near = trial.passes & ((jnp.abs(delay) <= _CLOSED * trial.h) | (m.attempts >= _ATTEMPTS))
    met, crest = decided((near & real & (jnp.abs(aim) == 1), near & tops))
    return _Landing(met & ~held, met & held, crest, jnp.where(met | crest, delay, 0.0), root)


def _ratio(change: Scalar, speed: Scalar) -> Scalar:
    """Jump of the acceleration over the speed of crossing: the one entry of a soft saltation matrix."""
    moving = speed != 0
    return jnp.where(moving, change / jnp.where(moving, speed, 1.0), 0.0)


def _meet(m: OdeCarry, half: Scalar, side: Scalar, wall: Wall, trial: _Trial, landing: _Landing) -> SolverState:
    """Find the state at the event that a step has met (at its end, if none), in coordinates of the spell after it."""
    onset, exits, crest, delay, speed = landing.onset, landing.exits, landing.crest, landing.delay, landing.speed
    y = jax.tree.map(lambda value, slope: value + delay * slope, trial.y, trial.f)
    top = y.x + 0.5 * delay * delay * trial.f.z
    x = jnp.where(onset, 0.0, jnp.where(exits, side * half, jnp.where(crest, top, y.x)))
    z = jnp.where(onset, speed, jnp.where(exits, -side * speed, jnp.where(crest, 0.0, y.z)))
    tangent = None
    if y.tangent is not None:
        a, b, c, d = y.tangent
        zero = jnp.zeros_like(speed)
        jump = jnp.where(onset, _ratio(wall(zero, speed), speed), 0.0)
        jump = jnp.where(exits, _ratio(wall(zero, -speed), speed), jump)
        tangent = (a, b, c + jump * a, d + jump * b)
    return SolverState(x, z, None if y.work is None else jnp.where(onset, 0.0, y.work), tangent)


def _lengths(engine: Ode, m: OdeCarry, trial: _Trial, sight: _Sight, seen: Flag, moved: Flag, shut: Flag):
    """Say how long the next step is, the one to go on with after a cut one, and the one after the next change of mode.

    A change of mode changes the scale of time: each mode goes on with the length that it had.
    """
    ahead = trial.h_next if engine.dt is not None else jnp.maximum(trial.h_next, m.h)  # m.h: was capped
    ahead = jnp.minimum(jnp.where(m.cut, m.full, ahead), _LONGEST)
    after = jnp.where(shut, m.other, jnp.where(moved, ahead, trial.h_next))
    h = jnp.where(seen, sight.theta * trial.h, after)
    return lax.stop_gradient((h, jnp.where(seen, ahead, m.full), jnp.where(shut, m.full, m.other)))


def _outcome(
    m: OdeCarry, half: Scalar, side: Scalar, y: SolverState, t: Scalar, n: Int[Array, ""], speed: Scalar
) -> ImpactOutcome:
    """Record the impact that ends at (t, n) with the ball leaving at a speed."""
    zero, v_out = jnp.zeros_like(half), -side * speed
    impact = Impact(
        n=m.onset_n,
        t=m.onset_t,
        side=side.astype(m.mode.dtype),
        v_in=m.v_in,
        v_out=v_out,
        depth=m.depth,
        duration=(t - m.onset_t) + 2 * (n - m.onset_n).astype(t.dtype),
        work=zero if y.work is None else y.work,
    )
    flight = (m.onset_t - m.left_t) + 2 * (m.onset_n - m.left_n).astype(t.dtype)
    return ImpactOutcome(impact, flight, State(side * half, v_out, t, n, jnp.zeros_like(m.mode)), y.tangent)
