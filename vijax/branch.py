"""Branches of periodic orbits along a parameter, by pseudo-arclength continuation through folds, many at once.

The orbit's equations go on through grazing into orbits that are none (`shooting`); what makes an orbit real, and what
marks a bifurcation, are smooth functions along the branch. A sign change is located on the arc, and says which it was.
"""

from collections.abc import Iterator, Sequence as Many
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax import flow, orbit as orbits, shooting
from vijax.model import Harvester, ImpactPair, Status
from vijax.orbit import Orbit
from vijax.shooting import Sequence

ALONG = ("d", "kappa", "r", "gamma", "omega")
_CHUNK = 32  # steps of one compiled call
_LONGEST, _SHORTEST = 0.01, 1e-9  # arclength of a step; the parameter's range counts as one
_FIRST = 1e-3
_CROWDED = 1e-7  # arclength within which several things may happen unresolved
_ROUNDS = 6  # Newton corrections of a step, at most
_CLOSE = 1e-11  # size of the last correction
_BEND = 0.98  # least cosine between the tangents at the ends of a step
_SAMPLES = 48  # of a flight or contact, to find its extrema
_NOTHING = 1.0  # clearance where there is nothing to clear
_ZERO = 1e-3  # part of a test function's ends that is zero
_LEVEL = 1e-4  # asymmetry of an orbit that turns where it meets its mirror image
_NARROWINGS = 40  # of an interval that holds an event: false position with every third step a bisection


class Arc(eqx.Module):
    """What a lane follows: the orbit's parameters where it began, its walls, and which parameter moves.

    Attributes:
        ratio: s/A of the device, that fixes d at a frequency (along="omega" only).
        scale: Range of the parameter, the unit of its share of the arclength.
    """

    pair: ImpactPair
    sequence: Sequence
    ratio: Float[Array, ""]
    low: Float[Array, ""]
    high: Float[Array, ""]
    along: str = eqx.field(static=True)

    def at(self, x: Float[Array, ""]) -> ImpactPair:
        """The pair at a value of the parameter."""
        if self.along != "omega":
            return eqx.tree_at(lambda pair: getattr(pair, self.along), self.pair, x)
        d = self.ratio * (x / flow.PI) ** 2
        kappa = None if self.pair.kappa is None else self.pair.kappa * jnp.sqrt(self.pair.d / d)
        return ImpactPair(d, kappa, self.pair.r, self.pair.gamma)


class _Place(NamedTuple):
    """A point of a branch in the space of knots and parameter, the tangent there, and the test functions."""

    y: Float[Array, "unknown"]  # knots, then the parameter over its range
    tangent: Float[Array, "unknown"]
    tests: "Tests"


class Tests(NamedTuple):
    """Functions whose sign changes mark what happens on a branch; those from `speed` on are positive on real orbits."""

    fold: Float[Array, ""]  # the parameter's share of the tangent
    plus: Float[Array, ""]  # det(M - 1): a multiplier passes +1
    minus: Float[Array, ""]  # det(M + 1): a multiplier passes -1
    speed: Float[Array, ""]  # least speed into a wall: an impact vanishes
    flight: Float[Array, ""]  # least room at a turning point in flight: an impact appears
    contact: Float[Array, ""]  # least penetration at a turning point in contact: it splits
    exit: Float[Array, ""]  # least speed away from a wall: the ball stays
    low: Float[Array, ""]
    high: Float[Array, ""]


def _unpack(arc: Arc, y):
    width = arc.sequence.side.shape[0]
    return y[:-1].reshape(width, 3), y[-1] * (arc.high - arc.low)


def _equations(arc: Arc, y) -> shooting.Linear:
    """Gap and its derivatives in knots and parameter."""
    knots, x = _unpack(arc, y)
    pair, moved = jax.jvp(arc.at, (x,), (arc.high - arc.low,))
    return shooting.linearise(pair, arc.sequence, knots, moved)


