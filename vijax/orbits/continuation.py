"""Branches of periodic orbits along a parameter, by pseudo-arclength continuation through folds, many at once.

A sign change of a test function is located on the arc, and says what it was: a bifurcation, or why the branch ends.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import jax
import numpy as np

from vijax.model import units
from vijax.model.device import Harvester, one_device, with_constants
from vijax.model.pair import ImpactPair
from vijax.model.quantities import AXES, check
from vijax.model.records import Status
from vijax.orbits import periodic as orbits
from vijax.orbits import shooting
from vijax.orbits.arclength_step import CLOSE, FIRST_END, FOLD, MOVED, PLUS, Arc, Place, Tests, advance, moved, unpack
from vijax.orbits.periodic import Orbit, check_orbit
from vijax.runtime import checks, tiles
from vijax.runtime.context import door

if TYPE_CHECKING:
    import xarray as xr

_LONGEST, _SHORTEST = 0.01, 1e-9  # arclength of a step; the parameter's range counts as one
_FIRST = 1e-3
_CROWDED = 1e-7  # arclength within which several things may happen unresolved
_BEND = 0.98  # least cosine between the tangents at the ends of a step
_EASY = 0.2  # share of that bend after which the next step is longer
_ZERO = 1e-3  # part of a test function's ends that is zero
_LEVEL = 1e-4  # asymmetry of an orbit that turns where it meets its mirror image
_AWAY = 20  # steps before a branch can have closed
Direction = Literal["up", "down", "both"]
_WAYS: dict[Direction, tuple[float, ...]] = {"up": (1.0,), "down": (-1.0,), "both": (-1.0, 1.0)}
_MOST_POINTS, MOST_GENERATIONS = 10**6, 64
# An interval that holds an event is narrowed so often: by false position, with every third step a bisection.
_NARROWINGS = 40


def _changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Which test functions change sign."""
    return np.sign(before) * np.sign(after) < 0


