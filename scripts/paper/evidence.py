"""What checks of the paper's claims are made of: attractors along its runs, shares of starts, exponents, borders."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from scripts.paper.cached import diagram
from scripts.paper.captions import GAP_IN_METRES, Run
from vijax.model.device import Harvester
from vijax.model.label import label
from vijax.orbits.continuation import Branch
from vijax.orbits.periodic import Orbit
from vijax.planes.basins import basin_fractions
from vijax.planes.chaos import lyapunov

if TYPE_CHECKING:
    import xarray as xr

STARTS = 64  # of the shares of coexisting attractors
SEARCHED_PERIODS = 2000  # until one of them is called aperiodic


def labels(run: Run, **where: float) -> "xr.DataArray":
    """Name the attractors along a run."""
    found = part(run, **where)
    names = label(found.period, found.impacts_left, found.impacts_right, found.status, merge_mirrors=True)
    return found.period.copy(data=names)


def part(run: Run, **where: float) -> "xr.Dataset":
    """Pick the part of a run's diagram nearest to some values of its axes."""
    return diagram(run).sel(where, method="nearest")


def values(labels: "xr.DataArray", *names: str) -> np.ndarray:
    """Find values of the swept axis at which the attractor has one of some names, in the order of the sweep."""
    along = labels[labels.dims[0]].values
    return along[np.isin(labels.values, names)]


def bands(labels: "xr.DataArray") -> Iterator[tuple[str, float, float]]:
    """Find stretches of one name along a sweep: name, first and last value."""
    along, names = labels[labels.dims[0]].values, labels.values
    edges = np.flatnonzero(names[1:] != names[:-1]) + 1
    for stretch in np.split(np.arange(names.size), edges):
        yield str(names[stretch[0]]), float(along[stretch[0]]), float(along[stretch[-1]])


def told(labels: "xr.DataArray") -> str:
    """Put the stretches of a sweep in words."""
    return ", ".join(
        f"{name} {first:.4g}" if first == last else f"{name} {first:.4g} to {last:.4g}"
        for name, first, last in bands(labels)
    )


def stretch(labels: "xr.DataArray", name: str, at: float) -> tuple[float, float]:
    """Find first and last value of the stretch of a name around a value; undecided points do not end it."""
    along, names = labels[labels.dims[0]].values, labels.values
    inside = np.isin(names, (name, "undecided"))
    here = int(np.argmin(np.abs(along - at)))
    before = np.flatnonzero(~inside[:here])
    after = np.flatnonzero(~inside[here:])
    first = before[-1] + 1 if before.size else 0
    last = here + after[0] - 1 if after.size else along.size - 1
    return float(along[first]), float(along[last])


def shares(starts: int = STARTS, **axes: Any) -> dict[str, float]:
    """Count attractors of one cell by the share of starts that end on each."""
    found = basin_fractions(starts=starts, merge_mirrors=True, periods=SEARCHED_PERIODS, **axes)
    shares: dict[str, float] = {}
    for name, share in zip(found.label.values.ravel(), found.fraction.values.ravel(), strict=True):
        if name:
            shares[str(name)] = shares.get(str(name), 0.0) + float(share)
    return shares


def commonest(shares: dict[str, float]) -> str:
    """Name the attractor on which most starts end."""
    return max(shares, key=lambda name: shares[name])


def told_shares(shares: dict[str, float]) -> str:
    """Put shares in words."""
    return ", ".join(f"{name} {100 * share:.3g} %" for name, share in shares.items())


class Exponent(NamedTuple):
    """A Lyapunov exponent per period with its standard error."""

    value: float
    error: float

    def __str__(self) -> str:
        return f"{self.value:.3f} +- {self.error:.3f}"

    @property
    def chaotic(self) -> bool:
        """Say whether it is positive beyond three standard errors."""
        return self.value > 3 * self.error


def exponent(**axes: Any) -> Exponent:
    """Compute the Lyapunov exponent of a cell, soft or rigid as `lyapunov` is told."""
    found = lyapunov(**axes)
    return Exponent(float(found.lyapunov), float(found.lyapunov_stderr))


def growth(found: Orbit) -> np.ndarray:
    """Compute the modulus of the largest multiplier of each orbit."""
    return np.abs(np.asarray(found.multipliers)).max(axis=1)


def stable(found: Orbit) -> Orbit:
    """Keep those that attract."""
    return found[np.flatnonzero(growth(found) < 1)]


def speeds(found: Orbit) -> np.ndarray:
    """Give the speeds into the walls, [orbit, impact]."""
    return np.asarray(found.knots[..., 1])


def met(branches: list[Branch], kind: str, near: float) -> float:
    """Find the parameter at the point of a kind nearest to a value; NaN if none was met."""
    values = [point.value for each in branches for point in each.points if point.kind == kind]
    return min(values, key=lambda value: abs(value - near), default=np.nan)


def at_frequency(omega: float, k: float | None) -> tuple[float, float | None]:
    """Compute d and kappa of the device of Figs. 12-16 at a frequency; no kappa of a rigid wall."""
    device = Harvester(s=GAP_IN_METRES, omega=omega, omega0=400.0 if k is None else float(np.sqrt(k / Harvester().m_b)))
    pair = device.pair("rigid" if k is None else "soft")
    return float(pair.d), None if pair.kappa is None else float(pair.kappa)
