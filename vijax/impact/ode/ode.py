"""Adaptive method: Runge-Kutta steps of diffrax with located events.

One `step` of a lane is one attempt of a solver step, which is accepted, rejected or cut short, so no lane waits for
another lane's solution. The motion of a cell is a sequence of smooth phases: flight in the displacement u, and contact
in the penetration w = side u - d/2. `mode` stores the present phase, so no decision depends on the sign of a rounded
number. `ode_events` detects and locates the events of a step. Only this module and `ode_contact` import diffrax.
"""

from functools import reduce
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from vijax.impact.method import ImpactOutcome, Method, impact_outcome, save_decision
from vijax.impact.ode.dense_output import SolverState, dense_output
from vijax.impact.ode.ode_events import (
    FIRST_STEP,
    LONGEST,
    EventCandidate,
    EventHit,
    OdeCarry,
    Trial,
    detect_event,
    locate_event,
    state_at_event,
)
from vijax.impact.ode.ode_friction import Sticking, slip_direction, sticking_from, update_slip
from vijax.model.flow import PI
from vijax.model.forcing.waves import Waves, forcing_acceleration, waves_from, waves_later
from vijax.model.pair import ImpactPair, Real
from vijax.model.records import State
from vijax.model.walls.membrane import Wall
from vijax.model.walls.sides import Sides, at_wall, values_by_name
from vijax.runtime.arrays import Flag, Scalar
from vijax.runtime.compilation.xla import materialise

Solver = Any  # Runge-Kutta solver of diffrax.
_VANISHING = 4  # A step shorter than this number of machine epsilons counts as one that does not advance the time.


class FieldArguments(eqx.Module):
    """Parameters of one smooth phase of the motion: the wall, and its side as `mode` (0: flight).

    A friction force that brakes the ball is part of gamma. `slides` is True if the ball moves at all; it is None
    without friction. `waves` holds the harmonics of the forcing relative to phase 0; None for the sine.
    """

    gamma: Scalar
    mode: Int[Array, ""]
    wall: Wall
    slides: Any = None
    waves: Waves | None = None


def _field(t: Any, y: SolverState, args: FieldArguments) -> SolverState:
    """Return the time derivative of the state: motion, power into the membrane, and variational equation."""
    in_contact = args.mode != 0
    push = (
        jnp.cos(PI * t) - args.gamma
        if args.waves is None
        else forcing_acceleration(waves_later(args.waves, t), args.gamma)
    )
    force = jnp.where(args.mode < 0, -1.0, 1.0) * push
    # Acceleration by the membrane. `work` is the energy that the ball gives to the membrane, so its rate is -pull z.
    pull = jnp.where(in_contact, args.wall(y.x, y.z), 0.0)
    work = tangent = None
    if y.work is not None:
        work = -pull * y.z
    if y.tangent is not None:
        a, b, c, d = y.tangent
        # Variational equation: d/dt of a column (dx, dz) is (dz, derivative of the membrane's force).
        rows = [jax.jvp(args.wall, (y.x, y.z), column)[1] for column in ((a, c), (b, d))]
        tangent = (c, d, *(jnp.where(in_contact, row, 0.0) for row in rows))
    slope = SolverState(y.z, force + pull, work, tangent)
    return slope if args.slides is None else jax.tree.map(lambda x: jnp.where(args.slides, x, 0.0), slope)


equation_38 = diffrax.ODETerm(_field)
"""Eq. (38) in one phase: x'' = side (cos(pi t) - gamma) + membrane(w, w'), for `SolverState` and `FieldArguments`."""


