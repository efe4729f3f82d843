"""Power maps of vibro-impact energy harvesters with soft and hard walls, by an exact event-driven engine in JAX.

Importing vijax switches JAX to 64 bits, before any array is made: impact times are worth little at less. All that a
user needs stands here; what each function takes and returns its docstring says.

Devices and pairs: `Harvester` (SI units) gives an `ImpactPair` (nondimensional), as `impact_pair` does from numbers;
`HuntCrossley` is another membrane, `harvested_energy` the energy of one impact. `State`, `Impact` and `Status` are what
records are made of.

Planes of parameters, as `xarray.Dataset`: `sweep` maps power, kind of motion and all that tells whether to believe it;
`compare` maps what a rigid wall gets wrong, of which `cheapest_model` and `rigid_from` make a verdict; `basins` and
`basin_fractions` say which attractors coexist; `orbit_diagram` follows attractors along an axis; `lyapunov` and
`survival` say how chaotic, and for how long. `save` and `load` keep them in stores.

One motion: `trajectory` returns a `Trajectory`, impact by impact, differentiable.

Periodic orbits, stable or not: `find_orbits` from a sequence of impacts, `orbits_from_states` from states; an `Orbit`
has its Floquet `multipliers`, and `orbit_impacts`, `orbit_labels`, `orbit_power` and `orbit_path` tell more.
`follow_orbits` gives the `Branch` of each along a parameter, `follow_families` also those that begin on it,
`branch_dataset` both as a dataset.

The best device: `steady` is the steady state of an orbit, a `Steady` with derivatives; `optimise` finds the `Design`
that harvests most; `under_tolerances` says what becomes of an `Optimum` when constants scatter as a `Tolerance` says,
`surroundings` what lies around it (`Surroundings`), `weigh_basins` which is best if its basin counts.

Pictures: `plots`, which is loaded, and matplotlib with it, when it is first asked for.
"""

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

import jax

jax.config.update("jax_enable_x64", True)

from vijax.batch.trajectory import Trajectory, trajectory
from vijax.design.optimise import Design, Optimum, optimise
from vijax.design.optimise import under as under_tolerances
from vijax.design.robustness import Surroundings, surroundings
from vijax.design.robustness import weighted as weigh_basins
from vijax.design.tolerance import Tolerance
from vijax.model.device import Harvester
from vijax.model.energy import harvested_energy
from vijax.model.membrane import HuntCrossley
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Impact, State, Status
from vijax.orbits.continuation import Branch
from vijax.orbits.continuation import dataset as branch_dataset
from vijax.orbits.continuation import family as follow_families
from vijax.orbits.continuation import follow as follow_orbits
from vijax.orbits.periodic import Orbit
from vijax.orbits.periodic import from_state as orbits_from_states
from vijax.orbits.periodic import impacts as orbit_impacts
from vijax.orbits.periodic import labels as orbit_labels
from vijax.orbits.periodic import path as orbit_path
from vijax.orbits.periodic import power as orbit_power
from vijax.orbits.periodic import search as find_orbits
from vijax.orbits.steady import Steady, steady
from vijax.planes.basins import basin_fractions, basins
from vijax.planes.chaos import lyapunov, survival
from vijax.planes.compare import cheapest_model, compare, rigid_from
from vijax.planes.orbit_diagram import orbit_diagram
from vijax.planes.store import load, save
from vijax.planes.sweep import sweep

if TYPE_CHECKING:
    from vijax import plots

    __version__: str
else:

    def __getattr__(name: str) -> Any:
        if name == "plots":
            return import_module("vijax.plots")
        if name == "__version__":
            return metadata.version("vijax")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "Branch",
    "Design",
    "Harvester",
    "HuntCrossley",
    "Impact",
    "ImpactPair",
    "Optimum",
    "Orbit",
    "State",
    "Status",
    "Steady",
    "Surroundings",
    "Tolerance",
    "Trajectory",
    "basin_fractions",
    "basins",
    "branch_dataset",
    "cheapest_model",
    "compare",
    "find_orbits",
    "follow_families",
    "follow_orbits",
    "harvested_energy",
    "impact_pair",
    "load",
    "lyapunov",
    "optimise",
    "orbit_diagram",
    "orbit_impacts",
    "orbit_labels",
    "orbit_path",
    "orbit_power",
    "orbits_from_states",
    "plots",
    "rigid_from",
    "save",
    "steady",
    "surroundings",
    "survival",
    "sweep",
    "trajectory",
    "under_tolerances",
    "weigh_basins",
]
