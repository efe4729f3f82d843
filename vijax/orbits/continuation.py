"""Branches of periodic orbits along a parameter, by pseudo-arclength continuation through folds, many at once.

All lanes step together (`arclength_walk`), from graze to graze (`pieces`); what happened on the way is located
afterwards (`events`).
"""

from typing import Literal, NamedTuple

import jax
import numpy as np

from vijax.model.device import Harvester, one_device
from vijax.model.records import Status
from vijax.orbits import periodic, repetition, symmetry
from vijax.orbits.arclength_step import BranchPlace, advance, settled
from vijax.orbits.arclength_walk import Walked
from vijax.orbits.branch_path import FIRST_END, FOLD, Arc, Tests, heading, upwards
from vijax.orbits.continuation_settings import DEFAULT, ContinuationSettings, check_settings
from vijax.orbits.events import BranchEvent, Point, blur, events, kind_of, locate, orbits_at
from vijax.orbits.parameter import able, check_along, check_bounds, skews
from vijax.orbits.periodic import Orbit, begin_proofs, check_orbit, to_least_period
from vijax.orbits.pieces import Followed, Piece, follow_pieces, joined
from vijax.orbits.soft_graze import Passage, branch_passage
from vijax.runtime import checks, tiles
from vijax.runtime.context import door
from vijax.runtime.pages import see

MOST_POINTS = 10**6  # of a branch: beyond, a number was mistyped, and is refused before memory is taken
Direction = Literal["up", "down", "both"]
_NEAR = 1e-4  # arclength on either side of a pitchfork or flip, known to 1e-8, in which it is located once more
_WAYS: dict[Direction, tuple[float, ...]] = {"up": (1.0,), "down": (-1.0,), "both": (-1.0, 1.0)}


class Branch(NamedTuple):
    """A branch of real orbits in the order in which they were followed.

    Attributes:
        along: The parameter.
        values: Of the parameter, one an orbit.
        orbit: The orbits, with multipliers.
        points: What was met on the way, in order.
        ends: Why it stops at its first and at its last orbit: "start", a kind of `Point` where no orbit goes on, or
            that is one graze more than asked for, "low" or "high" (bound of the parameter), "closed" (back at its
            start, or at its first graze), "points" (as many as asked for), "lost" (no step was short enough).
    """

    along: str
    values: np.ndarray
    orbit: Orbit
    points: list[Point]
    ends: tuple[str, str]

    @property
    def stable(self) -> np.ndarray:
        """Say whether each orbit attracts."""
        return np.abs(np.asarray(self.orbit.multipliers)).max(axis=1) < 1


@door
def follow(
    orbit: Orbit,
    along: str,
    within: tuple[float, float],
    *,
    direction: Direction = "both",
    device: Harvester | None = None,
    points: int = 4000,
    settings: ContinuationSettings = DEFAULT,
) -> list[Branch]:
    """Follow periodic orbits, stable or not, along one parameter, through folds, and through grazes at soft walls.

    Args:
        orbit: Where to start, each a branch of its own; all at once, each at its least period.
        along: "d", "kappa", "r", "gamma", or a quantity of the device, which moves several of them together: "omega",
            "omega0" [rad/s], "s" [m], "A" [m/s^2], "beta" [rad] or "k" [N/m]; of one wall "kappa_left", "r_right" and
            so on, also of omega0 and k.
        within: Bounds of the parameter, as numbers or quantities of pint; the starts lie between.
        direction: "up" or "down" in the parameter at first, or "both".
        device: For a quantity of the device: its other constants, which stay, say at which value of it the orbit is.
            So omega and A follow from d and s, s from d, omega0 and k from kappa, beta from gamma.
        points: Most orbits of a branch each way.
        settings: Of steps and events; see `ContinuationSettings`.

    Returns:
        One branch an orbit. At a grazing, where its orbits cease to be real, it ends at rigid walls; at soft ones it
        goes on with those that have an impact more or fewer. Else it ends at a bound, or says why.

    Raises:
        ValueError: An unknown parameter or direction, bounds in the wrong order or without the start, or an orbit that
            is none.
    """
    checks.choice("direction", direction, _WAYS)
    points, settings = checks.whole("points", points, 2, MOST_POINTS), check_settings(settings)
    orbit = able(to_least_period(orbit), along)
    arcs, y = set_out(orbit, along, within, device, settings)
    begin_proofs(orbit.pair, orbit.sequence, orbit.knots)
    first = settled(upwards(arcs, y), FIRST_END)
    found = [follow_arcs(orbit, arcs, heading(first, sign), along, points, settings) for sign in _WAYS[direction]]
    return found[0] if len(found) == 1 else [_joined(*both) for both in zip(*found, strict=True)]


