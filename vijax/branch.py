"""Branches of periodic orbits along a parameter, by pseudo-arclength continuation through folds, many at once.

The orbit's equations go on through grazing into orbits that are none (`shooting`); what makes an orbit real, and what
marks a bifurcation, are smooth functions along the branch. A sign change is located on the arc, and says which it was.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from vijax import flow, shooting
from vijax import orbit as orbits
from vijax.model import Harvester, ImpactPair, Status
from vijax.orbit import Orbit
from vijax.shooting import Sequence

ALONG = ("d", "kappa", "r", "gamma", "omega")
_BATCHES = (8, 64, 512)  # lanes of one compiled call
_LONGEST, _SHORTEST = 0.01, 1e-9  # arclength of a step; the parameter's range counts as one
_FIRST = 1e-3
_CROWDED = 1e-7  # arclength within which several things may happen unresolved
_ROUNDS = 6  # Newton corrections of a step, at most
_CLOSE = 1e-11  # size of the last correction
_BEND = 0.98  # least cosine between the tangents at the ends of a step
_EASY = 0.2  # share of that bend after which the next step is longer
_SAMPLES = 48  # of a flight or contact, to find its extrema
_NOTHING = 1.0  # clearance where there is nothing to clear
_ZERO = 1e-3  # part of a test function's ends that is zero
_LEVEL = 1e-4  # asymmetry of an orbit that turns where it meets its mirror image
_NARROWINGS = 40  # of an interval that holds an event: false position with every third step a bisection


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


_FOLD, _PLUS = Tests._fields.index("fold"), Tests._fields.index("plus")
_FIRST_END = Tests._fields.index("speed")


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
    """Newton in the plane across the former tangent, and the tangent there."""
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


class _Place(NamedTuple):
    """Points of branches, a row a lane: unknowns (knots, then the parameter over its range), tangents, test functions.

    And how Newton came there: the size of its last correction, and how many it took.
    """

    y: np.ndarray
    tangent: np.ndarray
    tests: np.ndarray
    size: np.ndarray
    trips: np.ndarray


@jax.jit
def _compiled(arcs: Arc, y, tangent, length):
    def one(arc, y, tangent, length):
        at = _correct(arc, y + length * tangent, tangent)
        return _Place(at.y, at.tangent, jnp.stack(_tests(arc, at.y, at.tangent)), at.size, at.trips)

    return jax.vmap(one)(arcs, y, tangent, length)


def _advance(arcs: Arc, y: np.ndarray, tangent: np.ndarray, length: np.ndarray) -> _Place:
    """From points of branches on by an arclength each: the compiled program behind every step and every search."""
    count = y.shape[0]
    size = next((size for size in _BATCHES if size >= count), count)
    index = np.minimum(np.arange(size), count - 1)
    rows = jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], (arcs, y, tangent, length))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], _compiled(*rows))


def _changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Which test functions change sign."""
    return np.sign(before) * np.sign(after) < 0


