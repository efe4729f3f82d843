"""What a design is worth: everything known of it as plain numbers and words; `report_lines` writes them out."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.design.objective import OBJECTIVES
from vijax.design.off_design import ArrivalStatistics, Extent
from vijax.design.optimise import Design
from vijax.design.optimum import AnyOptimum, AperiodicOptimum, Optimum
from vijax.design.robustness import Surroundings
from vijax.design.tolerance import Spread, Tolerance
from vijax.design.tolerance_plane import TolerancePlane
from vijax.model.device import CONSTANTS
from vijax.model.energy import energy_ratio
from vijax.model.pair import quantities
from vijax.model.sides import named
from vijax.model.variables import LINEAR, constant
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr


def describe(
    design: Design,
    *,
    surroundings: Surroundings | None = None,
    extents: Sequence[Extent] = (),
    arrival: ArrivalStatistics | None = None,
    diagram: "xr.Dataset | None" = None,
    tolerances: Sequence[Tolerance] = (),
    spread: Spread | None = None,
    ranking: Sequence[tuple[AnyOptimum, Spread]] = (),
    plane: TolerancePlane | None = None,
) -> dict[str, Any]:
    """Describe all of a design in nested dicts and lists of numbers and words.

    Args:
        design: What `vijax.optimise` returned.
        surroundings, extents, arrival: Of its best optimum: what attracts there, how far off each tuned quantity may
            be before the motion is another one, and how balls arrive at it.
        diagram: P up and down along an axis at the best optimum, `vijax.orbit_diagram` in both directions.
        tolerances, spread: Over which tolerances the best optimum was judged, and a `vijax.design.optimise.under`
            of them.
        ranking: All optima by what devices give that are off by the tolerances: `vijax.design.off_design.ranked`.
        plane: What bounds the best optimum in the plane of two of them: `vijax.design_plane`.

    Returns:
        `best` (None if no admissible motion was found), `others`, `dropped` (candidates that promised more than the
        best design gives), and what was asked. With `diagram`, `highest`: the
        largest P it holds, admissible or not, which is what an optimiser without constraints would report.
    """
    checks.instance("design", design, Design, "vijax.optimise(...)")
    if surroundings is not None:
        checks.instance("surroundings", surroundings, Surroundings, "vijax.design.robustness.surroundings(...)")
    if spread is not None:
        checks.instance("spread", spread, Spread, "vijax.design.optimise.under(...)")
    if plane is not None:
        checks.instance("plane", plane, TolerancePlane, "vijax.design_plane(...)")
    if diagram is not None:
        checks.variables("diagram", diagram, ("P", "max_penetration", "energy_ratio", "admissible"), "orbit_diagram")
    checks.sequence("tolerances", tolerances, Tolerance, "vijax.design.tolerance.Tolerance records")
    return {
        "tune": list(design.tune),
        "bounds": {name: list(pair) for name, pair in design.bounds.items()},
        "objective": design.objective,
        "objective_means": OBJECTIVES[design.objective],
        "survey": design.looked._asdict(),
        "ascents": design.ascents,
        "places": design.places,
        "dropped": [one._asdict() for one in design.dropped],
        "best": optimum(design.best) if design.best else None,
        "others": [optimum(one) for one in design.optima[1:]],
        "surroundings": _surroundings(surroundings) if surroundings else None,
        "extents": [_extent(one) for one in extents],
        "arrival": arrival._asdict() if arrival else None,
        "tolerances": [dataclasses.asdict(one) for one in tolerances],
        "spread": spread._asdict() if spread else None,
        "ranking": [{"optimum": _place(design, one)} | given._asdict() for one, given in ranking],
        "plane": _plane(plane) if plane else None,
        "highest": _highest(diagram) if diagram is not None else None,
    }


def optimum(one: Optimum | AperiodicOptimum) -> dict[str, Any]:
    """Describe an optimum in plain data.

    Of an orbit, for each impact: penetration, energy, energy given to the membrane, their ratio. Of any other motion
    the largest penetration and ratio of all that was flown, and the standard errors of averages.
    """
    checks.instance("one", one, AnyOptimum, "vijax.optimise(...).best")
    device = one.device
    common = {
        "values": one.values,
        "label": one.label,
        "height": one.height,
        "P": one.P,
        "P_stderr": one.P_stderr,
        **_numbers("omega0", device.omega0),
        "pair": {name: float(value) for name, value in quantities(device.pair()).items()},
        "device": {key: x for name in CONSTANTS for key, x in _numbers(name, getattr(device, name)).items()},
        **_numbers("penetration_limit", device.depth_limit),
        "energy_ratio_limit": float(device.energy_ratio_limit),
        "gradient": one.gradient,
        "active": list(one.active),
        "stopped": one.stopped,
        "path": one.path,
        "heights": one.heights,
    }
    return common | (_averaged(one) if isinstance(one, AperiodicOptimum) else _orbit(one))


def _numbers(name: str, value: Any) -> dict[str, float]:
    """Put a constant under its name, or what each wall has of it under names of their own."""
    return {argument: float(one) for argument, one in named(name, value).items()}


def _averaged(one: AperiodicOptimum) -> dict[str, Any]:
    return {
        "power": one.power,
        "speed": one.speed,
        "penetration": [one.max_penetration],
        "energy_ratio": [one.energy_ratio],
        "lyapunov": one.lyapunov,
        "kept_limits": one.admissible,
        "shares": one.shares,
        "gradient_stderr": one.gradient_stderr,
        "predicted": one.predicted,
        "balls": one.flown[0],
        "periods": one.flown[1],
        "ensembles": one.ensembles,
    }


def _orbit(one: Optimum) -> dict[str, Any]:
    state = one.state
    count = int(np.asarray(one.orbit.count)[0])
    energy, work = state.energy[:count], state.work[:count]
    return {
        "power": float(state.power),
        "speed": float(state.speed),
        "penetration": state.depth[:count],
        "energy": energy,
        "work": work,
        "energy_ratio": np.asarray(energy_ratio(energy, work)),
        "multipliers": [[x.real, x.imag] for x in np.asarray(one.orbit.multipliers)[0].tolist()],
        "largest_multiplier": float(state.multiplier),
        "condition": float(state.condition),
        "clearance": {name: float(x) for name, x in state.clearance._asdict().items()},
        "residual": float(state.residual),
        "evaluations": one.evaluations,
    }


def _place(design: Design, one: AnyOptimum) -> int:
    """Say which optimum of a design one is: 0 is the best."""
    return next(place for place, other in enumerate(design.optima) if other is one)


def _extent(one: Extent) -> dict[str, Any]:
    return {"name": one.name, "below": one.below._asdict(), "above": one.above._asdict()}


def _surroundings(found: Surroundings) -> dict[str, Any]:
    return {
        "share": found.share,
        "attractors": [one._asdict() for one in found.attractors],
        "below": found.below._asdict() if found.below else None,
        "above": found.above._asdict() if found.above else None,
    }


def _plane(found: TolerancePlane) -> dict[str, Any]:
    return {
        "names": [one.name for one in found.tolerances],
        "spreads": [one.spread for one in found.tolerances],
        "here": list(found.here),
        "within": {name: list(pair) for name, pair in found.within.items()},
        "curves": len(found.curves),
        "nearest": found.nearest._asdict() if found.nearest else None,
        "limit": found.limit._asdict() if found.limit else None,
    }


def _highest(diagram: "xr.Dataset") -> dict[str, Any]:
    """Find the point of a diagram with the largest P."""
    along = str(diagram.attrs["along"])
    peak = diagram.isel({dim: int(i) for dim, i in diagram["P"].fillna(0.0).argmax(("direction", along)).items()})
    names = ("P", "max_penetration", "energy_ratio", "admissible")
    found = {name: peak[name].item() for name in names}
    # The limit that a builder sets may be broken by a motion that a device can have.
    unphysical = found["energy_ratio"] > 1 or found["max_penetration"] > diagram.attrs["harvester_R0"]
    return {"along": along, "value": float(peak[along]), "unphysical": unphysical} | found


def factors(name: str, tolerances: Sequence[dict[str, Any]]) -> tuple[float, float] | None:
    """Say by how much a quantity may be off by the tolerance of the constant that decides it; None if it has none."""
    for one in tolerances:
        if one["name"] == constant(name) and name not in LINEAR:
            x = one["spread"]
            low, high = (1 - x, 1 + x) if one["kind"] == "uniform" else (np.exp(-x), np.exp(x))
            return (low**2, high**2) if name == "k" else (low, high)
    return None