class _Arrival(NamedTuple):
    """Newton's way back to the branch: the point, the tangent there, the size of the last correction, how many."""

    y: Float[Array, "unknown"]
    tangent: Float[Array, "unknown"]
    size: Float[Array, ""]
    trips: Int[Array, ""]


def _correct(arc: Arc, guess, former) -> _Arrival:
    """Newton in the plane across the former tangent; the new tangent is that of the last correction but its own size."""
    ahead = jnp.zeros_like(guess).at[-1].set(1.0)

    def once(at: _Arrival) -> _Arrival:
        gap, slope = _equations(arc, at.y)
        slope = jnp.concatenate([slope, former[None]])
        miss = jnp.append(gap, former @ (at.y - guess))
        step, tangent = jnp.linalg.solve(slope, jnp.stack([miss, ahead], axis=1)).T
        return _Arrival(at.y - step, tangent / jnp.linalg.norm(tangent), jnp.abs(step).max(), at.trips + 1)

    def going(at: _Arrival):
        return (at.size > _CLOSE) & (at.size < 1.0) & (at.trips < _ROUNDS)

    return lax.while_loop(going, once, _Arrival(guess, former, jnp.asarray(0.5, guess.dtype), jnp.int32(0)))


def _turning_points(position, velocity, acceleration, length):
    """Positions at the zeros of the velocity inside a stretch, and its sign before each; NaN where there is none."""
    s = jnp.linspace(0.0, 1.0, _SAMPLES + 1) * length
    v = velocity(s)
    low, high, before, after = s[:-1], s[1:], v[:-1], v[1:]
    turns = before * after < 0
    at = low + (high - low) * before / jnp.where(turns, before - after, 1.0)
    for _ in range(2):
        at = jnp.clip(at - velocity(at) / acceleration(at), low, high)
    return jnp.where(turns, position(at), jnp.nan), before


def _flight_room(pair: ImpactPair, passage: shooting.Passage):
    """Least distance from a wall at a turning point of the flight that follows each contact."""

    def one(side, speed, t, next_t):
        place = lambda s: 0.5 * side * pair.d + flow.flight(pair.gamma, t, -side * speed, s)[0]  # noqa: E731
        velocity = lambda s: flow.flight(pair.gamma, t, -side * speed, s)[1]  # noqa: E731
        u, before = _turning_points(place, velocity, lambda s: flow.acceleration(pair.gamma, t + s), next_t - t)
        room = jnp.where(before > 0, 0.5 * pair.d - u, 0.5 * pair.d + u)
        return jnp.nanmin(jnp.append(room, _NOTHING))

    return jax.vmap(one)(passage.side, passage.speed, passage.t, passage.next_t)


def _contact_room(pair: ImpactPair, passage: shooting.Passage, knots):
    """Least penetration at a turning point inside each contact where it is a minimum."""
    if pair.kappa is None:
        return jnp.full(passage.side.shape, _NOTHING)
    wall = flow.membrane(pair, rolled=True)

    def one(side, knot):
        t, speed, stay = knot
        force = flow.contact_force(pair.gamma, side, t)

        def motion(s):
            return jax.vmap(lambda s: flow.oscillate(wall, force, jnp.zeros_like(s), speed, s))(s)

        def bend(s):
            w, rate = motion(s)
            return jax.vmap(force.at)(s) - wall.mu * rate - wall.kappa * wall.kappa * w

        w, before = _turning_points(lambda s: motion(s)[0], lambda s: motion(s)[1], bend, jnp.maximum(stay, 0.0))
        return jnp.nanmin(jnp.append(jnp.where(before < 0, w, jnp.nan), _NOTHING))

    return jax.vmap(one)(passage.side, knots)