def _happenings(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How many things happen between two points; a multiplier that passes +1 at a fold is one of them."""
    changed = Tests(*_changed(before, after).T)
    ends = np.any(changed[_FIRST_END:], axis=0)
    return (changed.fold | changed.plus).astype(int) + changed.minus + ends


def _follow(arcs: Arc, first: _Place, along: str, points: int) -> list["Branch"]:
    """One way from every start: all lanes together until none goes on; a step that does not do is halved."""
    lanes = first.y.shape[0]
    passed = [[(first.y[lane], first.tangent[lane], first.tests[lane], 0.0)] for lane in range(lanes)]
    y, tangent, tests = first.y, first.tangent, first.tests
    length, going = np.full(lanes, _FIRST), np.full(lanes, True)
    while going.any():
        there = _advance(arcs, y, tangent, length)
        straight = (there.tangent * tangent).sum(axis=1)
        near = np.linalg.norm(there.y - y, axis=1) < 2 * length
        single = (_happenings(tests, there.tests) <= 1) | (length < _CROWDED)
        good = going & (there.size <= _CLOSE) & (straight > _BEND) & near & single
        for lane in np.flatnonzero(good):
            passed[lane].append((there.y[lane], there.tangent[lane], there.tests[lane], length[lane]))
        easy = (there.trips <= 3) & (straight > 1 - _EASY * (1 - _BEND))
        longer = np.where(easy, np.minimum(1.5 * length, _LONGEST), length)
        new = (there.y, there.tangent, there.tests)
        y, tangent, tests = (np.where(good[:, None], *pair) for pair in zip(new, (y, tangent, tests), strict=True))
        length = np.where(good, longer, 0.5 * length)
        real = (tests[:, _FIRST_END:] > 0).all(axis=1) | ~good
        short = np.array([len(lane) < points for lane in passed])
        going = going & (length > _SHORTEST) & real & short
    return [_branch(jax.tree.map(lambda x, i=i: x[i], arcs), rows, along, points) for i, rows in enumerate(passed)]


def _locate(arc: Arc, y: np.ndarray, tangent: np.ndarray, length: np.ndarray, test: np.ndarray, low_f: np.ndarray):
    """Arclengths from points of a branch at which test functions vanish, the points, and which are zeros, no poles."""
    rows = np.arange(test.size)
    arcs = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (test.size, *leaf.shape)), arc)

    def look(s):
        at = _advance(arcs, y, tangent, s)
        return at.tests[rows, test], at.y

    low, high = np.zeros_like(length), length
    high_f, best_y = look(high)
    scale, best, best_f = np.abs(low_f) + np.abs(high_f), high, high_f
    for trip in range(_NARROWINGS):
        chord = low - low_f * (high - low) / np.where(high_f == low_f, 1.0, high_f - low_f)
        inside = (chord > low) & (chord < high) & (trip % 3 != 2)
        s = np.where(inside, chord, 0.5 * (low + high))
        f, there = look(s)
        closer = np.abs(f) < np.abs(best_f)
        best, best_f, best_y = (
            np.where(closer, s, best),
            np.where(closer, f, best_f),
            np.where(closer[:, None], there, best_y),
        )
        left = np.sign(f) == np.sign(low_f)
        # Illinois: the value at the end that stays counts half.
        low, high = np.where(left, s, low), np.where(left, high, s)
        low_f, high_f = np.where(left, f, 0.5 * low_f), np.where(left, 0.5 * high_f, f)
    return best, best_y, np.abs(best_f) <= _ZERO * scale


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


_GRAZING = {"speed": "impact", "flight": "flight", "contact": "contact", "exit": "exit"}


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
    ahead = np.zeros_like(y)
    ahead[:, -1] = 1.0
    first = _advance(arcs, y, ahead, np.zeros(len(orbit)))
    found = [_follow(arcs, _heading(first, sign), along, points) for sign in ways[direction]]
    return found[0] if len(found) == 1 else [_joined(*both) for both in zip(*found, strict=True)]


def _heading(place: _Place, sign: float) -> _Place:
    """The place, facing the other way where the sign is negative; the fold's test function turns with it."""
    tests = place.tests.copy()
    tests[:, _FOLD] *= sign
    return place._replace(tangent=sign * place.tangent, tests=tests)


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
    return arcs, np.concatenate([knots, (x / (high - low))[:, None]], axis=1)


def _branch(arc: Arc, rows: list[tuple], along: str, points: int) -> Branch:
    """A lane's record as a branch: what was met between its points, and where it ends."""
    y, tangent, tests, lengths = (np.array(column) for column in zip(*rows, strict=True))
    end = "points" if len(rows) >= points else "lost"
    last, met = len(rows), []
    for event in sorted(_events(arc, y, tangent, tests, lengths), key=lambda event: (event.place, event.s)):
        kind = _kind(arc, event, y[event.place : event.place + 2])
        if event.test in Tests._fields[_FIRST_END:]:
            end, last = kind, event.place + 1
        if kind not in ("low", "high"):
            met.append(Point(kind, float(event.y[-1] * (arc.high - arc.low)), _orbits(arc, event.y[None])))
    return Branch(along, y[:last, -1] * float(arc.high - arc.low), _orbits(arc, y[:last]), met, ("start", end))


class _Event(NamedTuple):
    """A sign change: the point before it, the arclength from there, of which test function, the point itself."""

    place: int
    s: float
    test: str
    y: np.ndarray


def _events(arc: Arc, y, tangent, tests, lengths) -> list[_Event]:
    """What happens between neighbours, up to the first thing that ends the branch."""
    index, test = np.nonzero(_changed(tests[:-1], tests[1:]))
    if not index.size:
        return []
    s, there, zero = _locate(arc, y[index], tangent[index], lengths[index + 1], test, tests[index, test])
    found = [
        _Event(int(i), float(at), Tests._fields[t], y)
        for i, at, t, y, sure in zip(index, s, test, there, zero, strict=True)
        # A multiplier that passes +1 at a fold is no second event.
        if sure and not (t == _PLUS and ((index == i) & (test == _FOLD)).any())
    ]
    ends = [event.s for event in found if event.place == len(y) - 2 and event.test in Tests._fields[_FIRST_END:]]
    return [event for event in found if event.place < len(y) - 2 or event.s <= min(ends, default=np.inf)]


def _kind(arc: Arc, event: _Event, neighbours: np.ndarray) -> str:
    """What a sign change means for this orbit."""
    test = event.test
    if test in _GRAZING:
        return f"grazing {_GRAZING[test]}"
    if test == "minus":
        return "pitchfork" if bool(arc.sequence.mirrored) else "flip"
    if test in ("low", "high"):
        return test
    # A branch of mirror pairs turns where the two of a pair meet; a symmetric one passes +1 there without turning.
    meets = np.asarray(orbits.symmetric(_orbits(arc, np.concatenate([event.y[None], neighbours])), _LEVEL))
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
    pair, sequence = jax.tree.map(lambda x: x[0], (doubled.pair, doubled.sequence))
    slope = np.asarray(shooting.linearise(pair, sequence, knots).slope)
    away = np.append(np.linalg.svd(slope)[2][-1], 0.0)[None]
    # Test functions that vanish here would be met again at once.
    first = _Place(y, away, np.full((1, len(Tests._fields)), np.nan), np.zeros(1), np.zeros(1))
    return [_follow(arcs, _heading(first, sign), along, points)[0] for sign in (1.0, -1.0)]
