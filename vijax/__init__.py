"""Power maps of vibro-impact energy harvesters with soft and hard walls, by an exact event-driven engine in JAX.

Importing vijax switches JAX to 64 bits, before any array is made: impact times are worth little at less.
"""

import jax

jax.config.update("jax_enable_x64", True)

from vijax.attractor import basin_fractions, basins
from vijax.chaos import lyapunov, survival
from vijax.compare import compare
from vijax.design import optimise
from vijax.diagram import orbit_diagram
from vijax.energy import harvested_energy
from vijax.grid import load, save, sweep
from vijax.membrane import HuntCrossley
from vijax.model import Harvester, Impact, ImpactPair, State, Status, impact_pair
from vijax.simulate import summarise
from vijax.steady import steady
from vijax.trajectory import trajectory

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