def _tests(arc: Arc, y, tangent) -> Tests:
    knots, x = _unpack(arc, y)
    pair, real = arc.at(x), arc.sequence.real
    around = shooting.monodromy(pair, arc.sequence, knots)
    trace, determinant = around[0, 0] + around[1, 1], jnp.linalg.det(around)
    # Padded impacts are given harmless knots.
    knots = jnp.where(real[:, None], knots, 1.0)
    passage = shooting.passages(pair, arc.sequence, knots)

    def least(values):
        return jnp.where(real, values, _NOTHING).min()

    return Tests(
        fold=tangent[-1],
        plus=1 - trace + determinant,
        minus=1 + trace + determinant,
        speed=least(knots[:, 1]),
        flight=least(_flight_room(pair, passage)),
        contact=least(_contact_room(pair, passage, knots)),
        exit=jnp.full_like(x, _NOTHING) if pair.kappa is None else least(passage.speed),
        low=x - arc.low,
        high=arc.high - x,
    )


def _happenings(before: Tests, after: Tests):
    """How many things happen between two points; a multiplier that passes +1 at a fold is one of them."""
    changed = Tests(*(jnp.sign(a) != jnp.sign(b) for a, b in zip(before, after, strict=True)))
    real = jnp.stack(changed[Tests._fields.index("speed") :]).any()
    return sum(x.astype(jnp.int32) for x in (changed.fold | changed.plus, changed.minus, real))


def _is_real(tests: Tests):
    return jnp.stack(tests[Tests._fields.index("speed") :]).min(axis=0) > 0


class _Walk(NamedTuple):
    """A lane's way along its branch: where it is, how long the next step is, whether it goes on."""

    place: _Place
    length: Float[Array, ""]
    going: Bool[Array, ""]


def _step(arc: Arc, walk: _Walk) -> tuple[_Walk, tuple[_Place, Array, Array]]:
    """Try one step; returns the walk after it, and what was reached, with how long a step, and whether it counts."""
    here = walk.place
    y, tangent, size, trips = _correct(arc, here.y + walk.length * here.tangent, here.tangent)
    there = _Place(y, tangent, _tests(arc, y, tangent))
    straight = tangent @ here.tangent
    near = jnp.linalg.norm(y - here.y) < 2 * walk.length
    single = (_happenings(here.tests, there.tests) <= 1) | (walk.length < _CROWDED)
    good = walk.going & (size <= _CLOSE) & (straight > _BEND) & near & single
    easy = good & (trips <= 3) & (straight > 1 - 0.2 * (1 - _BEND))
    length = jnp.where(good, jnp.where(easy, jnp.minimum(1.5 * walk.length, _LONGEST), walk.length), 0.5 * walk.length)
    going = walk.going & (length > _SHORTEST) & ~(good & ~_is_real(there.tests))
    place = jax.tree.map(lambda new, old: jnp.where(good, new, old), there, here)
    return _Walk(place, length, going), (there, walk.length, good)


@jax.jit
def _begin(arcs: Arc, y, heading) -> _Walk:
    def one(arc, y, heading):
        y, tangent, *_ = _correct(arc, y, heading)
        return _Walk(_Place(y, tangent, _tests(arc, y, tangent)), jnp.asarray(_FIRST, y.dtype), jnp.asarray(True))

    return jax.vmap(one)(arcs, y, heading)


@jax.jit
def _walk(arcs: Arc, walk: _Walk):
    def steps(arc, walk):
        return lax.scan(lambda w, _: _step(arc, w), walk, None, length=_CHUNK)

    return jax.vmap(steps)(arcs, walk)


