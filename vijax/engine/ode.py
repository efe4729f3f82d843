"""An adaptive method: diffrax's Runge-Kutta steps with located events.

One `step` of a lane is one attempt of a solver step, accepted, rejected or cut short, so that no lane waits for
another's solve. A cell's motion is a chain of smooth spells: flight in the displacement u, contact in the penetration
w = side u - d/2; `mode` says which, and no sign of a rounded number is asked. What a step meets, where and in what
state, `ode_events` says. This and `ode_contact` are the only files that import diffrax.
"""

from functools import reduce
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from vijax.engine.dense_output import SolverState, dense_output
from vijax.engine.method import ImpactOutcome, Method, decided, finished
from vijax.engine.ode_events import FIRST_STEP, LONGEST, Landing, OdeCarry, Sight, Trial, land, look, meet
from vijax.engine.ode_friction import Grip, grip, onward, rubbed
from vijax.model.flow import PI
from vijax.model.membrane import Wall
from vijax.model.pair import ImpactPair, Real
from vijax.model.records import State
from vijax.model.sides import Sides, at, named
from vijax.model.waves import Waves, begun, later, pushing
from vijax.runtime.arrays import Flag, Scalar
from vijax.runtime.xla import share

Solver = Any  # a Runge-Kutta solver of diffrax
_VANISHING = 4  # roundings: a shorter step does not advance time


class FieldArguments(eqx.Module):
    """What a smooth spell of the motion depends on: the wall it is at, and its side (0: flight).

    Friction that brakes the ball is a part of gamma; `slides` says whether it moves at all, None without friction.
    `waves` is the forcing from phase 0 on; None for the sine.
    """

    gamma: Scalar
    mode: Int[Array, ""]
    wall: Wall
    slides: Any = None
    waves: Waves | None = None


def _field(t: Any, y: SolverState, spell: FieldArguments) -> SolverState:
    held = spell.mode != 0
    push = jnp.cos(PI * t) - spell.gamma if spell.waves is None else pushing(later(spell.waves, t), spell.gamma)
    force = jnp.where(spell.mode < 0, -1.0, 1.0) * push
    pull = jnp.where(held, spell.wall(y.x, y.z), 0.0)
    work = tangent = None
    if y.work is not None:
        work = -pull * y.z
    if y.tangent is not None:
        a, b, c, d = y.tangent
        rows = [jax.jvp(spell.wall, (y.x, y.z), column)[1] for column in ((a, c), (b, d))]
        tangent = (c, d, *(jnp.where(held, row, 0.0) for row in rows))
    slope = SolverState(y.z, force + pull, work, tangent)
    return slope if spell.slides is None else jax.tree.map(lambda x: jnp.where(spell.slides, x, 0.0), slope)


equation_38 = diffrax.ODETerm(_field)
"""Eq. (38) in one spell: x'' = side (cos(pi t) - gamma) + membrane(w, w'), for `SolverState` and `FieldArguments`."""