def _happenings(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How many things happen between two points; a multiplier that passes +1 at a fold is one of them."""
    changed = Tests(*_changed(before, after).T)
    ends = np.any(changed[FIRST_END:], axis=0)
    return (changed.fold | changed.plus).astype(int) + changed.minus + ends


def _follow(arcs: Arc, first: Place, along: str, points: int) -> list["Branch"]:
    """One way from every start: all lanes together until none goes on; a step that does not do is halved."""
    lanes = first.y.shape[0]
    passed = [[(first.y[lane], first.tangent[lane], first.tests[lane], 0.0)] for lane in range(lanes)]
    y, tangent, tests = first.y, first.tangent, first.tests
    length, going, closed = np.full(lanes, _FIRST), np.full(lanes, True), np.full(lanes, False)
    while going.any():
        there = advance(arcs, y, tangent, length)
        straight = (there.tangent * tangent).sum(axis=1)
        near = np.linalg.norm(there.y - y, axis=1) < 2 * length
        single = (_happenings(tests, there.tests) <= 1) | (length < _CROWDED)
        good = going & (there.size <= CLOSE) & (straight > _BEND) & near & single
        for lane in np.flatnonzero(good):
            passed[lane].append((there.y[lane], there.tangent[lane], there.tests[lane], length[lane]))
        easy = (there.trips <= 3) & (straight > 1 - _EASY * (1 - _BEND))
        longer = np.where(easy, np.minimum(1.5 * length, _LONGEST), length)
        new = (there.y, there.tangent, there.tests)
        y, tangent, tests = (np.where(good[:, None], *pair) for pair in zip(new, (y, tangent, tests), strict=True))
        length = np.where(good, longer, 0.5 * length)
        real = (tests[:, FIRST_END:] > 0).all(axis=1) | ~good
        short = np.array([len(lane) < points for lane in passed])
        # A closed branch comes by its start again, in the same direction.
        back = np.linalg.norm(y - first.y, axis=1) < _LONGEST
        home = back & ((tangent * first.tangent).sum(axis=1) > _BEND) & np.array([len(lane) > _AWAY for lane in passed])
        closed |= going & home
        going = going & (length > _SHORTEST) & real & short & ~home
    ends = np.where(closed, "closed", np.where([len(rows) >= points for rows in passed], "points", "lost"))
    lanes_of = [jax.tree.map(lambda x, i=i: x[i], arcs) for i in range(lanes)]
    return [_branch(arc, rows, along, str(end)) for arc, rows, end in zip(lanes_of, passed, ends, strict=True)]


def _locate(arc: Arc, y: np.ndarray, tangent: np.ndarray, length: np.ndarray, test: np.ndarray, low_f: np.ndarray):
    """Arclengths from points of a branch at which test functions vanish, the points, and which are zeros, no poles."""
    rows = np.arange(test.size)
    arcs = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (test.size, *leaf.shape)), arc)

    def look(s):
        at = advance(arcs, y, tangent, s)
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
            or "high" (bound of the parameter), "closed" (back at its start), "points" (as many as asked for), "lost"
            (no step was short enough).
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


@door
def follow(
    orbit: Orbit,
    along: str,
    within: tuple[float, float],
    *,
    direction: Direction = "both",
    device: Harvester | None = None,
    points: int = 4000,
) -> list[Branch]:
    """Follow periodic orbits, stable or not, along one parameter, through folds.

    Args:
        orbit: Where to start, each a branch of its own; all at once.
        along: "d", "kappa", "r", "gamma", or a quantity of the device, which moves several of them together: "omega",
            "omega0" [rad/s], "s" [m], "A" [m/s^2], "beta" [rad] or "k" [N/m].
        within: Bounds of the parameter, as numbers or quantities of pint; the starts lie between.
        direction: "up" or "down" in the parameter at first, or "both".
        device: For a quantity of the device: its other constants, which stay, say at which value of it the orbit is.
            So omega and A follow from d and s, s from d, omega0 and k from kappa, beta from gamma.
        points: Most orbits of a branch each way.

    Returns:
        One branch an orbit. A branch ends where its orbits cease to be real (a grazing), at a bound, or says why else.

    Raises:
        ValueError: An unknown parameter or direction, bounds in the wrong order or without the start, or an orbit that
            is none.
    """
    checks.choice("direction", direction, _WAYS)
    points = checks.whole("points", points, 2, _MOST_POINTS)
    arcs, y = _set_out(orbit, along, within, device)
    ahead = np.zeros_like(y)
    ahead[:, -1] = 1.0
    first = advance(arcs, y, ahead, np.zeros(len(orbit)))
    found = [_follow(arcs, _heading(first, sign), along, points) for sign in _WAYS[direction]]
    return found[0] if len(found) == 1 else [_joined(*both) for both in zip(*found, strict=True)]


def _heading(place: Place, sign: float) -> Place:
    """The place, facing the other way where the sign is negative; the fold's test function turns with it."""
    tests = place.tests.copy()
    tests[:, FOLD] *= sign
    return place._replace(tangent=sign * place.tangent, tests=tests)


def _set_out(orbit: Orbit, along: str, within: tuple[float, float], device: Harvester | None):
    """Arcs and unknowns of the starts; what cannot be followed is refused."""
    if not len(check_orbit(orbit)):
        raise ValueError("orbit must hold an orbit to follow; got none; search with more guesses")
    if (np.asarray(orbit.status) != Status.OK).any():
        index = int(np.argmax(np.asarray(orbit.status) != Status.OK))
        got = Status(int(orbit.status[index]))
        raise ValueError(f"orbit must hold orbits only; got {got.name} at index {index}; {got.advice}")
    device = one_device(device)
    within = check_along(orbit.pair, along, within)
    x = check_bounds(orbit.pair, along, within, device)
    if _tilts(along) and bool(orbit.sequence.mirrored.any()):
        raise ValueError(
            f"orbit must be closed in full to be followed along {along}; got one closed half way; unfold it"
        )
    size, (low, high) = len(orbit), within
    # By NumPy from here on: branches differ in length, and JAX would compile a program for each.
    numbers: Any = (device.g / device.A, low, high)
    start, steepest, low_end, high_end = tiles.arrays((x, *(np.full(size, float(number)) for number in numbers)))
    arcs = jax.tree.map(np.asarray, Arc(orbit.pair, orbit.sequence, start, steepest, low_end, high_end, along))
    knots = np.where(arcs.sequence.real[..., None], orbit.knots, 0.0).reshape(size, -1)
    return arcs, np.concatenate([knots, (x / (high - low))[:, None]], axis=1)


def _tilts(along: str) -> bool:
    """Whether gravity along the axis moves alone, and with it the symmetry of the walls goes."""
    return along in ("gamma", "beta")


def check_bounds(pair: ImpactPair, along: str, within: tuple[float, float], device: Harvester) -> np.ndarray:
    """The parameter's value at a pair, or ValueError unless it can be followed from there within the bounds."""
    low, high = bounds = check_along(pair, along, within)
    x = value_at(pair, along, device)
    if not ((x >= low) & (x <= high)).all():
        raise ValueError(f"within must hold the start; got {bounds} and {along} = {np.ravel(x)[0]:.6g}")
    return x


def check_along(pair: ImpactPair, along: str, within: tuple[float, float]) -> tuple[float, float]:
    """Bounds of a parameter, or ValueError unless branches of a pair with such walls can be followed between them."""
    stiff = [name for name, moved in MOVED.items() if moved == ("kappa",) and pair.kappa is None]
    hint = f"a rigid wall has no {' or '.join(stiff)}" if stiff else ""
    checks.choice("along", along, [name for name in MOVED if name not in stiff], hint)
    bounds = checks.bounds("within", units.plain(along, within))
    for bound in bounds:
        check(along, bound, "within")
    return bounds


def value_at(pair: ImpactPair, along: str, device: Harvester) -> np.ndarray:
    """The parameter's value where a device, by that parameter, has a pair."""
    of, by = jax.tree.map(np.asarray, (pair, device))

    def omega0() -> np.ndarray:
        return of.kappa * by.omega / math.pi

    known: dict[str, Callable[[], Any]] = {
        "omega": lambda: math.pi * np.sqrt(of.d * by.A / by.s),
        "omega0": omega0,
        "k": lambda: by.m_b * omega0() ** 2,
        "s": lambda: of.d * by.length_unit,
        "A": lambda: by.s * (by.omega / math.pi) ** 2 / of.d,
        "beta": lambda: np.arcsin(of.gamma * by.A / by.g),
    }
    return known[along]() if along in known else getattr(of, along)


@door
def pair_at(pair: ImpactPair, along: str, value: float, device: Harvester) -> ImpactPair:
    """The pair where the parameter has another value, all else of the device as it is."""
    pair, x, steepest = tiles.arrays(jax.tree.map(np.asarray, (pair, value, device.g / device.A)))
    begun: Any = value_at(pair, along, device)
    return moved(pair, along, x, begun, steepest)


def _branch(arc: Arc, rows: list[tuple], along: str, end: str) -> Branch:
    """A lane's record as a branch: what was met between its points, and where it ends."""
    y, tangent, tests, lengths = (np.array(column) for column in zip(*rows, strict=True))
    last, met, ys = len(rows), [], y
    for event in sorted(_events(arc, y, tangent, tests, lengths), key=lambda event: (event.place, event.s)):
        kind = _kind(arc, event, y[event.place : event.place + 2])
        if event.test in Tests._fields[FIRST_END:]:
            end, last = kind, event.place + 1
            ys = np.concatenate([y[:last], event.y[None]])
        if kind not in ("low", "high"):
            met.append(Point(kind, float(event.y[-1] * (arc.high - arc.low)), _orbits(arc, event.y[None])))
    orbit = _orbits(arc, ys)
    # At a bound the last orbit is there; at a grazing rounding decides whether it is one.
    count = len(ys) if np.asarray(orbit.status)[-1] == Status.OK else last
    return Branch(along, ys[:count, -1] * float(arc.high - arc.low), orbit[:count], met, ("start", end))


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
        if sure and not (t == PLUS and ((index == i) & (test == FOLD)).any())
    ]
    ends = [event.s for event in found if event.place == len(y) - 2 and event.test in Tests._fields[FIRST_END:]]
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
    wide = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(ys), *leaf.shape)), arc)
    knots, x = unpack(wide, ys)
    return orbits.proven(wide.at(x), wide.sequence, knots)


