"""What lies around an optimum: coexisting attractors, bifurcations on either side, and designs that weigh basins."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax.design.optimise import Design
from vijax.design.optimum import AnyOptimum, AperiodicOptimum, Optimum, states
from vijax.model.device import Harvester
from vijax.model.pair import quantities
from vijax.model.records import Status
from vijax.model.variables import tuned, values, variables
from vijax.orbits import continuation, orbit_properties, periodic
from vijax.orbits.continuation import Direction
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.periodic import Orbit
from vijax.planes.basins import basin_fractions
from vijax.planes.sweep_settings import MOST_STARTS
from vijax.runtime import checks
from vijax.runtime.context import door

_SAME = 1e-6  # relative difference of P within which an attractor is the optimum's own orbit
_MOST_POINTS = 10_000  # A line search flies `starts` balls at each of its points; it has so many at most.
_STEPS = 8  # an orbit follows its device in so many steps


class Neighbour(NamedTuple):
    """An attractor at the optimum: its name, P [J per half period], share of all starts, and whether it may be."""

    label: str
    P: float
    share: float
    admissible: bool


class Edge(NamedTuple):
    """The first bifurcation that the optimum's orbit meets on one side.

    Attributes:
        kind: "fold", "flip", "pitchfork", "grazing ..." (see `events.Point`), "none" as far as was looked, or why
            the branch could not be followed so far (see `continuation.Branch.ends`).
        omega0: Where [rad/s].
        percent: How far that is from the optimum, in percent of its omega0.
    """

    kind: str
    omega0: float
    percent: float


class Surroundings(NamedTuple):
    """What lies around an optimum.

    Attributes:
        share: Part of all starts that its motion (and the mirror image) attracts.
        attractors: All that were met there, its own among them, the largest share first.
        below, above: Along omega0, all else of the device as it is; None where the walls differ, whose frequencies are
            two (`design_plane` shows their plane), and of a motion that is no orbit, which has no bifurcations of its
            own (`off_design.extents` says how far it lasts).
    """

    share: float
    attractors: tuple[Neighbour, ...]
    below: Edge | None
    above: Edge | None


@door
def surroundings(
    optimum: Optimum | AperiodicOptimum, *, starts: int = 2000, reach: float = 0.5, seed: int | None = None
) -> Surroundings:
    """Look around an optimum.

    Args:
        optimum: Of `optimise.optimise`.
        starts: Of balls that show which attractors there are; see `basins.basin_fractions`.
        reach: How far along omega0 to look for bifurcations, in parts of it, below 1.
        seed: Of starts drawn at random.

    Raises:
        ValueError: reach outside (0, 1), or starts that cannot be.
    """
    checks.instance("optimum", optimum, AnyOptimum, "vijax.optimise(...).best")
    reach, seed = _checked(reach), checks.seed(seed)
    attractors = _attractors(optimum.device, checks.whole("starts", starts, 1, MOST_STARTS), seed)
    if not isinstance(optimum, Optimum):
        share = sum(one.share for one in attractors if one.label == optimum.label)
        return Surroundings(share, attractors, None, None)
    # Several attractors may have the design's label; by its P its own is known among them.
    own = float(orbit_properties.power(optimum.orbit, optimum.device)[0])
    share = sum(one.share for one in attractors if math.isclose(one.P, own, rel_tol=_SAME))
    if optimum.device.unequal:
        return Surroundings(share, attractors, None, None)
    return Surroundings(share, attractors, _edge(optimum, "down", reach), _edge(optimum, "up", reach))


def _checked(reach: Any) -> float:
    return checks.real("reach", reach, "a number between 0 and 1", lambda x: 0 < x < 1)


def _attractors(device: Harvester, starts: int, seed: int | None) -> tuple[Neighbour, ...]:
    """Find what attracts the balls of a device, mirror images as one, the largest share first."""
    pair = device.pair()
    named: Any = {name: float(value) for name, value in quantities(pair).items()}
    mirrors = bool(pair.symmetric)
    found = basin_fractions(**named, starts=starts, seed=seed, device=device, merge_mirrors=mirrors)
    columns = [found[name].values.ravel() for name in ("label", "P", "fraction", "admissible")]
    rows = [Neighbour(str(a), float(b), float(c), bool(e)) for a, b, c, e in zip(*columns, strict=True) if c > 0]
    return tuple(sorted(rows, key=lambda one: -one.share))


def _edge(optimum: Optimum, way: Direction, reach: float) -> Edge:
    omega0: Any = optimum.device.omega0  # One number: where walls differ nobody asks for an edge.
    # Of all that the motion depends on, omega0 changes kappa alone.
    kappa = float(omega0) * math.pi / float(optimum.device.omega)
    within = ((1 - reach) * kappa, (1 + reach) * kappa)
    # What comes first is all that is asked, a graze too.
    settings = ContinuationSettings(max_grazings=0)
    (followed,) = continuation.follow(optimum.orbit, "kappa", within, direction=way, settings=settings)
    if followed.points:
        kind, at = followed.points[0][:2]
    elif followed.ends[1] in ("low", "high"):
        kind, at = "none", within[way == "up"]
    else:
        kind, at = followed.ends[1], float(followed.values[-1])
    return Edge(kind, float(omega0) * at / kappa, 100 * (at / kappa - 1))


@door
def weighted(
    design: Design, *, starts: int = 500, reach: float = 0.2, points: int = 17, seed: int | None = None
) -> Optimum | None:
    """Find the design of most P times basin share, by line searches from the optima along each tuned quantity in turn.

    Shares come from simulated starts: they have no gradient.

    Args:
        design: Whose optima are set out from, those that P alone cannot put ahead left out.
        starts: Of balls at every point.
        reach: How far a search goes, in parts of the quantity.
        points: Values at which a search looks, first coarsely, then as many about the best of these.
        seed: Of starts drawn at random.

    Returns:
        The optimum, its `height` P times share [J], without a gradient; None if the design has none.

    Raises:
        ValueError: As `surroundings`.
    """
    checks.instance("design", design, Design, "vijax.optimise(...)")
    starts, reach, seed = checks.whole("starts", starts, 1, MOST_STARTS), _checked(reach), checks.seed(seed)
    points = checks.whole("points", points, 3, _MOST_POINTS)
    best: Optimum | None = None
    for one in design.optima:
        if isinstance(one, Optimum) and (best is None or best.height < one.P):
            found = _searched(design, one, starts, reach, points, seed)
            best = found if best is None or found.height > best.height else best
    return best


def _searched(design: Design, optimum: Optimum, starts: int, reach: float, points: int, seed: int | None) -> Optimum:
    names = design.tune
    low, high = (variables(names, [design.bounds[name][side] for name in names]) for side in (0, 1))
    z = variables(names, [optimum.values[name] for name in names])

    def score(z: np.ndarray) -> float:
        rows = _attractors(_device(optimum, names, z), starts, seed)
        return sum(one.P * one.share for one in rows if one.label == optimum.label and one.admissible)

    height = score(z)
    for index in range(len(names)):
        # First the whole reach, then what lies between the neighbours of the best point there.
        for span in (reach, 2 * reach / (points - 1)):
            line = np.tile(z, (points, 1))
            line[:, index] += span * np.linspace(-1, 1, points)
            line = np.unique(np.clip(line, low, high), axis=0)
            scores = [score(point) for point in line]
            if max(scores) > height:
                z, height = line[int(np.argmax(scores))], max(scores)
    device = _device(optimum, names, z)
    orbit = _followed(optimum, device)
    (state,) = states([device], orbit)
    return dataclasses.replace(
        optimum,
        values=dict(zip(names, np.asarray(values(names, z)).tolist(), strict=True)),
        device=device,
        orbit=orbit,
        height=height,
        P=float(state.P),
        state=state,
        gradient={},
        active=(),
        stopped="weighted",
    )


def _device(optimum: Optimum, names: tuple[str, ...], z: np.ndarray) -> Harvester:
    return jax.tree.map(float, tuned(optimum.device, names, z))


def _followed(optimum: Optimum, device: Harvester) -> Orbit:
    """Follow the optimum's orbit as its device becomes another one, in small steps."""
    begin, end, orbit = optimum.device.pair(), device.pair(), optimum.orbit
    for step in range(1, _STEPS + 1):
        pair = jax.tree.map(lambda a, b, part=step / _STEPS: jnp.array([a + part * (b - a)]), begin, end)
        orbit = periodic.solve(pair, orbit.sequence, jnp.nan_to_num(orbit.knots))
    if int(orbit.status[0]) != Status.OK:
        raise RuntimeError(f"the orbit was lost between two devices that both have it; got {orbit.status}")
    return orbit