class Ode(Method[OdeCarry]):
    """An adaptive Runge-Kutta method of diffrax with located events.

    Attributes:
        solver: One of `method_choice.SOLVERS`.
        rtol, atol: Tolerances of position and velocity, step by step.
        dt: A constant step instead, for measuring orders of convergence.
        friction: Of the capsule, over the forcing's amplitude; None without.
        harmonics: Of the forcing, from phase 0 on; None for the sine.
    """

    solver: str = eqx.field(static=True)
    rtol: Real
    atol: Real
    dt: Real | None = None
    friction: Real | None = None
    harmonics: Waves | None = None

    def waves(self, t: Any) -> Waves:
        """Give the harmonics of the forcing from phase t on."""
        return begun(self.harmonics, t)

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
            stiffest = reduce(jnp.maximum, named("kappa", pair._soft_kappa()).values())
            first, inside = zero + FIRST_STEP, jnp.minimum(FIRST_STEP, 0.1 / stiffest)
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
            slip=None if self.friction is None else self._sets_off(pair, state, x),
        )

    def _sets_off(self, pair: ImpactPair, state: State, x: Scalar) -> Scalar:
        """Say which way a ball slides at the start; 0 if it sticks."""
        friction: Any = self.friction
        wall = at(self.walls(pair), state.mode.astype(x.dtype))
        drive = jnp.cos(PI * state.t) + _push(pair, wall, state.mode, x)
        return jnp.where(state.v == 0, onward(drive, friction), jnp.sign(state.v))

    def step(
        self, pair: ImpactPair, walls: Wall | Sides, m: OdeCarry, *, recorded: bool = False
    ) -> tuple[OdeCarry, ImpactOutcome, Flag]:
        """Try one step of the solver; one that vanishes beside the time, or is not finite, makes an impact of NaN."""
        half = 0.5 * pair.d
        side, wall, grasp, trial, sight, landing = self._attempt(pair, walls, m, recorded)
        shut = landing.onset | landing.exits
        # A step on whose way something happens is not taken but tried again, up to there. One that was cut for an event
        # and has met it is taken as it is: what its dense output shows there is that same event.
        seen = trial.passes & sight.seen & ~shut & ~landing.crest
        seen, moved = decided((seen, trial.passes & ~seen))
        y = meet(half, side, wall, trial, landing)
        t = trial.t + landing.delay
        # The phase stays within one period: a time that only grew would lose digits as it does.
        over = decided(t >= 2)
        t = jnp.where(moved, jnp.where(over, t - 2, t), m.t)
        n = m.n + (moved & over).astype(m.n.dtype)
        after = State(side * half, -side * landing.speed, t, n, jnp.zeros_like(m.mode))
        outcome = finished(m, side, after, jnp.zeros_like(half) if y.work is None else y.work, y.tangent)
        # A step so short will never pass: this cell would hold its lane for ever. NaN compares false, and is lost too.
        lost = ~moved & ~(trial.h > _VANISHING * jnp.finfo(half.dtype).eps)
        outcome = eqx.tree_at(lambda p: p.impact.v_out, outcome, jnp.where(lost, jnp.nan, outcome.impact.v_out))
        y = _renewed(y, landing.exits)
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
            slip=m.slip,
        )
        if grasp is not None:
            friction: Any = self.friction
            drive = jnp.cos(PI * t) + _push(pair, wall, m.mode, new.y.x)
            new = rubbed(m, new, trial, landing.crest, grasp, drive, friction)
        return new, outcome, (landing.exits & m.entered) | lost

    def _attempt(
        self, pair: ImpactPair, walls: Wall | Sides, m: OdeCarry, recorded: bool
    ) -> tuple[Scalar, Wall, Grip | None, Trial, Sight, Landing]:
        """Try a step: at which side and wall, the grip on the ball (None without friction), and what the step shows."""
        half, held = 0.5 * pair.d, m.mode != 0
        side = jnp.where(held, m.mode.astype(half.dtype), jnp.sign(lax.stop_gradient(m.aim)))
        wall, grasp, way = at(walls, side), None, None
        spell = FieldArguments(pair.gamma, m.mode, wall, waves=self.harmonics)
        if m.slip is not None:
            friction: Any = self.friction
            spell = FieldArguments(pair.gamma + friction * m.slip, m.mode, wall, m.slip != 0)
            grasp = grip(m.t, _push(pair, wall, m.mode, m.y.x), friction)
            way = jnp.where(held, side, 1.0) * m.slip
        trial = _try(self, _solver(self, recorded), m, spell, recorded, grasp)
        sight = look(trial.dense, held, half, m.y.work is not None, m.cut & (m.aim == 0), way)
        # Nearly all that follows reads both: without `share` XLA would compute them again for each reader.
        landing, sight = share((land(m, half, trial), sight))
        return side, wall, grasp, trial, sight, landing

    def braked(self, gamma: Any, v: Any) -> Any:
        """Give what gravity would be to a ball in flight at velocity v if friction were a part of it."""
        return gamma if self.friction is None else gamma + self.friction * jnp.sign(v)

    def rests(self, pair: ImpactPair, m: OdeCarry) -> Flag:
        """Say whether friction holds the ball of a carry in flight for ever."""
        if m.slip is None:
            return jnp.zeros_like(m.cut)
        friction: Any = self.friction
        return (m.mode == 0) & (m.slip == 0) & jnp.isinf(grip(m.t, -pair.gamma, friction).wait)

    def ball(self, pair: ImpactPair, m: OdeCarry) -> State:
        """Say where the ball of a carry is."""
        side = m.mode.astype(m.y.x.dtype)
        held = m.mode != 0
        u = jnp.where(held, side * (0.5 * pair.d + m.y.x), m.y.x)
        return State(u, jnp.where(held, side * m.y.z, m.y.z), m.t, m.n, m.mode)


