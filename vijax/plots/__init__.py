"""Pictures of maps, orbit diagrams, branches, curves and designs; no other folder imports matplotlib.

`style` checks before a run whether a picture can be drawn, without importing matplotlib. Begin with `number_maps`.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from vijax.runtime.lazy_imports import load, name_locations

if TYPE_CHECKING:
    from vijax.plots.branch_diagrams import branches
    from vijax.plots.curve_maps import curves
    from vijax.plots.designs import design, design_map
    from vijax.plots.figure import save
    from vijax.plots.fits import fit
    from vijax.plots.kind_maps import basins, label_map
    from vijax.plots.motions import energies, trajectory
    from vijax.plots.number_maps import difference_map, power_map, variable_map
    from vijax.plots.orbit_diagrams import orbit_diagram
    from vijax.plots.responses import response
else:
    _MODULES = name_locations(__name__, Path(__file__))

    def __getattr__(name: str) -> Any:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return load(_MODULES[name])


__all__ = [
    "basins",
    "branches",
    "curves",
    "design",
    "design_map",
    "difference_map",
    "energies",
    "fit",
    "label_map",
    "orbit_diagram",
    "power_map",
    "response",
    "save",
    "trajectory",
    "variable_map",
]