class Ode(Method[OdeCarry]):
    """An adaptive Runge-Kutta method of diffrax with located events.

    Attributes:
        solver: One of `method_choice.SOLVERS`.
        rtol, atol: Tolerances of position and velocity per step.
        dt: A constant step instead of an adaptive one, for measurements of convergence orders.
        friction: Largest acceleration by friction, divided by the forcing's amplitude; None without friction.
        harmonics: Harmonics of the forcing relative to phase 0; None for the sine.
    """

    solver: str = eqx.field(static=True)
    rtol: Real
    atol: Real
    dt: Real | None = None
    friction: Real | None = None
    harmonics: Waves | None = None

    def waves(self, t: Any) -> Waves:
        """Return the harmonics of the forcing as functions of the time since phase t."""
        return waves_from(self.harmonics, t)

    @property
    def arithmetic(self) -> bool:
        """True if a step calls no library function; only the implicit solvers do, for their linear systems."""
        return not self.solver.startswith("Kvaerno")

    @property
    def repeatability(self) -> Scalar | float:
        """Return the possible size of the difference between two computed motions that pass through the same state.

        Such motions may have different step lengths, and each step has a relative error of up to rtol.
        """
        return self.rtol

    def step_count(self, m: OdeCarry) -> Int[Array, ""]:
        """Return the number of steps so far, rejected steps included."""
        return m.steps

    def start(self, pair: ImpactPair, state: State, *, deep: bool, tangent: bool) -> OdeCarry:
        """Return the carry of an initial state."""
        zero, zero_count = jnp.zeros_like(state.u), jnp.zeros_like(state.n)
        side = state.mode.astype(zero.dtype)
        in_contact = state.mode != 0
        x = jnp.where(in_contact, side * state.u - 0.5 * pair.d, state.u)
        if self.dt is None:
            # The first step in a contact resolves the stiffest membrane; the first step in flight resolves the forcing.
            stiffest = reduce(jnp.maximum, values_by_name("kappa", pair._soft_kappa()).values())
            first, inside = zero + FIRST_STEP, jnp.minimum(FIRST_STEP, 0.1 / stiffest)
        else:
            first = inside = zero + self.dt
        no = jnp.zeros_like(in_contact)
        return OdeCarry(
            y=SolverState(
                x,
                jnp.where(in_contact, side * state.v, state.v),
                zero if deep else None,
                (zero + 1, zero, zero, zero + 1) if tangent else None,
            ),
            t=state.t,
            n=state.n,
            mode=state.mode,
            h=jnp.where(in_contact, inside, first),
            full=first,
            other=jnp.where(in_contact, first, inside),
            cut=no,
            aim=zero,
            attempts=zero_count,
            onset_t=state.t,
            onset_n=state.n,
            entered=no,
            v_in=state.v,
            depth=jnp.where(in_contact, x, 0.0),
            exit_t=state.t,
            exit_n=state.n,
            steps=zero_count,
            slip=None if self.friction is None else self._initial_slip(pair, state, x),
        )

    def _initial_slip(self, pair: ImpactPair, state: State, x: Scalar) -> Scalar:
        """Return the initial direction of sliding; 0 if the ball sticks."""
        friction: Any = self.friction
        wall = at_wall(self.walls(pair), state.mode.astype(x.dtype))
        drive = jnp.cos(PI * state.t) + _push(pair, wall, state.mode, x)
        return jnp.where(state.v == 0, slip_direction(drive, friction), jnp.sign(state.v))

    def step(
        self, pair: ImpactPair, walls: Wall | Sides, m: OdeCarry, *, recorded: bool = False
    ) -> tuple[OdeCarry, ImpactOutcome, Flag]:
        """Try one step of the solver.

        If a step is too short to advance the time, or is not finite, the lane ends with an impact that has v_out NaN.
        """
        half = 0.5 * pair.d
        side, wall, sticking, trial, candidate, hit = self._attempt(pair, walls, m, recorded)
        mode_changes = hit.onset | hit.exits
        # A step that contains an event is rejected and tried again up to the event. A step that was cut for an event
        # and reached it is accepted, although its dense output shows the same event again.
        retry = trial.passes & candidate.detected & ~mode_changes & ~hit.crest
        retry, moved = save_decision((retry, trial.passes & ~retry))
        y = state_at_event(half, side, wall, trial, hit)
        t = trial.t + hit.delay
        # The phase stays within one period, since a growing time would lose digits.
        period_ends = save_decision(t >= 2)
        t = jnp.where(moved, jnp.where(period_ends, t - 2, t), m.t)
        n = m.n + (moved & period_ends).astype(m.n.dtype)
        after = State(side * half, -side * hit.speed, t, n, jnp.zeros_like(m.mode))
        outcome = impact_outcome(m, side, after, jnp.zeros_like(half) if y.work is None else y.work, y.tangent)
        # A step that is too short would be tried for ever. `~(... > ...)` is also True for a length of NaN.
        stalled = ~moved & ~(trial.h > _VANISHING * jnp.finfo(half.dtype).eps)
        outcome = eqx.tree_at(lambda p: p.impact.v_out, outcome, jnp.where(stalled, jnp.nan, outcome.impact.v_out))
        y = _restart_tangent(y, hit.exits)
        h, full, other = save_decision(_next_lengths(self, m, trial, candidate, retry, moved, mode_changes))
        depth = jnp.where(hit.crest, jnp.maximum(m.depth, y.x), m.depth)
        new = OdeCarry(
            y=jax.tree.map(lambda new, old: jnp.where(moved, new, old), y, m.y),
            t=t,
            n=n,
            mode=jnp.where(hit.onset, side.astype(m.mode.dtype), jnp.where(hit.exits, 0, m.mode)),
            h=h,
            full=full,
            other=other,
            cut=retry,
            aim=save_decision(lax.stop_gradient(jnp.where(retry, candidate.aim, 0.0))),
            attempts=jnp.where(retry, m.attempts + 1, 0),
            onset_t=jnp.where(hit.onset, t, m.onset_t),
            onset_n=jnp.where(hit.onset, n, m.onset_n),
            entered=(m.entered | hit.onset) & ~hit.exits,
            v_in=jnp.where(hit.onset, side * hit.speed, m.v_in),
            depth=jnp.where(hit.onset, 0.0, depth),
            exit_t=jnp.where(hit.exits, t, m.exit_t),
            exit_n=jnp.where(hit.exits, n, m.exit_n),
            steps=m.steps + 1,
            slip=m.slip,
        )
        if sticking is not None:
            friction: Any = self.friction
            drive = jnp.cos(PI * t) + _push(pair, wall, m.mode, new.y.x)
            new = update_slip(m, new, trial, hit.crest, sticking, drive, friction)
        return new, outcome, (hit.exits & m.entered) | stalled

    def _attempt(
        self, pair: ImpactPair, walls: Wall | Sides, m: OdeCarry, recorded: bool
    ) -> tuple[Scalar, Wall, Sticking | None, Trial, EventCandidate, EventHit]:
        """Try a step; return side, wall, sticking (None without friction), trial, event candidate and event hit."""
        half, in_contact = 0.5 * pair.d, m.mode != 0
        side = jnp.where(in_contact, m.mode.astype(half.dtype), jnp.sign(lax.stop_gradient(m.aim)))
        wall, sticking, direction = at_wall(walls, side), None, None
        args = FieldArguments(pair.gamma, m.mode, wall, waves=self.harmonics)
        if m.slip is not None:
            friction: Any = self.friction
            args = FieldArguments(pair.gamma + friction * m.slip, m.mode, wall, m.slip != 0)
            sticking = sticking_from(m.t, _push(pair, wall, m.mode, m.y.x), friction)
            direction = jnp.where(in_contact, side, 1.0) * m.slip
        trial = _try_step(self, _solver(self, recorded), m, args, recorded, sticking)
        candidate = detect_event(trial.dense, in_contact, half, m.y.work is not None, m.cut & (m.aim == 0), direction)
        # Many later values use the candidate and the hit. Without `materialise` XLA would compute both for each use.
        hit, candidate = materialise((locate_event(m, half, trial), candidate))
        return side, wall, sticking, trial, candidate, hit

    def effective_gamma(self, gamma: Any, v: Any) -> Any:
        """Return the effective gamma of a ball in flight at velocity v: gravity plus friction against the motion."""
        return gamma if self.friction is None else gamma + self.friction * jnp.sign(v)

    def is_at_rest(self, pair: ImpactPair, m: OdeCarry) -> Flag:
        """Return True if friction holds the ball of a carry in flight for ever."""
        if m.slip is None:
            return jnp.zeros_like(m.cut)
        friction: Any = self.friction
        return (m.mode == 0) & (m.slip == 0) & jnp.isinf(sticking_from(m.t, -pair.gamma, friction).duration)

    def ball(self, pair: ImpactPair, m: OdeCarry) -> State:
        """Return the state of the ball of a carry."""
        side = m.mode.astype(m.y.x.dtype)
        in_contact = m.mode != 0
        u = jnp.where(in_contact, side * (0.5 * pair.d + m.y.x), m.y.x)
        return State(u, jnp.where(in_contact, side * m.y.z, m.y.z), m.t, m.n, m.mode)