def _joined(down: Branch, up: Branch) -> Branch:
    """Two ways from one start as one branch, from end to end; where it closes one way is all of it."""
    if down.ends[1] == "closed":
        return down
    orbit = orbits.concatenate([down.orbit[::-1], up.orbit[1:]])
    values = np.concatenate([down.values[::-1], up.values[1:]])
    return Branch(down.along, values, orbit, down.points[::-1] + up.points, (down.ends[1], up.ends[1]))


@door
def switch(
    point: Point, along: str, within: tuple[float, float], *, device: Harvester | None = None, points: int = 4000
) -> list[Branch]:
    """Follow the branch that bifurcates at a flip (twice the period) or at a pitchfork of an orbit closed half way.

    The doubled orbit is the same one run through twice, and what leaves it there is the null vector that changes sign
    from one half to the other.

    Args:
        point: A flip, or a pitchfork on a branch of orbits closed half way (`periodic.halved`).
        along, within, device, points: As in `follow`.

    Returns:
        The two ways out: mirror images of each other at a pitchfork, shifted by a period at a flip.

    Raises:
        ValueError: A point at which nothing of the kind begins.
    """
    checks.instance("point", point, Point, "continuation.follow")
    points = checks.whole("points", points, 2, _MOST_POINTS)
    if not _begins(point):
        raise ValueError(
            f"point must be a flip, or a pitchfork of orbits closed half way (orbit.halved); got a {point.kind} of "
            f"orbits closed {'half way' if point.orbit.sequence.mirrored[0] else 'in full'}"
        )
    check_bounds(point.orbit.pair, along, within, one_device(device))
    doubled = orbits.doubled(point.orbit)
    arcs, y = _set_out(doubled, along, within, device)
    knots = y[0, :-1].reshape(-1, 3)
    pair, sequence = jax.tree.map(lambda x: x[0], (doubled.pair, doubled.sequence))
    slope = np.asarray(jax.jit(shooting.linearise)(pair, sequence, knots).slope)
    away = np.append(np.linalg.svd(slope)[2][-1], 0.0)[None]
    # Test functions that vanish here would be met again at once.
    first = Place(y, away, np.full((1, len(Tests._fields)), np.nan), np.zeros(1), np.zeros(1))
    return [_follow(arcs, _heading(first, sign), along, points)[0] for sign in (1.0, -1.0)]