def set_out(
    orbit: Orbit, along: str, within: tuple[float, float], device: Harvester | None, settings: ContinuationSettings
):
    """Make arcs and unknowns of the starts; refuse what cannot be followed."""
    if not len(check_orbit(orbit)):
        raise ValueError(see("attractors", "orbit must hold an orbit to follow; got none; search with more guesses"))
    if (np.asarray(orbit.status) != Status.OK).any():
        index = int(np.argmax(np.asarray(orbit.status) != Status.OK))
        got = Status(int(orbit.status[index]))
        raise ValueError(see("status", f"orbit must hold orbits only; got {got.name} at index {index}; {got.advice}"))
    device = one_device(device)
    within = check_along(orbit.pair, along, within)
    x = check_bounds(orbit.pair, along, within, device)
    if skews(along) and bool(orbit.sequence.mirrored.any()):
        raise ValueError(
            f"orbit must be closed in full to be followed along {along}; got one closed half way; unfold it"
        )
    size, (low, high) = len(orbit), within
    steepest, low_end, high_end = (np.full(size, float(number)) for number in (device.g / device.A, low, high))
    return arcs_from(orbit, along, x, steepest, (low_end, high_end), settings)


def arcs_from(
    orbit: Orbit,
    along: str,
    x: np.ndarray,
    steepest: np.ndarray,
    within: tuple[np.ndarray, np.ndarray],
    settings: ContinuationSettings,
) -> tuple[Arc, np.ndarray]:
    """Make arcs and unknowns of orbits to be followed, a row each: value of the parameter, g/A, bounds."""
    # By NumPy from here on: branches differ in length, and JAX would compile a program for each.
    low, high = within
    start, gravity, low_end, high_end = tiles.arrays((x, steepest, low, high))
    arcs = Arc(
        pair=orbit.pair,
        sequence=orbit.sequence,
        start=start,
        steepest=gravity,
        low=low_end,
        high=high_end,
        along=along,
        newton_tolerance=settings.newton_tolerance,
        max_corrections=settings.max_corrections,
    )
    arcs = jax.tree.map(np.asarray, arcs)
    knots = np.where(arcs.sequence.real[..., None], orbit.knots, 0.0).reshape(len(orbit), -1)
    return arcs, np.concatenate([knots, (x / (high - low))[:, None]], axis=1)


def follow_arcs(
    starts: Orbit, arcs: Arc, first: BranchPlace, along: str, points: int, settings: ContinuationSettings
) -> list[Branch]:
    """Follow one way from every start, at soft walls through grazes, after which orbits have other impacts."""

    def making(lanes: list[int], arcs: Arc, walked: list[Walked], begun: list[bool]) -> list[Piece]:
        each = [jax.tree.map(lambda leaf, i=row: leaf[i], arcs) for row in range(len(walked))]
        # Starts are known to be flown. Of one that grazes rounding might say otherwise, were it verified once more.
        given = [starts[lane : lane + 1] if yes else None for lane, yes in zip(lanes, begun, strict=True)]
        return [_piece(arc, one, settings, start) for arc, one, start in zip(each, walked, given, strict=True)]

    return [Branch(along, *one) for one in follow_pieces(arcs, first, making, points, settings)]


