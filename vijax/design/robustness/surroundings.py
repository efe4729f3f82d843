"""Attractors that coexist with an optimum, its nearest bifurcations, and the maximum of P times basin share."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax.continuation import branch_continuation
from vijax.continuation.branch_continuation import Direction
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.design.optimise import Design
from vijax.design.optimum import AperiodicOptimum, BaseOptimum, Optimum, steady_states
from vijax.maps.basins import basin_fractions
from vijax.maps.sweep_settings import MOST_STARTS
from vijax.model.device import Harvester
from vijax.model.pair import pair_quantities
from vijax.model.records import Status
from vijax.model.tuned_quantities import to_values, to_variables, tune_device
from vijax.orbits import orbit_properties, periodic
from vijax.orbits.periodic import Orbit
from vijax.runtime import validation
from vijax.runtime.public_api import public_api

_SAME_ORBIT = 1e-6  # relative difference of P below which an attractor is the orbit of the optimum
_MAX_POINTS = 10_000  # largest number of points of a line search; each point simulates `starts` starts
_CONTINUATION_STEPS = 8  # steps of the continuation of an orbit from one device to another


class Neighbour(NamedTuple):
    """An attractor of the device: label, P [J per half forcing period], share of all starts, and admissibility."""

    label: str
    P: float
    share: float
    admissible: bool


class NearestBifurcation(NamedTuple):
    """The first bifurcation of the optimum's orbit along omega0 in one direction.

    Attributes:
        kind: "fold", "flip", "pitchfork", "grazing ..." (see `branch_events.Point`), "none" if there is no bifurcation
            within reach, or the reason why the branch ended (see `branch_continuation.Branch.ends`).
        omega0: Value of omega0 at the bifurcation, or at the end of the branch [rad/s].
        percent: Distance from the optimum, in percent of its omega0.
    """

    kind: str
    omega0: float
    percent: float


class Surroundings(NamedTuple):
    """Coexisting attractors and nearest bifurcations of an optimum.

    Attributes:
        share: Share of all starts that the motion of the optimum, or its mirror image, attracts.
        attractors: All attractors that starts reached, including the attractor of the optimum, the largest share first.
        below, above: Nearest bifurcations at smaller and larger omega0, all other constants fixed. None if the walls
            differ, because each wall then has its own omega0 (use `tolerance_plane`). None for a motion that is not an
            orbit, because only orbits can be continued (use `off_design.parameter_ranges`).
    """

    share: float
    attractors: tuple[Neighbour, ...]
    below: NearestBifurcation | None
    above: NearestBifurcation | None


@public_api
def surroundings(
    optimum: Optimum | AperiodicOptimum, *, starts: int = 2000, reach: float = 0.5, seed: int | None = None
) -> Surroundings:
    """Compute the attractors that coexist with an optimum, and the nearest bifurcations along omega0.

    Args:
        optimum: An optimum of `optimise.optimise`.
        starts: Number of simulated starts, which determine attractors and shares; see `basins.basin_fractions`.
        reach: Largest relative change of omega0 that is searched, below 1.
        seed: Seed of random starts.

    Raises:
        ValueError: reach is outside (0, 1), or starts is invalid.
    """
    validation.validate_instance("optimum", optimum, BaseOptimum, "vijax.optimise(...).best")
    reach, seed = _validate_reach(reach), validation.validate_seed(seed)
    attractors = _find_attractors(optimum.device, validation.validate_integer("starts", starts, 1, MOST_STARTS), seed)
    if not isinstance(optimum, Optimum):
        # Aperiodic motion is identified by its label.
        share = sum(attractor.share for attractor in attractors if attractor.label == optimum.label)
        return Surroundings(share, attractors, None, None)
    # Several attractors may have the label of the optimum, so P identifies its attractor.
    optimum_P = float(orbit_properties.orbit_power(optimum.orbit, optimum.device)[0])
    share = sum(
        attractor.share for attractor in attractors if math.isclose(attractor.P, optimum_P, rel_tol=_SAME_ORBIT)
    )
    if optimum.device.has_unequal_walls:
        return Surroundings(share, attractors, None, None)
    return Surroundings(
        share, attractors, _find_bifurcation(optimum, "down", reach), _find_bifurcation(optimum, "up", reach)
    )


def _validate_reach(reach: Any) -> float:
    """Return the reach, or raise ValueError."""
    return validation.validate_real("reach", reach, "a number between 0 and 1", lambda x: 0 < x < 1)


def _find_attractors(device: Harvester, starts: int, seed: int | None) -> tuple[Neighbour, ...]:
    """Return the attractors of a device, mirror images merged, the largest share first."""
    pair = device.pair()
    pair_values: Any = {name: float(value) for name, value in pair_quantities(pair).items()}
    mirrors = bool(pair.symmetric)
    basins = basin_fractions(**pair_values, starts=starts, seed=seed, device=device, merge_mirrors=mirrors)
    columns = [basins[name].values.ravel() for name in ("label", "P", "fraction", "admissible")]
    # Attractors without starts are padding of the arrays.
    rows = [Neighbour(str(a), float(b), float(c), bool(e)) for a, b, c, e in zip(*columns, strict=True) if c > 0]
    return tuple(sorted(rows, key=lambda attractor: -attractor.share))


def _find_bifurcation(optimum: Optimum, direction: Direction, reach: float) -> NearestBifurcation:
    """Return the first bifurcation in one direction along omega0."""
    omega0: Any = optimum.device.omega0  # a number: walls that differ do not reach this function
    # The motion depends on omega0 through kappa alone.
    kappa = float(omega0) * math.pi / float(optimum.device.omega)
    bounds = ((1 - reach) * kappa, (1 + reach) * kappa)
    # Only the first event is needed. A grazing is an event, so the branch need not continue past it.
    settings = ContinuationSettings(max_grazings=0)
    (branch,) = branch_continuation.follow_orbits(
        optimum.orbit, "kappa", bounds, direction=direction, settings=settings
    )
    if branch.points:
        # Events are in the order of the branch, so the first one is the nearest.
        kind, position = branch.points[0][:2]
    elif branch.ends[1] in ("low", "high"):
        kind, position = "none", bounds[direction == "up"]
    else:
        kind, position = branch.ends[1], float(branch.values[-1])
    return NearestBifurcation(kind, float(omega0) * position / kappa, 100 * (position / kappa - 1))


@public_api
def maximise_basin_power(
    design: Design, *, starts: int = 500, reach: float = 0.2, points: int = 17, seed: int | None = None
) -> Optimum | None:
    """Maximise P times basin share by line searches along each tuned quantity, from the optima of a design.

    Basin share is the share of all starts that end on the motion. It is counted from simulated starts, so it has no
    gradient.

    Args:
        design: Line searches start from the optima of this design. An optimum is skipped if its P is below the best P
            times share so far.
        starts: Number of starts simulated at every point of a line search.
        reach: Half width of a line search, relative to the quantity (in rad for an inclination).
        points: Number of points of a line search over its range; a second search has as many points around the best
            one.
        seed: Seed of random starts.

    Returns:
        The optimum, without a gradient; its `objective_value` is P times share [J]. None if the design has no orbit.

    Raises:
        ValueError: As for `surroundings`.
    """
    validation.validate_instance("design", design, Design, "vijax.optimise(...)")
    starts, reach, seed = (
        validation.validate_integer("starts", starts, 1, MOST_STARTS),
        _validate_reach(reach),
        validation.validate_seed(seed),
    )
    points = validation.validate_integer("points", points, 3, _MAX_POINTS)
    best: Optimum | None = None
    for optimum in design.optima:
        # P is an upper bound of P times share, so an optimum with a P below the best result is skipped.
        if isinstance(optimum, Optimum) and (best is None or best.objective_value < optimum.P):
            candidate = _search_lines(design, optimum, starts, reach, points, seed)
            best = candidate if best is None or candidate.objective_value > best.objective_value else best
    return best


def _search_lines(
    design: Design, optimum: Optimum, starts: int, reach: float, points: int, seed: int | None
) -> Optimum:
    """Return the best point of the line searches from one optimum, as an `Optimum`."""
    names = design.tune
    low, high = (to_variables(names, [design.bounds[name][side] for name in names]) for side in (0, 1))
    z = to_variables(names, [optimum.values[name] for name in names])

    def score(z: np.ndarray) -> float:
        """Return the sum of P times share over the admissible attractors with the label of the optimum."""
        attractors = _find_attractors(_make_device(optimum, names, z), starts, seed)
        return sum(
            attractor.P * attractor.share
            for attractor in attractors
            if attractor.label == optimum.label and attractor.admissible
        )

    objective_value = score(z)
    for index in range(len(names)):
        # The first search covers the range, the second one the interval between the neighbours of the best point.
        for half_width in (reach, 2 * reach / (points - 1)):
            line = np.tile(z, (points, 1))
            line[:, index] += half_width * np.linspace(-1, 1, points)
            line = np.unique(np.clip(line, low, high), axis=0)
            scores = [score(point) for point in line]
            if max(scores) > objective_value:
                # The best value along one quantity is the start of the search along the next one.
                z, objective_value = line[int(np.argmax(scores))], max(scores)
    device = _make_device(optimum, names, z)
    orbit = _follow_orbit(optimum, device)
    (state,) = steady_states([device], orbit)
    return dataclasses.replace(
        optimum,
        values=dict(zip(names, np.asarray(to_values(names, z)).tolist(), strict=True)),
        device=device,
        orbit=orbit,
        objective_value=objective_value,
        P=float(state.P),
        state=state,
        gradient={},
        active=(),
        stopped="basin power",
    )


def _make_device(optimum: Optimum, names: tuple[str, ...], z: np.ndarray) -> Harvester:
    """Return the device with these variables."""
    return jax.tree.map(float, tune_device(optimum.device, names, z))


def _follow_orbit(optimum: Optimum, device: Harvester) -> Orbit:
    """Continue the optimum's orbit from its device to another device in eight equal steps of the pair."""
    first, last, orbit = optimum.device.pair(), device.pair(), optimum.orbit
    for step in range(1, _CONTINUATION_STEPS + 1):
        pair = jax.tree.map(lambda a, b, part=step / _CONTINUATION_STEPS: jnp.array([a + part * (b - a)]), first, last)
        orbit = periodic.solve(pair, orbit.sequence, jnp.nan_to_num(orbit.impact_unknowns))
    if int(orbit.status[0]) != Status.OK:
        raise RuntimeError(
            f"the continuation lost an orbit that both devices have; take a smaller reach; got {orbit.status}"
        )
    return orbit
