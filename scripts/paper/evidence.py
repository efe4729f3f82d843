"""Functions for the checks of claims: attractors along runs, shares of starts, Lyapunov exponents, bifurcations."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from scripts.paper.cached import diagram
from scripts.paper.captions import GAP_IN_METRES, Run
from vijax.continuation.branch_continuation import Branch
from vijax.maps.basins import basin_fractions
from vijax.maps.chaos import lyapunov
from vijax.model.device import Harvester
from vijax.model.label import label
from vijax.orbits.periodic import Orbit

if TYPE_CHECKING:
    import xarray as xr

STARTS = 64  # starts per cell for the shares of coexisting attractors
SEARCHED_PERIODS = 2000  # longest simulation before a motion counts as aperiodic


def labels(run: Run, **where: float) -> "xr.DataArray":
    """Return the labels of the attractors along a run."""
    dataset = part(run, **where)
    names = label(dataset.period, dataset.impacts_left, dataset.impacts_right, dataset.status, merge_mirrors=True)
    return dataset.period.copy(data=names)


def part(run: Run, **where: float) -> "xr.Dataset":
    """Return the part of a run's diagram nearest to values of its axes."""
    return diagram(run).sel(where, method="nearest")


def values(labels: "xr.DataArray", *names: str) -> np.ndarray:
    """Return the values of the swept axis with an attractor of these names, in the order of the sweep."""
    along = labels[labels.dims[0]].values
    return along[np.isin(labels.values, names)]


def bands(labels: "xr.DataArray") -> Iterator[tuple[str, float, float]]:
    """Yield the stretches of one label along a sweep: label, first and last value."""
    along, names = labels[labels.dims[0]].values, labels.values
    edges = np.flatnonzero(names[1:] != names[:-1]) + 1
    for stretch in np.split(np.arange(names.size), edges):
        yield str(names[stretch[0]]), float(along[stretch[0]]), float(along[stretch[-1]])


def describe_bands(labels: "xr.DataArray") -> str:
    """Return a text with the stretches of a sweep."""
    return ", ".join(
        f"{name} {first:.4g}" if first == last else f"{name} {first:.4g} to {last:.4g}"
        for name, first, last in bands(labels)
    )


def stretch(labels: "xr.DataArray", name: str, at: float) -> tuple[float, float]:
    """Return the first and last value of the stretch of a label around a value; undecided points do not end it."""
    along, names = labels[labels.dims[0]].values, labels.values
    inside = np.isin(names, (name, "undecided"))
    here = int(np.argmin(np.abs(along - at)))
    before = np.flatnonzero(~inside[:here])
    after = np.flatnonzero(~inside[here:])
    first = before[-1] + 1 if before.size else 0
    last = here + after[0] - 1 if after.size else along.size - 1
    return float(along[first]), float(along[last])


def shares(starts: int = STARTS, **axes: Any) -> dict[str, float]:
    """Return the attractors of a cell with their shares of the starts."""
    dataset = basin_fractions(starts=starts, merge_mirrors=True, periods=SEARCHED_PERIODS, **axes)
    shares: dict[str, float] = {}
    for name, share in zip(dataset.label.values.ravel(), dataset.fraction.values.ravel(), strict=True):
        if name:
            shares[str(name)] = shares.get(str(name), 0.0) + float(share)
    return shares


def commonest(shares: dict[str, float]) -> str:
    """Return the attractor with the largest share of the starts."""
    return max(shares, key=lambda name: shares[name])


def describe_shares(shares: dict[str, float]) -> str:
    """Return a text with the shares in percent."""
    return ", ".join(f"{name} {100 * share:.3g} %" for name, share in shares.items())


class Exponent(NamedTuple):
    """A Lyapunov exponent per period with its standard error."""

    value: float
    error: float

    def __str__(self) -> str:
        return f"{self.value:.3f} +- {self.error:.3f}"

    @property
    def chaotic(self) -> bool:
        """Return True if the exponent is positive by more than three standard errors."""
        return self.value > 3 * self.error


def exponent(**axes: Any) -> Exponent:
    """Compute the Lyapunov exponent of a cell; the arguments are the arguments of `lyapunov`."""
    dataset = lyapunov(**axes)
    return Exponent(float(dataset.lyapunov), float(dataset.lyapunov_stderr))


def growth(orbits: Orbit) -> np.ndarray:
    """Compute the modulus of the largest multiplier of each orbit."""
    return np.abs(np.asarray(orbits.multipliers)).max(axis=1)


def stable(orbits: Orbit) -> Orbit:
    """Return the stable orbits."""
    return orbits[np.flatnonzero(growth(orbits) < 1)]


def speeds(orbits: Orbit) -> np.ndarray:
    """Return the speeds into the walls, of shape (orbit, impact)."""
    return np.asarray(orbits.impact_unknowns[..., 1])


def nearest_event(branches: list[Branch], kind: str, near: float) -> float:
    """Return the parameter of the event of a kind nearest to a value; NaN if the branches have no such event."""
    values = [point.value for branch in branches for point in branch.points if point.kind == kind]
    return min(values, key=lambda value: abs(value - near), default=np.nan)


def at_frequency(omega: float, k: float | None) -> tuple[float, float | None]:
    """Compute d and kappa of the device of Figs. 12-16 at a frequency; kappa is None for a rigid wall (k None)."""
    device = Harvester(s=GAP_IN_METRES, omega=omega, omega0=400.0 if k is None else float(np.sqrt(k / Harvester().m_b)))
    pair = device.pair("rigid" if k is None else "soft")
    return float(pair.d), None if pair.kappa is None else float(pair.kappa)