@jax.jit
def _locate(arcs: Arc, here: _Place, length, test):
    """The arclength from `here`, up to `length`, of a test function's zero, the point, and whether it is no pole."""

    def one(arc, here, length, test):
        def look(s):
            y, tangent, *_ = _correct(arc, here.y + s * here.tangent, here.tangent)
            return y, jnp.stack(_tests(arc, y, tangent))[test]

        def narrow(trip, carry):
            low, high, f_low, f_high, best, f_best = carry
            chord = low - f_low * (high - low) / jnp.where(f_high == f_low, 1.0, f_high - f_low)
            inside = (chord > low) & (chord < high) & (trip % 3 != 2)
            s = jnp.where(inside, chord, 0.5 * (low + high))
            f = look(s)[1]
            left = jnp.sign(f) == jnp.sign(f_low)
            closer = jnp.abs(f) < jnp.abs(f_best)
            return (
                jnp.where(left, s, low),
                jnp.where(left, high, s),
                jnp.where(left, f, 0.5 * f_low),  # Illinois: the end that stays counts half
                jnp.where(left, 0.5 * f_high, f),
                jnp.where(closer, s, best),
                jnp.where(closer, f, f_best),
            )

        f_high = look(length)[1]
        start = (jnp.zeros_like(length), length, jnp.stack(here.tests)[test], f_high, length, f_high)
        *_, s, f = lax.fori_loop(0, _NARROWINGS, narrow, start)
        return s, look(s)[0], jnp.abs(f) <= _ZERO * (jnp.abs(start[2]) + jnp.abs(f_high))

    return jax.vmap(one)(arcs, here, length, test)


class Point(NamedTuple):
    """What a branch met: fold, flip, pitchfork, grazing (and of what), or a bound of the parameter.

    Attributes:
        kind: "fold", "flip" (a multiplier is -1), "pitchfork" (mirror symmetry breaks), "grazing flight" (an impact
            appears), "grazing impact" (one vanishes), "grazing contact" (one splits), "grazing exit" (the ball stays).
        value: Of the parameter.
        orbit: The orbit there, along a leading axis of one.
    """

    kind: str
    value: float
    orbit: Orbit


class Branch(NamedTuple):
    """A branch of real orbits in the order in which they were followed.

    Attributes:
        along: The parameter.
        values: Of the parameter, one an orbit.
        orbit: The orbits, with multipliers.
        points: What was met on the way, in order.
        ends: Why it stops at its first and at its last orbit: "start", a kind of `Point` where no orbit goes on, "low"
            or "high" (bound of the parameter), "points" (as many as asked for), "lost" (no step was short enough).
    """

    along: str
    values: np.ndarray
    orbit: Orbit
    points: list[Point]
    ends: tuple[str, str]

    @property
    def stable(self) -> np.ndarray:
        """Whether each orbit attracts."""
        return np.abs(np.asarray(self.orbit.multipliers)).max(axis=1) < 1


_NAMES = {"speed": "impact", "flight": "flight", "contact": "contact", "exit": "exit"}


def follow(
    orbit: Orbit,
    along: str,
    within: tuple[float, float],
    *,
    direction: str = "both",
    device: Harvester | None = None,
    points: int = 4000,
) -> list[Branch]:
    """Follow periodic orbits, stable or not, along one parameter, through folds.

    Args:
        orbit: Where to start, each a branch of its own; all at once.
        along: "d", "kappa", "r", "gamma", or "omega" [rad/s] at fixed device.
        within: Bounds of the parameter; the starts lie between.
        direction: "up" or "down" in the parameter at first, or "both".
        device: For "omega": its s and A say at which omega the orbit is.
        points: Most orbits of a branch each way.

    Returns:
        One branch an orbit. A branch ends where its orbits cease to be real (a grazing), at a bound, or says why else.

    Raises:
        ValueError: An unknown parameter or direction, bounds in the wrong order or without the start, or an orbit that
            is none.
    """
    arcs, y = _set_out(orbit, along, within, device)
    ways = {"up": (1.0,), "down": (-1.0,), "both": (-1.0, 1.0)}
    if direction not in ways:
        raise ValueError(f'direction must be "up", "down" or "both"; got {direction!r}')
    ahead = jnp.zeros_like(y).at[:, -1].set(1.0)
    found = [_follow(arcs, y, sign * ahead, along, points) for sign in ways[direction]]
    return found[0] if len(found) == 1 else [_joined(*both) for both in zip(*found, strict=True)]


