"""Optima, and the verification of the ends of ascents.

The exact impact map must confirm the orbit of an end, and the orbit must be attracting. Of several ends with the same
variables only the end with the highest objective is kept.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vijax.design.aperiodic.motion_averages import LIMIT_NAMES
from vijax.design.design_settings import DesignSettings
from vijax.design.objective import ObjectiveSpec
from vijax.design.survey.orbit_candidates import AscentStarts
from vijax.model.device import Harvester
from vijax.model.records import Status
from vijax.model.tuned_quantities import to_values, to_variables, tune_device
from vijax.orbits import orbit_properties, periodic
from vijax.orbits.periodic import Orbit
from vijax.orbits.steady import Steady, steady
from vijax.runtime import tiles
from vijax.runtime.compilation.programs import jitted
from vijax.runtime.public_api import public_api
from vijax.simulation.simulate import Starts

_ORBITS_PER_CALL = (16, 256)  # numbers of optima in one compiled call


@dataclass(frozen=True, kw_only=True)
class BaseOptimum:
    """A design with any kind of motion; see `Optimum` and `AperiodicOptimum`.

    Attributes:
        values: The tuned quantities by name.
        device: The device with these values.
        label: Label of the motion: n:m/pT for n left and m right impacts in p forcing periods, or "aperiodic".
        objective_value: Value of the objective.
        P, P_stderr: Energy harvested per half forcing period, and its standard error [J]. The error is 0 for an orbit;
            for aperiodic motion it follows from the scatter of the samples.
        gradient: Derivative of ln(objective) in the logarithm of each tuned quantity; for an inclination, in the
            inclination itself.
        active: Names of the limits and bounds that are reached.
        stopped: Reason why the search ended.
        path: Values of the tuned quantities at the accepted points of the search, in order, [point, quantity].
        path_objective: Objective at each point of `path`.
    """

    values: dict[str, float]
    device: Harvester
    label: str
    objective_value: float
    P: float
    P_stderr: float
    gradient: dict[str, float]
    active: tuple[str, ...]
    stopped: str
    path: np.ndarray
    path_objective: np.ndarray

    @property
    def z(self) -> np.ndarray:
        """Return the variables: the logarithm of each tuned quantity, or an inclination itself."""
        return np.asarray(to_variables(tuple(self.values), list(self.values.values())))


@dataclass(frozen=True, kw_only=True)
class Optimum(BaseOptimum):
    """A verified design on an orbit, usually the end of an ascent.

    Attributes:
        orbit: The orbit, with a leading axis of length one, and its multipliers.
        state: Energies, depths, parts of the margins, condition and clearance of the nominal device; see `Steady`.
        evaluations: Number of evaluations of objective and gradient.

    `active` names limits with the wall of the impact. `stopped` is "maximum"; "supremum", if the objective rises up to
    the values where the orbit ceases to exist, so that no orbit attains the supremum; "evaluations", if the largest
    number of evaluations was reached; "stalled", if no step raises the objective although the gradient is not zero, as
    at a kink where two devices have the same worst P; "basin power", if the optimum was returned by
    `surroundings.maximise_basin_power`.
    """

    orbit: Orbit
    state: Steady
    evaluations: int


@dataclass(frozen=True, kw_only=True)
class AperiodicOptimum(BaseOptimum):
    """A design on a motion that is not an orbit, confirmed by a long simulation of many samples at exactly its values.

    Attributes:
        power: Harvested power [W].
        speed, max_penetration, energy_ratio: Largest speed into a wall [m/s], penetration [m], and ratio of harvested
            energy to energy given to the membrane, over all samples and periods.
        lyapunov: Largest Lyapunov exponent per forcing period, the mean of the samples; NaN if no sample has one.
        admissible: Share of the samples that broke no limit.
        shares: Share of the samples that ended on each motion, by its label, the largest first.
        gradient_stderr: Standard errors of `gradient`; gradient and errors were fitted to the last accepted ensemble.
        predicted: Objective that the ensembles predicted; `objective_value` is the objective that the confirming
            simulation measured.
        ensembles: Number of simulated ensembles.
        confirmation_size: Number of samples of the confirming simulation, and forcing periods of each sample.
        starts: Last states of the samples of the confirming simulation.

    The label is n:m/pT if the motion is an orbit too long to be climbed. `stopped` is "maximum", if the slopes are
    certainly small or a limit is active; "noise", if the standard errors are too large to exclude a slope; "slope", if
    there is a certain slope but no ensemble further along it was higher; "refused", if ensembles were refused until the
    radius was too small; "outdone", if the prediction could not exceed the best objective; or "ensembles", if the
    largest number of ensembles was reached. `path` has the centres of the accepted ensembles, with the objectives
    fitted there.
    """

    power: float
    speed: float
    max_penetration: float
    energy_ratio: float
    lyapunov: float
    admissible: float
    shares: dict[str, float]
    gradient_stderr: dict[str, float]
    predicted: float
    ensembles: int
    confirmation_size: tuple[int, int]
    starts: Starts


class DroppedCandidate(NamedTuple):
    """A candidate that is not returned as a design.

    Attributes:
        values: The tuned quantities by name.
        label: Label of its motion.
        predicted: Predicted objective.
        measured: Objective of the verification; NaN if it was not measured.
        reason: Reason why it was dropped.
    """

    values: dict[str, float]
    label: str
    predicted: float
    measured: float
    reason: str


class AscentEnd(NamedTuple):
    """The end of one ascent, as fields of `AscentState` without the axis of starts.

    Attributes:
        z: Variables.
        objective_value, gradient: Objective, NaN if the orbit does not exist, and derivative of ln(objective) in the
            variables.
        margins: Margins to the limits [node, limit, impact], flattened, node 0 being the nominal device; then distances
            to the lower and to the upper bounds.
        impact_unknowns: Impact unknowns of the nominal device.
        reached_edge: True if the orbit did not exist at the last trial.
        converged: True if the last barrier weight was at most 1e-6.
        evaluations: Number of evaluations.
        path, path_objective: Variables and log-objective after every evaluation; NaN where a trial was refused.
    """

    z: np.ndarray
    objective_value: float
    gradient: np.ndarray
    margins: np.ndarray
    impact_unknowns: np.ndarray
    reached_edge: bool
    converged: bool
    evaluations: int
    path: np.ndarray
    path_objective: np.ndarray


class VerifiedOptima(NamedTuple):
    """For each device: optima, the highest objective first, and ends of ascents that failed verification."""

    optima: list[list[Optimum]]
    dropped: list[list[DroppedCandidate]]


# Reasons for dropping an end, by the status that the exact map or the steady state returns.
_FLAWS = {
    Status.NO_ORBIT: "the exact map has no orbit there",
    Status.VIRTUAL: "the ball would meet a wall in between",
    Status.UNSTABLE: "the orbit repels",
}


def verify_ends(
    spec: ObjectiveSpec,
    starts: AscentStarts,
    ends: list[AscentEnd],
    devices: list[Harvester],
    max_evaluations: int,
    settings: DesignSettings,
) -> VerifiedOptima:
    """Verify the ends of ascents and return the distinct optima of every device, the highest objective first.

    An end is an optimum if it is admissible, the exact impact map confirms its orbit, and the orbit is attracting.
    """
    device_index = starts.device_index
    chosen = [i for i, end in enumerate(ends) if end.margins.min() >= 0 and np.isfinite(end.objective_value)]
    chosen = [i for rows in distinct_ends(chosen, ends, device_index, settings.same_optimum) for i in rows]
    if not chosen:
        return VerifiedOptima([[] for _ in devices], [[] for _ in devices])
    tuned_devices = [jax.tree.map(float, tune_device(devices[device_index[i]], spec.names, ends[i].z)) for i in chosen]
    stacked = jax.tree.map(lambda *x: jnp.array(x), *tuned_devices)
    width = starts.orbits.side.shape[1]
    padded = [np.pad(ends[i].impact_unknowns, ((0, width - len(ends[i].impact_unknowns)), (0, 0))) for i in chosen]
    sequence = starts.select(np.array(chosen)).orbits.sequence(width)
    orbits = periodic.solve(jax.vmap(lambda d: d.pair())(stacked), sequence, jnp.array(padded))
    states = steady_states(tuned_devices, orbits)
    # Ascents only solve the equations of an orbit. The status also shows whether it is real and attracting.
    flaws = [Status(int(max(orbits.status[row], states[row].status))) for row in range(len(tuned_devices))]
    names = orbit_properties.orbit_labels(orbits)
    optima: list[list[Optimum]] = [[] for _ in devices]
    dropped: list[list[DroppedCandidate]] = [[] for _ in devices]
    for row, flaw in enumerate(flaws):
        end = ends[chosen[row]]
        tuned_values = dict(zip(spec.names, np.asarray(to_values(spec.names, end.z)).tolist(), strict=True))
        if flaw != Status.OK:
            dropped[device_index[chosen[row]]].append(_drop(tuned_values, str(names[row]), end.objective_value, flaw))
            continue
        accepted = np.isfinite(end.path_objective)
        optimum = Optimum(
            values=tuned_values,
            device=tuned_devices[row],
            orbit=orbits[row : row + 1],
            label=str(names[row]),
            objective_value=end.objective_value,
            P=float(states[row].P),
            P_stderr=0.0,
            state=states[row],
            gradient=dict(zip(spec.names, end.gradient.tolist(), strict=True)),
            active=_active(spec, end, sequence.side[row], settings.active_margin),
            stopped=_reason(end, max_evaluations),
            evaluations=end.evaluations,
            path=np.asarray(to_values(spec.names, end.path[accepted])),
            path_objective=np.exp(end.path_objective[accepted]),
        )
        optima[device_index[chosen[row]]].append(optimum)
    return VerifiedOptima(optima, dropped)


def _drop(tuned_values: dict[str, float], label: str, objective_value: float, flaw: Status) -> DroppedCandidate:
    """Return the record of an end that failed verification with the status `flaw`."""
    # A status without an entry is reported by its name.
    return DroppedCandidate(tuned_values, label, objective_value, np.nan, _FLAWS.get(flaw, flaw.name.lower()))


def _reason(end: AscentEnd, max_evaluations: int) -> str:
    """Return the reason why an ascent ended."""
    # The last step led to a point without the orbit, so the objective still rose up to that point.
    if end.reached_edge:
        return "supremum"
    if end.converged:
        return "maximum"
    return "evaluations" if end.evaluations >= max_evaluations else "stalled"


def distinct_ends(good: list[int], ends: list[AscentEnd], device_index: np.ndarray, same: float) -> Iterator[list[int]]:
    """Yield, for every device, the indices of its distinct ends, the highest objective first.

    Args:
        good: Indices of the ends to compare.
        ends: All ends.
        device_index: Index of the device of each end.
        same: Largest difference in any variable of two ends that count as one.
    """
    for index in np.unique(device_index[good]):
        distinct: list[int] = []
        # Of equal ends the first in this order, which has the highest objective, is kept.
        for i in sorted((i for i in good if device_index[i] == index), key=lambda i: -ends[i].objective_value):
            if all(np.abs(ends[i].z - ends[k].z).max() > same for k in distinct):
                distinct.append(i)
        yield distinct


# Compiled once for all designs. Messages about compilation contain `name`.
_steady_states = jitted(jax.vmap(steady), name="steady states")


@public_api
def steady_states(devices: list[Harvester], orbit: Orbit) -> list[Steady]:
    """Return the steady state of every device on its orbit; computed in padded tiles."""
    stacked, results = jax.tree.map(lambda *x: np.array(x), *devices), []
    for tile in tiles.tiles(len(orbit), _ORBITS_PER_CALL):
        tile_states = _steady_states(jax.tree.map(lambda x, rows=tile.rows: x[rows], stacked), orbit[tile.rows])
        tile_states = jax.tree.map(np.asarray, tile_states)
        # Padding rows of the last tile are dropped.
        results += [jax.tree.map(lambda x, row=row: x[row], tile_states) for row in range(tile.real)]
    return results


def _active(spec: ObjectiveSpec, end: AscentEnd, side: Any, near: float) -> tuple[str, ...]:
    """Return the names of the limits and bounds with a margin below `near` at an end."""
    # Margins are ordered as in `AscentEnd.margins`: [node, limit, impact], then lower and upper bounds.
    count, width = len(spec.names), end.impact_unknowns.shape[0]
    margins, low, high = np.split(end.margins, [end.margins.size - 2 * count, end.margins.size - count])
    names = []
    for node, kind, impact in np.argwhere(margins.reshape(-1, 2, width) < near):
        wall = "left" if side[impact] < 0 else "right"
        # Node 0 is the nominal device; the other nodes have constants scattered by the tolerances.
        names.append(f"{LIMIT_NAMES[kind]} at the {wall} wall" + (" at an end of the tolerance" if node else ""))
    names += [f"lower bound of {name}" for name, distance in zip(spec.names, low, strict=True) if distance < near]
    names += [f"upper bound of {name}" for name, distance in zip(spec.names, high, strict=True) if distance < near]
    # If several impacts reach a limit, its name is listed once.
    return tuple(dict.fromkeys(names))