def _push(pair: ImpactPair, wall: Wall, mode: Int[Array, ""], x: Scalar) -> Scalar:
    """Return the force of gravity and membrane on a ball at rest, along the displacement, without the forcing."""
    return jnp.where(mode != 0, mode.astype(x.dtype) * wall(x, jnp.zeros_like(x)), 0.0) - pair.gamma


def _solver(engine: Ode, recorded: bool) -> Solver:
    """Return diffrax's solver. In recorded runs its loop over stages is differentiable in reverse mode."""
    solver, kind = getattr(diffrax, engine.solver), "bounded" if recorded else "lax"
    if issubclass(solver, diffrax.AbstractImplicitSolver):
        tolerances: Any = (engine.rtol, engine.atol)
        return solver(scan_kind=kind, root_finder=diffrax.VeryChord(*tolerances))
    return solver(scan_kind=kind)


def _control(engine: Ode, order: Any, t0: Scalar, t1: Scalar, y0: SolverState, y1: SolverState, error: SolverState):
    """Return whether a step is accepted, and the length of the next step.

    Only the errors of position and velocity count, not the errors of work and tangent map.
    """
    if engine.dt is not None:
        return jnp.ones_like(t0, bool), jnp.full_like(t0, engine.dt)
    # With its defaults this is an integral controller: it ignores the errors of earlier steps, so ones are passed in
    # their place.
    controller = diffrax.PIDController(rtol=engine.rtol, atol=engine.atol)
    t0, t1, y0, y1, error = lax.stop_gradient((t0, t1, y0, y1, error))
    (x0, z0), (x1, z1), (e_x, e_z) = ((y.x, y.z) for y in (y0, y1, error))
    unit = jnp.ones_like(t0)
    keep, begin, end, _, _, _ = controller.adapt_step_size(
        t0, t1, (x0, z0), (x1, z1), None, (e_x, e_z), order, (unit, unit, jnp.asarray(False))
    )
    # A non-finite error gives no information on the next length; it is reduced by a fixed factor.
    h = end - begin
    return keep, jnp.where(jnp.isfinite(h), h, 0.2 * (t1 - t0))