def _begins(point: Point) -> bool:
    """Whether another branch begins there that `switch` can find."""
    return point.kind == "flip" or (point.kind == "pitchfork" and bool(point.orbit.sequence.mirrored[0]))


@door
def family(
    orbit: Orbit,
    along: str,
    within: tuple[float, float],
    *,
    device: Harvester | None = None,
    generations: int = 1,
    points: int = 4000,
) -> list[Branch]:
    """The branches of some orbits, and those that bifurcate from them at flips and pitchforks, and so on.

    Args:
        orbit, along, within, device, points: As in `follow`; symmetric orbits are closed half way.
        generations: How often to switch; 0 follows the given orbits alone.

    Raises:
        ValueError: As `follow`.
    """
    generations = checks.whole("generations", generations, 0, MOST_GENERATIONS)
    points = checks.whole("points", points, 2, _MOST_POINTS)
    _set_out(orbit, along, within, device)
    grown: list[Branch] = []
    for index in range(len(orbit)):
        one = orbit[index : index + 1]
        closed = not _tilts(along) and bool(orbits.symmetric(one)[0])
        one = orbits.halved(one) if closed else one
        grown += _new(follow(one, along, within, device=device, points=points), grown)
    youngest = grown
    for _ in range(generations):
        where = [point for branch in youngest for point in branch.points if _begins(point)]
        youngest = []
        for point in where:
            youngest += _new(switch(point, along, within, device=device, points=points), grown + youngest)
        grown = grown + youngest
    return grown


def _new(found: list[Branch], known: list[Branch]) -> list[Branch]:
    """Branches that met something which no known one has met: the same points lie on the same branch."""
    old = [(point.kind, _traits(point)) for branch in known for point in branch.points]
    new = []
    for branch in found:
        met = [(point.kind, _traits(point)) for point in branch.points]
        seen = [any(kind == k and np.allclose(x, y, atol=_LEVEL) for k, y in old) for kind, x in met]
        if not met or not all(seen):
            new.append(branch)
            old += met
    return new


def _traits(point: Point) -> np.ndarray:
    """Numbers that tell orbits apart, whichever impact they begin with."""
    return np.append(np.asarray(orbits.marks(orbits.unfolded(point.orbit)))[0], point.value)


@door
def dataset(branches: list[Branch], device: Harvester | None = None) -> "xr.Dataset":
    """Branches as one dataset: what every orbit is, and what was met, padded with NaN.

    Args:
        branches: Along one parameter.
        device: Gives A, omega (unless one is the parameter) and the electrical constants; Tables I and II by default.

    Returns:
        Over (branch, point): the parameter, `multiplier` (largest modulus), `stable`, `P` [J], the label's `period`,
        `impacts_left`, `impacts_right`, `status`; over (branch, point, impact): `v_in`, `side`, `phase`, `duration`,
        `depth` [m]; over (branch, event_number): `event`, its `event_value`, and
        `event_point`, the point nearest to it; over branch: `end_first`, `end_last`.
    """
    import xarray as xr  # here, as importing vijax must not load it

    if not checks.sequence("branches", branches, Branch, "branches, as continuation.follow returns them"):
        raise ValueError("branches must hold at least one; got none")
    device = one_device(device)
    along = branches[0].along
    columns = [_columns(branch, device) for branch in branches]
    found = {name: _padded([column[name] for column in columns]) for name in columns[0]}
    dims = ("branch", "point", "impact")
    variables = {name: (dims[: values.ndim], values, _ABOUT[name]) for name, values in found.items() if name != along}
    events = [[point.kind for point in branch.points] for branch in branches]
    text = np.dtypes.StringDType()
    most = max(map(len, events), default=0)
    kinds = np.array([names + [""] * (most - len(names)) for names in events], dtype=text).reshape(len(branches), most)
    values = _padded([np.array([point.value for point in branch.points]) for branch in branches])
    places = _padded([_places(branch) for branch in branches])
    return xr.Dataset(
        variables
        | {"event": (("branch", "event_number"), kinds), "event_value": (("branch", "event_number"), values)}
        | {"event_point": (("branch", "event_number"), places)}
        | {f"end_{name}": ("branch", np.array([b.ends[i] for b in branches], dtype=text)) for i, name in _ENDS},
        coords={along: (("branch", "point"), found[along], _about(along))} | _constants(branches[0]),
        attrs={
            "title": "Branches of periodic orbits of a vibro-impact pair",
            "along": along,
            "wall": "rigid" if branches[0].orbit.pair.kappa is None else "soft",
        },
    )


