"""Power maps of vibro-impact energy harvesters with soft and hard walls, by an exact event-driven engine in JAX.

Importing vijax switches JAX to 64 bits, before any array is made: impact times are worth little at less.
"""

from importlib import metadata
from typing import TYPE_CHECKING

import jax

jax.config.update("jax_enable_x64", True)

from vijax.batch.simulate import summarise
from vijax.batch.trajectory import trajectory
from vijax.design.optimise import optimise
from vijax.model.device import Harvester
from vijax.model.energy import harvested_energy
from vijax.model.membrane import HuntCrossley
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Impact, State, Status
from vijax.orbits.steady import steady
from vijax.planes.basins import basin_fractions, basins
from vijax.planes.chaos import lyapunov, survival
from vijax.planes.compare import compare
from vijax.planes.orbit_diagram import orbit_diagram
from vijax.planes.sweep import load, save, sweep

__all__ = [
    "Harvester",
    "HuntCrossley",
    "Impact",
    "ImpactPair",
    "State",
    "Status",
    "basin_fractions",
    "basins",
    "compare",
    "harvested_energy",
    "impact_pair",
    "load",
    "lyapunov",
    "optimise",
    "orbit_diagram",
    "save",
    "steady",
    "summarise",
    "survival",
    "sweep",
    "trajectory",
]


if TYPE_CHECKING:
    __version__: str
else:

    def __getattr__(name: str) -> str:
        if name != "__version__":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return metadata.version("vijax")