def _piece(arc: Arc, walked: Walked, settings: ContinuationSettings, start: Orbit | None) -> Piece:
    """Make a piece of a lane's record: what was met between its points, and where it ends; see `pieces.Making`.

    It begins with the start where one is given, else with the first step from it.
    """
    y, tangent, tests, lengths, end = walked
    unit, last, values = float(arc.high - arc.low), len(y), y[:, -1]
    met: list[Point] = []
    ending: list[Orbit] = []
    beyond = None
    for event in events(arc, y, tangent, tests, lengths, settings):
        kind, orbit = kind_of(arc, event, y[event.place : event.place + 2], settings), orbits_at(arc, event.y[None])
        ends = event.test in Tests._fields[FIRST_END:]
        if ends and kind not in ("low", "high"):
            beyond = _beyond(arc, event, y, tests)
            kind, orbit = (kind, orbit) if beyond is None else (f"grazing {beyond.touches}", beyond.orbit)
        if kind not in ("low", "high"):
            met.append(_point(arc, kind, event.y, orbit, settings))
        if ends:
            end, last, ending = kind, event.place + 1, [orbit]
            values = np.append(y[:last, -1], event.y[-1])
            break
    orbits = ([] if start is None else [start]) + ([orbits_at(arc, y[1:last])] if last > 1 else []) + ending
    # At a bound the last orbit is there; at a grazing rounding decides whether it is one.
    if orbits and int(np.asarray(orbits[-1].status)[-1]) != Status.OK:
        values, orbits = values[:-1], [*orbits[:-1], orbits[-1][:-1]]
    return Piece(values[start is None :] * unit, orbits, met, end, beyond)


def _beyond(arc: Arc, event: BranchEvent, y: np.ndarray, tests: np.ndarray) -> Passage | None:
    """Find what is beyond the graze at which a piece ends."""
    rises = tests[event.place, FOLD]
    if not np.abs(rises) > 0:  # unknown at the very beginning of a branch that was switched to
        rises = event.y[-1] - y[event.place, -1]
    return branch_passage(arc, event.y, event.test, float(np.sign(rises)))


def _point(arc: Arc, kind: str, y: np.ndarray, orbit: Orbit, settings: ContinuationSettings) -> Point:
    """Make a point of what was met; of a pitchfork or flip that mirror pairs or doubled orbits meet on simpler orbits.

    Two branches of orbits cross there, so that Newton is singular and the place is known to 1e-8 only. On the branch of
    the simpler orbit, closed half way or of half the period, a multiplier passes -1 there, which is regular.
    """
    value = float(y[-1] * (arc.high - arc.low))
    plain = Point(kind, value, orbit)
    if (simpler := _simpler(arc, kind, orbit, settings)) is None:
        return plain
    row = jax.tree.map(np.atleast_1d, arc)
    arcs, known = arcs_from(simpler, arc.along, np.array([value]), row.steepest, (row.low, row.high), settings)
    first, reach = upwards(arcs, known), np.array([_NEAR])
    before = advance(arcs, first.y, first.tangent, -reach)
    test = np.array([Tests._fields.index("minus")])
    _, there, sure = locate(arcs, before.y, before.tangent, 2 * reach, test, before.tests[0, test], settings)
    if not sure[0]:
        exact = kind == "pitchfork" and bool(symmetry.symmetric(orbit, settings.asymmetry)[0])
        return plain if exact else plain._replace(kind="fold")
    arc = jax.tree.map(lambda leaf: leaf[0], arcs)
    full = symmetry.unfolded(orbits_at(arc, there))
    return Point(kind, float(there[0, -1] * (arc.high - arc.low)), full)


def _simpler(arc: Arc, kind: str, orbit: Orbit, settings: ContinuationSettings) -> Orbit | None:
    """Find the simpler orbit that a mirror pair, or doubled orbits, have come to; None of all others."""
    if kind == "pitchfork" and not (bool(arc.sequence.mirrored) or skews(arc.along)):
        return symmetry.halved(orbit, blur(settings))
    if kind == "flip":
        number = repetition.turns(orbit.sequence, orbit.knots, blur(settings))
        return periodic.mean_turn(orbit, number) if number[0] > 1 else None
    return None


def _joined(down: Branch, up: Branch) -> Branch:
    """Join two ways from one start to one branch."""
    return Branch(down.along, *joined(Followed(*down[1:]), Followed(*up[1:])))