def _push(pair: ImpactPair, wall: Wall, mode: Int[Array, ""], x: Scalar) -> Scalar:
    """Compute what drives a ball at rest besides the forcing, in the direction of the displacement."""
    return jnp.where(mode != 0, mode.astype(x.dtype) * wall(x, jnp.zeros_like(x)), 0.0) - pair.gamma


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
    # By its defaults an integral controller: it does not read the errors of earlier steps, for which ones stand below.
    controller = diffrax.PIDController(rtol=engine.rtol, atol=engine.atol)
    t0, t1, y0, y1, error = lax.stop_gradient((t0, t1, y0, y1, error))
    (x0, z0), (x1, z1), (e_x, e_z) = ((y.x, y.z) for y in (y0, y1, error))
    one = jnp.ones_like(t0)
    keep, begin, end, _, _, _ = controller.adapt_step_size(
        t0, t1, (x0, z0), (x1, z1), None, (e_x, e_z), order, (one, one, jnp.asarray(False))
    )
    # An error that is not finite says nothing of how much shorter the step must be.
    h = end - begin
    return keep, jnp.where(jnp.isfinite(h), h, 0.2 * (t1 - t0))


def _try(
    engine: Ode,
    solver: Solver,
    m: OdeCarry,
    spell: FieldArguments,
    recorded: bool,
    grasp: Grip | None,
) -> Trial:
    """Try one step of the solver, at most to the end of the period if it is recorded, and of the grip on a ball."""
    h = jnp.minimum(lax.stop_gradient(m.h), LONGEST)
    if grasp is not None:
        h = jnp.where(spell.slides, h, jnp.minimum(h, grasp.wait))
    t = m.t + h
    if recorded:
        # The states at phase 0 are asked for: no step goes past one, and it ends there exactly, which a sum might miss.
        room = lax.stop_gradient(2 - m.t)
        ends = decided(h >= room)
        t, h = jnp.where(ends, 2.0, t), jnp.where(ends, room, h)
    no = jnp.zeros_like(m.cut)
    # The dense output needs the slope at the start; solvers whose first stage it is are handed it.
    f0 = _field(m.t, m.y, spell)
    fsal = solver.tableau.fsal
    y, error, _, last, _ = solver.step(equation_38, m.t, t, m.y, spell, (no, f0) if fsal else None, no)
    f = last[1] if fsal else _field(t, y, spell)
    y, error, f0, f = share((y, error, f0, f))
    passes, h_next = _control(engine, solver.error_order(equation_38), m.t, t, m.y, y, error)
    dense = share(dense_output(h, *lax.stop_gradient((m.y, f0, y, f))))
    return Trial(h, t, y, f, passes, h_next, dense)


def _renewed(y: SolverState, exits: Flag) -> SolverState:
    """Begin a tangent map at an exit: those of impacts are from exit to exit, and whoever adds them up multiplies."""
    if y.tangent is None:
        return y
    unit = (1.0, 0.0, 0.0, 1.0)
    fresh = tuple(jnp.where(exits, one, value) for one, value in zip(unit, y.tangent, strict=True))
    return eqx.tree_at(lambda y: y.tangent, y, fresh)


def _lengths(engine: Ode, m: OdeCarry, trial: Trial, sight: Sight, seen: Flag, moved: Flag, shut: Flag):
    """Say how long the next step is, the one to go on with after a cut one, and the one after the next change of mode.

    A change of mode changes the scale of time: each mode goes on with the length that it had.
    """
    ahead = trial.h_next if engine.dt is not None else jnp.maximum(trial.h_next, m.h)  # m.h: was capped
    ahead = jnp.minimum(jnp.where(m.cut, m.full, ahead), LONGEST)
    after = jnp.where(shut, m.other, jnp.where(moved, ahead, trial.h_next))
    h = jnp.where(seen, sight.theta * trial.h, after)
    return lax.stop_gradient((h, jnp.where(seen, ahead, m.full), jnp.where(shut, m.full, m.other)))
