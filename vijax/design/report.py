"""All results of a design as nested dicts and lists of numbers and strings; `report_lines` formats them as text."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.design.objective import OBJECTIVES
from vijax.design.optimise import Design
from vijax.design.optimum import AperiodicOptimum, BaseOptimum, Optimum
from vijax.design.robustness.off_design import ArrivalStatistics, ParameterRange
from vijax.design.robustness.surroundings import Surroundings
from vijax.design.robustness.tolerance import Tolerance, ToleranceStatistics
from vijax.design.robustness.tolerance_plane import TolerancePlane
from vijax.model.device import CONSTANTS
from vijax.model.energy import energy_ratio
from vijax.model.pair import pair_quantities
from vijax.model.quantities import SIDES
from vijax.model.tuned_quantities import LINEAR, constant
from vijax.model.walls.sides import values_by_name
from vijax.runtime import validation

if TYPE_CHECKING:
    import xarray as xr

# Names of the attributes of a diagram that may hold the radius R0: one for both walls, or one per wall.
_RADII = ("harvester_R0", *(f"harvester_R0_{side}" for side in SIDES))


def describe(
    design: Design,
    *,
    surroundings: Surroundings | None = None,
    parameter_ranges: Sequence[ParameterRange] = (),
    arrival: ArrivalStatistics | None = None,
    diagram: "xr.Dataset | None" = None,
    tolerances: Sequence[Tolerance] = (),
    spread: ToleranceStatistics | None = None,
    ranking: Sequence[tuple[BaseOptimum, ToleranceStatistics]] = (),
    plane: TolerancePlane | None = None,
) -> dict[str, Any]:
    """Return all results of a design in nested dicts and lists of numbers and strings.

    Args:
        design: Result of `vijax.optimise`.
        surroundings, parameter_ranges, arrival: Results for the best optimum: coexisting attractors and bifurcations,
            ranges of the tuned quantities with the same motion, and share of starts that reach the motion.
        diagram: Result of `vijax.orbit_diagram` at the best optimum, with P along one axis in both directions.
        tolerances, spread: Tolerances of the best optimum, and the result of
            `vijax.design.optimise.tolerance_statistics` for them.
        ranking: All optima with statistics over the tolerances, by descending mean P:
            `vijax.design.robustness.off_design.rank_under_tolerances`.
        plane: Curves about the best optimum in the plane of two tolerances: `vijax.tolerance_plane`.

    Returns:
        A dict with the entries `best` (None if no admissible motion was found), `others`, `dropped` (candidates with a
        higher predicted objective than the best design), the arguments of the search, and one entry for each optional
        argument. If `diagram` is specified, `highest` is its point with the largest P, admissible or not, which an
        optimiser without constraints would return; otherwise None.
    """
    validation.validate_instance("design", design, Design, "vijax.optimise(...)")
    if surroundings is not None:
        validation.validate_instance(
            "surroundings", surroundings, Surroundings, "vijax.design.robustness.surroundings(...)"
        )
    if spread is not None:
        validation.validate_instance(
            "spread", spread, ToleranceStatistics, "vijax.design.optimise.tolerance_statistics(...)"
        )
    if plane is not None:
        validation.validate_instance("plane", plane, TolerancePlane, "vijax.tolerance_plane(...)")
    if diagram is not None:
        validation.validate_dataset(
            "diagram", diagram, ("P", "max_penetration", "energy_ratio", "admissible"), "orbit_diagram"
        )
    validation.validate_records(
        "tolerances", tolerances, Tolerance, "vijax.design.robustness.tolerance.Tolerance records"
    )
    return {
        "tune": list(design.tune),
        "bounds": {name: list(pair) for name, pair in design.bounds.items()},
        "objective": design.objective,
        "objective_means": OBJECTIVES[design.objective],
        "survey": design.survey._asdict(),
        "ascents": design.ascents,
        "places": design.places,
        "dropped": [item._asdict() for item in design.dropped],
        "best": describe_optimum(design.best) if design.best else None,
        "others": [describe_optimum(item) for item in design.optima[1:]],
        "surroundings": _surroundings_fields(surroundings) if surroundings else None,
        "parameter_ranges": [_range_fields(item) for item in parameter_ranges],
        "arrival": arrival._asdict() if arrival else None,
        "tolerances": [dataclasses.asdict(item) for item in tolerances],
        "spread": spread._asdict() if spread else None,
        "ranking": [{"optimum": _rank(design, item)} | statistics._asdict() for item, statistics in ranking],
        "plane": _plane_fields(plane) if plane else None,
        "highest": _highest_point(diagram) if diagram is not None else None,
    }


def describe_optimum(optimum: Optimum | AperiodicOptimum) -> dict[str, Any]:
    """Return the fields of an optimum as a dict of numbers and strings.

    An orbit has penetration, harvested energy, energy given to the membrane and the ratio of these energies at each
    impact. Any other motion has the largest penetration and ratio in all simulated periods, and standard errors of
    averages.
    """
    validation.validate_instance("optimum", optimum, BaseOptimum, "vijax.optimise(...).best")
    device = optimum.device
    # Fields of both kinds of optima. `_average_fields` or `_orbit_fields` adds the others.
    common = {
        "values": optimum.values,
        "label": optimum.label,
        "objective_value": optimum.objective_value,
        "P": optimum.P,
        "P_stderr": optimum.P_stderr,
        **_numbers("omega0", device.omega0),
        "pair": {name: float(value) for name, value in pair_quantities(device.pair()).items()},
        "device": {key: x for name in CONSTANTS for key, x in _numbers(name, getattr(device, name)).items()},
        **_numbers("penetration_limit", device.depth_limit),
        "energy_ratio_limit": float(device.energy_ratio_limit),
        "gradient": optimum.gradient,
        "active": list(optimum.active),
        "stopped": optimum.stopped,
        # Arrays become lists when the report is written as JSON.
        "path": optimum.path,
        "path_objective": optimum.path_objective,
    }
    return common | (_average_fields(optimum) if isinstance(optimum, AperiodicOptimum) else _orbit_fields(optimum))


def _numbers(name: str, value: Any) -> dict[str, float]:
    """Return {name: value} of a constant; if the walls differ, one entry per wall, for example omega0_left."""
    return {argument: float(number) for argument, number in values_by_name(name, value).items()}


def _average_fields(best: AperiodicOptimum) -> dict[str, Any]:
    """Return the fields that only an optimum on aperiodic or long motion has."""
    return {
        "power": best.power,
        "speed": best.speed,
        "penetration": [best.max_penetration],
        "energy_ratio": [best.energy_ratio],
        "lyapunov": best.lyapunov,
        "kept_limits": best.admissible,
        "shares": best.shares,
        "gradient_stderr": best.gradient_stderr,
        "predicted": best.predicted,
        "samples": best.confirmation_size[0],
        "periods": best.confirmation_size[1],
        "ensembles": best.ensembles,
    }


def _orbit_fields(best: Optimum) -> dict[str, Any]:
    """Return the fields that only an optimum on an orbit has."""
    state = best.state
    # Arrays of impacts are padded beyond `count`.
    count = int(np.asarray(best.orbit.count)[0])
    energy, work = state.energy[:count], state.work[:count]
    return {
        "power": float(state.power),
        "speed": float(state.speed),
        "penetration": state.depth[:count],
        "energy": energy,
        "work": work,
        "energy_ratio": np.asarray(energy_ratio(energy, work)),
        "multipliers": [[x.real, x.imag] for x in np.asarray(best.orbit.multipliers)[0].tolist()],
        "largest_multiplier": float(state.multiplier),
        "condition": float(state.condition),
        "clearance": {name: float(x) for name, x in state.clearance._asdict().items()},
        "residual": float(state.residual),
        "evaluations": best.evaluations,
    }


def _rank(design: Design, optimum: BaseOptimum) -> int:
    """Return the index of an optimum in `design.optima`; 0 is the best."""
    # Optima are compared by identity, because two optima may have equal values.
    return next(rank for rank, other in enumerate(design.optima) if other is optimum)


def _range_fields(parameter_range: ParameterRange) -> dict[str, Any]:
    """Return the fields of a `ParameterRange` as a dict."""
    return {
        "name": parameter_range.name,
        "below": parameter_range.below._asdict(),
        "above": parameter_range.above._asdict(),
    }


def _surroundings_fields(surroundings: Surroundings) -> dict[str, Any]:
    """Return the fields of `Surroundings` as a dict."""
    return {
        "share": surroundings.share,
        "attractors": [attractor._asdict() for attractor in surroundings.attractors],
        "below": surroundings.below._asdict() if surroundings.below else None,
        "above": surroundings.above._asdict() if surroundings.above else None,
    }


def _plane_fields(plane: TolerancePlane) -> dict[str, Any]:
    """Return the fields of a `TolerancePlane` as a dict, with the number of curves in place of the curves."""
    return {
        "names": [tolerance.name for tolerance in plane.tolerances],
        "spreads": [tolerance.spread for tolerance in plane.tolerances],
        "centre": list(plane.centre),
        "bounds": {name: list(pair) for name, pair in plane.bounds.items()},
        "curves": len(plane.curves),
        "nearest": plane.nearest._asdict() if plane.nearest else None,
        "limit": plane.limit._asdict() if plane.limit else None,
    }


def _highest_point(diagram: "xr.Dataset") -> dict[str, Any]:
    """Return the point of a diagram with the largest P."""
    along = str(diagram.attrs["along"])
    # P is NaN where no average exists; it counts as 0.
    peak = diagram.isel({dim: int(i) for dim, i in diagram["P"].fillna(0.0).argmax(("direction", along)).items()})
    names = ("P", "max_penetration", "energy_ratio", "admissible")
    peak_values = {name: peak[name].item() for name in names}
    # Motion beyond a limit is unphysical only if the energy ratio exceeds 1 or the penetration exceeds R0. If the walls
    # differ in R0, the larger R0 is used, because a larger penetration is unphysical at either wall.
    radii = [value for name, value in diagram.attrs.items() if name in _RADII]
    unphysical = peak_values["energy_ratio"] > 1 or peak_values["max_penetration"] > max(radii)
    return {"along": along, "value": float(peak[along]), "unphysical": unphysical} | peak_values


def tolerance_factors(name: str, tolerances: Sequence[dict[str, Any]]) -> tuple[float, float] | None:
    """Return the lowest and highest factor on a quantity by its tolerance; None if its constant has no tolerance."""
    for tolerance in tolerances:
        # k, kappa and d take the tolerance of the constant that determines them.
        if tolerance["name"] == constant(name) and name not in LINEAR:
            x = tolerance["spread"]
            low, high = (1 - x, 1 + x) if tolerance["kind"] == "uniform" else (np.exp(-x), np.exp(x))
            # k is proportional to the square of omega0, the constant that determines it.
            return (low**2, high**2) if name == "k" else (low, high)
    return None
