"""Diagrams, orbits and branches of the paper's figures and claims, each computed once."""

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from scripts.paper.captions import GAP_IN_METRES, Run
from vijax.continuation import branch_continuation
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.maps.orbit_diagram import orbit_diagram
from vijax.model.device import Harvester
from vijax.model.pair import impact_pair
from vijax.orbits import orbit_search, periodic

if TYPE_CHECKING:
    import xarray as xr

_IMPACTS = 3  # padded width of orbits, so that all sequences use the same programs


@lru_cache(maxsize=16)
def diagram(run: Run) -> "xr.Dataset":
    """Compute the orbit diagram of a run."""
    axes: Any = {name: np.asarray(values) if isinstance(values, tuple) else values for name, values in run.axes}
    return orbit_diagram(
        along=run.along,
        values=np.array(run.values),
        direction=run.direction,
        wall=run.wall,
        periods=run.periods,
        recorded_periods=run.recorded_periods,
        **axes,
    )


@lru_cache(maxsize=64)
def orbits(walls: str, d: float, kappa: float | None, r: float = 0.5, period: int = 1) -> periodic.Orbit:
    """Return all orbits with this sequence of walls, stable or not; kappa is None for rigid walls."""
    return orbit_search.find_orbits(impact_pair(d, kappa, r), walls, period)


@lru_cache(maxsize=32)
def branches(
    walls: str, along: str, within: tuple[float, float], d: float, kappa: float | None, r: float = 0.5, period: int = 1
) -> list[branch_continuation.Branch]:
    """Return the branches of all orbits with this sequence of walls, without grazing switches.

    A branch along omega uses the device of Figs. 12-16.
    """
    starts = orbits(walls, d, kappa, r, period)
    if not len(starts):
        return []
    device = Harvester(s=GAP_IN_METRES) if along == "omega" else None
    settings = ContinuationSettings(max_grazings=0)
    return branch_continuation.follow_orbits(_padded(starts), along, within, device=device, settings=settings)


def _padded(orbits_to_pad: periodic.Orbit) -> periodic.Orbit:
    width = orbits_to_pad.impact_unknowns.shape[1]

    def pad(leaf: jax.Array) -> jax.Array:
        if leaf.ndim < 2 or leaf.shape[1] != width or leaf is orbits_to_pad.multipliers:
            return leaf
        blank = 0 if jnp.issubdtype(leaf.dtype, jnp.integer) else jnp.nan
        widths = [(0, 0), (0, max(_IMPACTS - width, 0)), *[(0, 0)] * (leaf.ndim - 2)]
        return jnp.pad(leaf, widths, constant_values=blank)

    return jax.tree.map(pad, orbits_to_pad)