def _about(parameter: str) -> dict[str, str]:
    axis = AXES[parameter]
    return {"units": axis.units, "long_name": axis.description, "symbol": axis.symbol}


def _constants(branch: Branch) -> "dict[str, tuple]":
    """The parameters that do not move."""
    still = [name for name in ("d", "kappa", "r", "gamma") if name not in MOVED[branch.along]]
    pair = {name: getattr(branch.orbit.pair, name) for name in still}
    return {name: ((), float(values[0]), _about(name)) for name, values in pair.items() if values is not None}


_ENDS = ((0, "first"), (1, "last"))
_ABOUT = {
    "multiplier": {"units": "1", "long_name": "largest modulus of a Floquet multiplier"},
    "stable": {"units": "1", "long_name": "whether the orbit attracts: 1 or 0"},
    "P": {"units": "J", "long_name": "energy harvested per half forcing period"},
    "period": {"units": "1", "long_name": "forcing periods"},
    "impacts_left": {"units": "1", "long_name": "left impacts in that time"},
    "impacts_right": {"units": "1", "long_name": "right impacts in that time"},
    "status": {"units": "1", "long_name": "0: verified by the impact map"},
    "v_in": {"units": "1", "long_name": "velocity at the onset, in units of A pi / omega"},
    "side": {"units": "1", "long_name": "wall: -1 left, 1 right"},
    "phase": {
        "units": "1",
        "long_name": "phase of the onset, in half forcing periods",
    },
    "duration": {"units": "1", "long_name": "duration of the contact, in half forcing periods"},
    "depth": {"units": "m", "long_name": "penetration of the membrane"},
}


def _columns(branch: Branch, device: Harvester) -> dict[str, np.ndarray]:
    """What the dataset holds of a branch, a row a point."""
    if branch.along not in ImpactPair.__dataclass_fields__:
        device = with_constants(device, **{branch.along: tiles.arrays(branch.values[:, None])})
    hits, label = orbits.impacts(branch.orbit), orbits.counts(branch.orbit)
    length = orbits.depth_unit(branch.orbit, device)
    columns = {
        branch.along: branch.values,
        "multiplier": np.abs(np.asarray(branch.orbit.multipliers)).max(axis=1),
        "stable": branch.stable.astype(float),
        "P": orbits.power(branch.orbit, device),
        "period": label.period,
        "impacts_left": label.left,
        "impacts_right": label.right,
        "status": branch.orbit.status,
        "v_in": hits.v_in,
        "side": hits.side,
        "phase": hits.t,
        "duration": hits.duration,
        "depth": np.asarray(hits.depth) * np.asarray(length),
    }
    return {name: np.asarray(values, float) for name, values in columns.items()}


def _places(branch: Branch) -> np.ndarray:
    """Index of the orbit nearest to each thing met: on the right sheet, where a fold has made several."""
    passed = np.column_stack([np.asarray(orbits.marks(branch.orbit)), branch.values])
    met = [np.append(np.asarray(orbits.marks(point.orbit))[0], point.value) for point in branch.points]
    return np.array([np.abs(passed - traits).sum(axis=1).argmin() for traits in met], dtype=float)


def _padded(rows: list[np.ndarray]) -> np.ndarray:
    """Arrays of several shapes as one, NaN beyond each."""
    shape = np.max([row.shape for row in rows], axis=0)
    table = np.full((len(rows), *shape), np.nan)
    for index, row in enumerate(rows):
        table[index][tuple(slice(size) for size in row.shape)] = row
    return table