def _set_out(orbit: Orbit, along: str, within: tuple[float, float], device: Harvester | None):
    """Arcs and unknowns of the starts; what cannot be followed is refused."""
    if along not in ALONG or (along == "kappa" and orbit.pair.kappa is None):
        rigid = "; a rigid wall has no kappa" if orbit.pair.kappa is None else ""
        raise ValueError(f"along must be one of {', '.join(ALONG)}; got {along!r}{rigid}")
    low, high = map(float, within)
    if not low < high:
        raise ValueError(f"within must be two bounds, the lower first; got {within}")
    if (np.asarray(orbit.status) != Status.OK).any():
        index = int(np.argmax(np.asarray(orbit.status) != Status.OK))
        raise ValueError(f"orbit must hold orbits only; got {Status(int(orbit.status[index])).name} at index {index}")
    device = Harvester() if device is None else device
    size = len(orbit)
    ratio = jnp.full(size, device.s / device.A)
    x = flow.PI * jnp.sqrt(orbit.pair.d / ratio) if along == "omega" else getattr(orbit.pair, along)
    if not bool(((x >= low) & (x <= high)).all()):
        raise ValueError(f"within must hold the start; got {within} and {along} = {float(x[0]):.6g}")
    if along == "gamma" and bool(orbit.sequence.mirrored.any()):
        raise ValueError("orbit must not be closed half way to follow it along gamma; unfold it first")
    arcs = Arc(orbit.pair, orbit.sequence, ratio, jnp.full(size, low), jnp.full(size, high), along)
    knots = jnp.where(orbit.sequence.real[..., None], orbit.knots, 0.0).reshape(size, -1)
    return arcs, jnp.concatenate([knots, (x / (high - low))[:, None]], axis=1)


def _follow(arcs: Arc, y, tangent, along: str, points: int) -> list[Branch]:
    """One way from every start: all lanes together, chunk by chunk, until none goes on."""
    walk = _begin(arcs, y, tangent)
    reached = [jax.tree.map(lambda leaf: np.asarray(leaf)[:, None], (walk.place, walk.length, walk.going))]
    for _ in range(0, points, _CHUNK):
        walk, chunk = _walk(arcs, walk)
        reached.append(jax.tree.map(np.asarray, chunk))
        if not walk.going.any():
            break
    places, lengths, good = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *reached)
    return [
        _branch(
            jax.tree.map(lambda leaf, i=lane: leaf[i], arcs),
            *jax.tree.map(lambda leaf, i=lane: leaf[i][good[i]], (places, lengths)),
            along,
            bool(walk.going[lane]),
        )
        for lane in range(y.shape[0])
    ]


def _branch(arc: Arc, places: _Place, lengths: np.ndarray, along: str, unfinished: bool) -> Branch:
    """A lane's record as a branch: what was met between its points, and where it ends."""
    real = np.asarray(_is_real(Tests(*map(jnp.asarray, places.tests))))
    events = sorted(_events(arc, places, lengths), key=lambda event: event[:2])
    last = len(real)
    end = "points" if unfinished else "lost"
    points = []
    for index, _, name, y in events:
        kind = _kind(arc, name, y, places.y[index : index + 2])
        if kind in ("low", "high"):
            end = kind
        else:
            points.append(Point(kind, float(y[-1] * (arc.high - arc.low)), _orbits(arc, y[None])))
            end = kind if name in _NAMES else end
        if not real[index + 1]:
            last = index + 1
    ys = places.y[:last]
    return Branch(along, ys[:, -1] * float(arc.high - arc.low), _orbits(arc, ys), points, ("start", end))