def _try_step(
    engine: Ode,
    solver: Solver,
    m: OdeCarry,
    args: FieldArguments,
    recorded: bool,
    sticking: Sticking | None,
) -> Trial:
    """Try one step of the solver.

    The step does not pass the release of a sticking ball and, if `recorded`, does not pass the end of the period.
    """
    h = jnp.minimum(lax.stop_gradient(m.h), LONGEST)
    if sticking is not None:
        h = jnp.where(args.slides, h, jnp.minimum(h, sticking.duration))
    t = m.t + h
    if recorded:
        # A recorded run needs the states at phase 0, so a step ends at phase 0. The time is set to 2 exactly, because a
        # sum of step lengths may miss it by rounding.
        remaining = lax.stop_gradient(2 - m.t)
        ends = save_decision(h >= remaining)
        t, h = jnp.where(ends, 2.0, t), jnp.where(ends, remaining, h)
    no = jnp.zeros_like(m.cut)
    # The dense output needs the slope at the start. A solver with the FSAL property (first same as last) takes it as
    # its first stage.
    f0 = _field(m.t, m.y, args)
    fsal = solver.tableau.fsal
    y, error, _, last, _ = solver.step(equation_38, m.t, t, m.y, args, (no, f0) if fsal else None, no)
    f = last[1] if fsal else _field(t, y, args)
    y, error, f0, f = materialise((y, error, f0, f))
    passes, h_next = _control(engine, solver.error_order(equation_38), m.t, t, m.y, y, error)
    dense = materialise(dense_output(h, *lax.stop_gradient((m.y, f0, y, f))))
    return Trial(h, t, y, f, passes, h_next, dense)


def _restart_tangent(y: SolverState, exits: Flag) -> SolverState:
    """Restart the tangent map at an exit.

    The map of an impact runs from exit to exit; the product of these maps is the map of the motion.
    """
    if y.tangent is None:
        return y
    unit = (1.0, 0.0, 0.0, 1.0)
    fresh = tuple(jnp.where(exits, entry, value) for entry, value in zip(unit, y.tangent, strict=True))
    return eqx.tree_at(lambda y: y.tangent, y, fresh)


def _next_lengths(
    engine: Ode, m: OdeCarry, trial: Trial, candidate: EventCandidate, retry: Flag, moved: Flag, mode_changes: Flag
):
    """Return the next length, the length after a cut step, and the length after the next change of mode.

    Flight and contact have different time scales, so each mode continues with its own last length.
    """
    # The step may have been shorter than m.h, so its h_next may be too small.
    ahead = trial.h_next if engine.dt is not None else jnp.maximum(trial.h_next, m.h)
    ahead = jnp.minimum(jnp.where(m.cut, m.full, ahead), LONGEST)
    after = jnp.where(mode_changes, m.other, jnp.where(moved, ahead, trial.h_next))
    h = jnp.where(retry, candidate.theta * trial.h, after)
    return lax.stop_gradient((h, jnp.where(retry, ahead, m.full), jnp.where(mode_changes, m.full, m.other)))
