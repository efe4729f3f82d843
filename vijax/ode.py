"""The stepping engine: diffrax's Runge-Kutta steps with located events, on the same seam as the exact engine.

One `step` of a lane is one attempt of a solver step, accepted, rejected or cut short, so that no lane waits for
another's solve. A cell's motion is a chain of smooth spells: flight in the displacement u, contact in the penetration
w = side u - d/2; `mode` says which, and no sign of a rounded number is asked. The wall is met where the dense output of
a step first crosses it; the step is then repeated up to there, and what is missing is closed by the Taylor polynomial
of the repeated step, so that the state has the order of the solver and not that of the dense output.

This is the only file that imports diffrax.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.flow import PI, share
from vijax.membrane import Wall
from vijax.method import Ode, Passage
from vijax.model import Impact, ImpactPair, MembranePair, State

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]

_LONGEST = 0.25  # longest step: the acceleration changes its sign at most once within it, but for |gamma| close to 1
_CLOSED = 1e-4  # of the repeated step: the Taylor polynomial of second order closes what is less, to 1e-13 of the step
_ATTEMPTS = 6  # repeats after which a crossing is taken as it is: rounding holds it from closing
_TRIPS = 5  # of a root on the dense output; a crossing missed by more than _CLOSED is located again
_FIRST_STEP = 1e-3


# --- vector fields --------------------------------------------------------------------------------


class Point(eqx.Module):
    """A state of the solver: u and u' in flight, w and w' in contact; where asked for, the work and the tangent map."""

    x: Scalar
    z: Scalar
    work: Scalar | None = None
    tangent: tuple[Scalar, Scalar, Scalar, Scalar] | None = None


class Spell(eqx.Module):
    """What a smooth spell of the motion depends on: the wall it is at, and its side (0: flight)."""

    gamma: Scalar
    mode: Int[Array, ""]
    wall: Wall


def _field(t: Scalar, y: Point, spell: Spell) -> Point:
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
    return Point(y.z, force + pull, work, tangent)


equation_38 = diffrax.ODETerm(_field)
"""Eq. (38) in one spell: x'' = side (cos(pi t) - gamma) + membrane(w, w'), for `Point` and `Spell`."""


def _field_39(t: Scalar, y: Point, args: tuple[MembranePair, Int[Array, ""]]) -> Point:
    pair, mode = args
    side = jnp.sign(mode).astype(y.x.dtype)
    pull = jnp.where(mode == 0, 0.0, y.x - 0.5 * side + pair.c_star * y.z)
    return Point(y.z, pair.A_star * jnp.cos(pair.omega_star * t) - pair.g_star - pull)


equation_39 = diffrax.ODETerm(_field_39)
"""Eq. (39), lengths in units of s and times in units of 1/omega0: for `Point` (x, x') and (`MembranePair`, mode)."""


# --- one solver step ------------------------------------------------------------------------------


class Motion(eqx.Module):
    """The carry of a lane: where the ball is, the step it will try, and what its contact has seen so far."""

    y: Point
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


_CREST = 2.0  # as an aim


def _solver(engine: Ode, kind: str) -> diffrax.AbstractAdaptiveSolver:
    solver = getattr(diffrax, engine.solver)
    if issubclass(solver, diffrax.AbstractImplicitSolver):
        return solver(scan_kind=kind, root_finder=diffrax.VeryChord(engine.rtol, engine.atol))
    return solver(scan_kind=kind)


def start(engine: Ode, pair: ImpactPair, state: State, *, deep: bool, tangent: bool) -> Motion:
    """The carry of a start, in flight or inside a wall (then a contact without onset, which ends in no impact).

    Args:
        engine: The method's numbers.
        pair: One cell (scalars), soft.
        state: Where the ball is; its mode is believed.
        deep: Whether greatest depths and works are wanted.
        tangent: Whether tangent maps are wanted.
    """
    zero, whole = jnp.zeros_like(state.u), jnp.zeros_like(state.n)
    side = state.mode.astype(zero.dtype)
    held = state.mode != 0
    x = jnp.where(held, side * state.u - 0.5 * pair.d, state.u)
    first = zero + (_FIRST_STEP if engine.dt is None else engine.dt)
    inside = first if engine.dt is not None else jnp.minimum(first, 0.1 / pair.kappa)
    no = jnp.zeros_like(held)
    return Motion(
        y=Point(
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


def _control(engine: Ode, order: float, t0: Scalar, t1: Scalar, y0: Point, y1: Point, error: Point):
    """Whether a step is accepted, and the length of the next; the error of position and velocity alone decides."""
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


class Dense(eqx.Module):
    """Dense output of a step at theta in [0, 1]: the quintic through position, velocity and acceleration at both ends.

    A second-order equation gives it for nothing, and it is of higher order than diffrax's own interpolants.
    """

    c0: Scalar
    c1: Scalar
    c2: Scalar
    c3: Scalar
    c4: Scalar
    c5: Scalar

    def place(self, s: Scalar) -> Scalar:
        """Position."""
        return self.c0 + s * (self.c1 + s * (self.c2 + s * (self.c3 + s * (self.c4 + s * self.c5))))

    def rate(self, s: Scalar) -> Scalar:
        """Derivative of the position by theta."""
        return self.c1 + s * (2 * self.c2 + s * (3 * self.c3 + s * (4 * self.c4 + s * (5 * self.c5))))

    def bend(self, s: Scalar) -> Scalar:
        """Second derivative."""
        return 2 * self.c2 + s * (6 * self.c3 + s * (12 * self.c4 + s * (20 * self.c5)))

    def jerk(self, s: Scalar) -> Scalar:
        """Third derivative."""
        return 6 * self.c3 + s * (24 * self.c4 + s * (60 * self.c5))


def dense_output(h: Scalar, y0: Point, f0: Point, y1: Point, f1: Point) -> Dense:
    """The dense output of a step of length h from the states at its ends and their derivatives."""
    z, a = y0.z * h, f0.z * h * h
    rise, gain, change = y1.x - y0.x - z - 0.5 * a, y1.z * h - z - a, f1.z * h * h - a
    return Dense(
        y0.x,
        z,
        0.5 * a,
        10 * rise - 4 * gain + 0.5 * change,
        -15 * rise + 7 * gain - change,
        6 * rise - 3 * gain + 0.5 * change,
    )


def _root(function, low: Scalar, high: Scalar) -> Scalar:
    """Root of a rising function in [low, high], by Newton's iteration with bisection where it leaves the bracket."""
    x = 0.5 * (low + high)
    for _ in range(_TRIPS):
        value, slope = function(x)
        low, high = jnp.where(value <= 0, x, low), jnp.where(value > 0, x, high)
        newton = x - value / jnp.where(slope > 0, slope, jnp.inf)
        inside = (slope > 0) & (newton >= low) & (newton <= high)
        x = share(jnp.where(inside, newton, 0.5 * (low + high)))
    return x


class _Sight(eqx.Module):
    """What the dense output of a step shows: the part of the step to keep to, and the event there."""

    seen: Flag
    theta: Scalar
    aim: Scalar


def _look(dense: Dense, mode: Int[Array, ""], half: Scalar, z1: Scalar, deep: bool, cut: Flag) -> _Sight:
    """The first wall crossing of a step, the crest of a contact before it, or a second turning of the velocity.

    A velocity that changes sign between the ends turns once; the position is monotone up to there and from there on,
    so each crossing is bracketed, and of two the earlier is found. Where the acceleration changes sign (at most once,
    as a step is at most _LONGEST) the velocity is extreme: if it has changed sign there and back, the step is cut at
    that place, and the next look sees one turning at a time.
    """
    one, zero = jnp.ones_like(z1), jnp.zeros_like(z1)
    held = mode != 0
    z0 = dense.c1
    heading = jnp.where(z0 == 0, jnp.sign(z1), jnp.sign(z0))
    turns = heading * z1 < 0
    turning = _root(lambda s: (-heading * dense.rate(s), -heading * dense.bend(s)), zero, one)
    middle = jnp.where(turns, turning, one)
    a0, a1 = dense.c2, dense.bend(one)
    bends = (a0 * a1 < 0) & ~turns & ~cut
    rising = jnp.sign(a1)
    bend = _root(lambda s: (rising * dense.bend(s), rising * dense.jerk(s)), zero, one)
    twice = bends & (heading * dense.rate(bend) < 0)
    # The goal ahead and behind: a wall in flight, and in contact the membrane's rest from above.
    wall = jnp.where(held, 0.0, half)
    may_first, may_second = ~held | (heading < 0), ~held | (heading > 0)
    first = may_first & (heading * dense.place(middle) > wall)
    second = turns & ~first & may_second & (-heading * dense.place(one) > wall)
    aim = jnp.where(first, heading, -heading)
    low, high = jnp.where(first, 0.0, middle), jnp.where(first, middle, 1.0)
    crossing = _root(lambda s: (aim * dense.place(s) - wall, aim * dense.rate(s)), low, high)
    crest = turns & held & (heading > 0) if deep else jnp.zeros_like(turns)
    theta = jnp.where(twice, bend, jnp.where(crest, turning, crossing))
    aim = jnp.where(twice, 0.0, jnp.where(crest, _CREST, aim))
    return _Sight(twice | crest | first | second, theta, aim)


class _Landing(eqx.Module):
    """Whether a step that was cut for an event has met it, how far off in time it is, and the speed there."""

    met: Flag
    crest: Flag
    delay: Scalar
    speed: Scalar


def _land(m: Motion, h: Scalar, half: Scalar, y1: Point, push: Scalar) -> _Landing:
    """Close the gap that the repeated step leaves, to second order: aim (x + z s + push s^2/2) = wall.

    The root is -2 gap/(speed + sqrt(speed^2 - 2 push gap)), and the speed there is that square root. A ball that turns
    just before the wall has none, and has not met it. Its derivatives are those of the true event: the lengths of steps
    are constants to them.
    """
    held = m.mode != 0
    towards = (m.aim != 0) & (m.aim != _CREST)
    aim = lax.stop_gradient(m.aim)
    gap = aim * y1.x - jnp.where(held, 0.0, half)
    speed, drive = aim * y1.z, aim * push
    square = speed * speed - 2 * drive * gap
    root = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    both = speed + root
    delay = -2 * gap / jnp.where(both > 0, both, jnp.inf)
    real = ((square >= 0) | (gap > 0)) & ((root > 0) | (drive > 0))
    tops = (m.aim == _CREST) & (push < 0)
    delay = jnp.where(tops, -y1.z / jnp.where(tops, push, -1.0), delay)
    near = (jnp.abs(delay) <= _CLOSED * h) | (m.attempts >= _ATTEMPTS)
    return _Landing(towards & near & real, tops & near, delay, root)


def _ratio(change: Scalar, speed: Scalar) -> Scalar:
    """Jump of the acceleration over the speed of crossing: the one entry of a soft saltation matrix."""
    moving = speed != 0
    return jnp.where(moving, change / jnp.where(moving, speed, 1.0), 0.0)


def step(
    engine: Ode, pair: ImpactPair, wall: Wall, m: Motion, *, recorded: bool = False
) -> tuple[Motion, Passage, Flag]:
    """Try one step of the solver.

    Args:
        engine: The method's numbers.
        pair: One cell (scalars).
        wall: Its membrane, (w, w') -> acceleration.
        m: The carry, from `start` or an earlier step.
        recorded: For trajectories: a step ends at phase 0, and can be differentiated in reverse.

    Returns:
        The carry after it, and the impact that this step finished, meaningless unless the flag says that it did.
        A step length that is not finite or vanishes beside the time makes an impact of NaN.
    """
    half = 0.5 * pair.d
    solver = _solver(engine, "bounded" if recorded else "lax")
    spell = Spell(pair.gamma, m.mode, wall)
    h = jnp.minimum(lax.stop_gradient(m.h), _LONGEST)
    room = lax.stop_gradient(2 - m.t)
    to_strobe = (h >= room) if recorded else jnp.zeros_like(m.cut)
    h = jnp.where(to_strobe, room, h)
    t1 = jnp.where(to_strobe, 2.0, m.t + h)
    f0 = _field(m.t, m.y, spell)
    no = jnp.zeros_like(m.cut)
    fsal = solver.tableau.fsal
    y1, error, _, last, _ = solver.step(equation_38, m.t, t1, m.y, spell, (no, f0) if fsal else None, no)
    f1 = last[1] if fsal else _field(t1, y1, spell)
    y1, error, f0, f1 = share((y1, error, f0, f1))
    keep, h_next = _control(engine, solver.error_order(equation_38), m.t, t1, m.y, y1, error)

    landing = _land(m, h, half, y1, f1.z)
    dense = share(dense_output(h, *lax.stop_gradient((m.y, f0, y1, f1))))
    sight = _look(dense, m.mode, half, lax.stop_gradient(y1.z), m.y.work is not None, m.cut & (m.aim == 0))
    met, crest = keep & landing.met, keep & landing.crest
    met, crest, sight, delay, speed, keep, h_next = share(
        (met, crest, sight, landing.delay, landing.speed, keep, h_next)
    )
    seen = keep & sight.seen & ~met & ~crest
    moved = keep & ~seen
    return _advance(
        engine, pair, spell, m, y1, f1, t1, h, h_next, seen, sight, moved, met, crest, delay, speed, to_strobe
    )


def _advance(engine, pair, spell, m, y1, f1, t1, h, h_next, seen, sight, moved, met, crest, delay, speed, to_strobe):
    """The carry after a step that was looked at, and the impact that it finished."""
    shift = met | crest
    delay = jnp.where(shift, delay, 0.0)
    y1 = jax.tree.map(lambda y, f: y + delay * f, y1, f1)
    onset, leaves = met & (m.mode == 0), met & (m.mode != 0)
    side = jnp.where(m.mode == 0, lax.stop_gradient(m.aim), m.mode.astype(h.dtype))
    # In flight a speed is towards the wall, in contact it is away from it.
    x = jnp.where(
        onset, 0.0, jnp.where(leaves, side * 0.5 * pair.d, jnp.where(crest, y1.x - 0.5 * delay * delay * f1.z, y1.x))
    )
    z = jnp.where(onset, speed, jnp.where(leaves, -side * speed, jnp.where(crest, 0.0, y1.z)))
    zero = jnp.zeros_like(h)
    depth = jnp.where(onset, 0.0, jnp.where(crest, jnp.maximum(m.depth, x), m.depth))
    work = tangent = mapped = None
    if y1.work is not None:
        work = jnp.where(onset, 0.0, y1.work)
    if y1.tangent is not None:
        a, b, c, d = y1.tangent
        jump = jnp.where(onset, _ratio(spell.wall(zero, speed), speed), 0.0)
        jump = jnp.where(leaves, _ratio(spell.wall(zero, -speed), speed), jump)
        mapped = (a, b, c + jump * a, d + jump * b)
        unit = (1.0, 0.0, 0.0, 1.0)
        tangent = tuple(jnp.where(leaves, one, value) for one, value in zip(unit, mapped, strict=True))
    t = t1 + delay
    over = t >= 2
    t, n = jnp.where(over, t - 2, t), m.n + over.astype(m.n.dtype)
    t, n = jnp.where(moved, t, m.t), jnp.where(moved, n, m.n)
    mode = jnp.where(onset, side.astype(m.mode.dtype), jnp.where(leaves, 0, m.mode))
    v_out = -side * speed

    def since(t_0, n_0):
        return (t - t_0) + 2 * (n - n_0).astype(t.dtype)

    ends = leaves & m.entered
    eps = jnp.finfo(h.dtype).eps
    lost = ~moved & ~(h > 4 * eps)
    blank = jnp.where(lost, jnp.nan, 0.0)
    impact = Impact(
        n=m.onset_n,
        t=m.onset_t,
        side=side.astype(m.mode.dtype),
        v_in=m.v_in,
        v_out=v_out + blank,
        depth=m.depth,
        duration=since(m.onset_t, m.onset_n),
        work=zero if work is None else work,
    )
    after = State(side * 0.5 * pair.d, v_out, t, n, jnp.zeros_like(m.mode))
    flight = (m.onset_t - m.left_t) + 2 * (m.onset_n - m.left_n).astype(t.dtype)
    passage = Passage(impact, flight, after, mapped)

    reached = jnp.where(m.cut, m.full, jnp.maximum(h_next, m.h) if engine.dt is None else h_next)
    reached = jnp.minimum(reached, _LONGEST)
    h_after = jnp.where(seen, sight.theta * h, jnp.where(met, m.other, jnp.where(moved, reached, h_next)))
    new = Motion(
        y=jax.tree.map(lambda new, old: jnp.where(moved, new, old), Point(x, z, work, tangent), m.y),
        t=t,
        n=n,
        mode=mode,
        h=lax.stop_gradient(h_after),
        full=lax.stop_gradient(jnp.where(seen & ~m.cut, reached, m.full)),
        other=lax.stop_gradient(jnp.where(met, m.full, m.other)),
        cut=seen,
        aim=lax.stop_gradient(jnp.where(seen, sight.aim, 0.0)),
        attempts=jnp.where(seen, m.attempts + 1, 0),
        onset_t=jnp.where(onset, t, m.onset_t),
        onset_n=jnp.where(onset, n, m.onset_n),
        entered=(m.entered | onset) & ~leaves,
        v_in=jnp.where(onset, side * speed, m.v_in),
        depth=depth,
        left_t=jnp.where(leaves, t, m.left_t),
        left_n=jnp.where(leaves, n, m.left_n),
        steps=m.steps + 1,
    )
    return new, passage, ends | lost


def ball(pair: ImpactPair, method: Ode, m: Motion) -> State:
    """Where the ball of a carry is."""
    side = m.mode.astype(m.y.x.dtype)
    held = m.mode != 0
    u = jnp.where(held, side * (0.5 * pair.d + m.y.x), m.y.x)
    return State(u, jnp.where(held, side * m.y.z, m.y.z), m.t, m.n, m.mode)