def _events(arc: Arc, places: _Place, lengths: np.ndarray) -> Iterator[tuple[int, float, str, np.ndarray]]:
    """Sign changes between neighbours: index of the first, arclength from there, which test, the point."""
    tests = np.stack(places.tests, axis=1)
    index, test = np.nonzero(np.sign(tests[:-1]) * np.sign(tests[1:]) < 0)
    if not index.size:
        return
    # A power of two of them, so that few programs are compiled.
    size = 1 << (index.size - 1).bit_length()
    rows, which = np.resize(index, size), np.resize(test, size)
    here = jax.tree.map(lambda leaf: jnp.asarray(leaf[rows]), places)
    wide = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (size, *leaf.shape)), arc)
    s, y, zero = jax.tree.map(np.asarray, _locate(wide, here, jnp.asarray(lengths[rows + 1]), jnp.asarray(which)))
    names = [Tests._fields[t] for t in test]
    ends: dict[int, float] = {}  # the first that ends the branch, by interval
    for i, test_name in enumerate(names):
        if test_name in (*_NAMES, "low", "high"):
            ends[index[i]] = min(ends.get(index[i], np.inf), s[i])
    for i, test_name in enumerate(names):
        beyond = s[i] > ends.get(index[i], np.inf)
        # At a fold a multiplier passes +1 too.
        twin = test_name == "plus" and ((index == index[i]) & (test == Tests._fields.index("fold"))).any()
        if zero[i] and not beyond and not twin:
            yield int(index[i]), float(s[i]), test_name, y[i]


def _kind(arc: Arc, test: str, y: np.ndarray, neighbours: np.ndarray) -> str:
    """What a sign change means for this orbit."""
    if test in _NAMES:
        return f"grazing {_NAMES[test]}"
    if test == "minus":
        return "pitchfork" if bool(arc.sequence.mirrored) else "flip"
    if test in ("low", "high"):
        return test
    # A branch of mirror pairs turns where the two of a pair meet; a symmetric one passes +1 there without turning.
    meets = np.asarray(orbits.symmetric(_orbits(arc, np.concatenate([y[None], neighbours])), _LEVEL))
    turns = test == "fold"
    return "pitchfork" if meets[0] and turns != meets[1:].all() else "fold"


def _orbits(arc: Arc, ys: np.ndarray) -> Orbit:
    """Points of a branch as orbits, verified."""
    wide = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(ys), *leaf.shape)), arc)
    knots, x = jax.vmap(_unpack)(wide, jnp.asarray(ys))
    return orbits.proven(jax.vmap(Arc.at)(wide, x), wide.sequence, knots)


def _joined(down: Branch, up: Branch) -> Branch:
    """Two ways from one start as one branch, from the end of the first to that of the second."""
    orbit = jax.tree.map(lambda a, b: jnp.concatenate([a[::-1], b[1:]]), down.orbit, up.orbit)
    values = np.concatenate([down.values[::-1], up.values[1:]])
    return Branch(down.along, values, orbit, down.points[::-1] + up.points, (down.ends[1], up.ends[1]))


def switch(
    point: Point, along: str, within: tuple[float, float], *, device: Harvester | None = None, points: int = 4000
) -> list[Branch]:
    """Follow the branch that bifurcates at a flip (twice the period) or at a pitchfork of an orbit closed half way.

    The doubled orbit is the same one run through twice, and what leaves it there is the null vector that changes sign
    from one half to the other.

    Args:
        point: A flip, or a pitchfork on a branch of orbits closed half way (`orbit.halved`).
        along, within, device, points: As in `follow`.

    Returns:
        The two ways out: mirror images of each other at a pitchfork, shifted by a period at a flip.

    Raises:
        ValueError: A point at which nothing of the kind begins.
    """
    closed_half = bool(point.orbit.sequence.mirrored[0])
    if point.kind != "flip" and not (point.kind == "pitchfork" and closed_half):
        raise ValueError(
            f"point must be a flip, or a pitchfork of orbits closed half way; got a {point.kind}"
            f"{'' if closed_half else '; follow orbit.halved(...) to meet it so'}"
        )
    doubled = orbits.doubled(point.orbit)
    arcs, y = _set_out(doubled, along, within, device)
    knots = y[0, :-1].reshape(-1, 3)
    slope = np.asarray(shooting.linearise(*jax.tree.map(lambda x: x[0], (doubled.pair, doubled.sequence)), knots).slope)
    away = jnp.append(jnp.asarray(np.linalg.svd(slope)[2][-1]), 0.0)[None]
    return [_follow(arcs, y, sign * away, along, points)[0] for sign in (1.0, -1.0)]
