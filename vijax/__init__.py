"""Power maps of vibro-impact energy harvesters with soft and hard walls, by an exact event-driven engine in JAX.

Importing vijax switches JAX to 64 bits, before any array is made: impact times are worth little at less. All that a
user needs stands here; what each function takes and returns its docstring says.

Devices and pairs: `Harvester` (SI units) gives an `ImpactPair` (nondimensional), as `impact_pair` does from numbers;
`Sides` holds what two walls that differ have;
`HuntCrossley` and `Hyperelastic` are other membranes, `MembraneLaw` makes one of your own; `harvested_energy` is the
energy of one impact.
An `Excitation` takes the place of the sine: `Harmonics`, a measured `Record`, a `Waveform`, `Noise`, or a sum of them.
`State`, `Impact` and `Status` are what records are made of.

Planes of parameters, as `xarray.Dataset`: `sweep` maps power, kind of motion and all that tells whether to believe it;
`compare` maps what a rigid wall gets wrong, of which `cheapest_model` and `rigid_from` make a verdict; `basins` and
`basin_fractions` say which attractors coexist; `orbit_diagram` follows attractors along an axis; `lyapunov` and
`survival` say how chaotic, and for how long; `response` measures a device under noise. `save` and `load` keep them in
stores.

A device from its impacts: `fit` makes a `Fit` of times that a bench has measured, with errors, its `Misfit`, and a
`ConstancyTest` of restitution.

One motion: `trajectory` returns a `Trajectory`, impact by impact, differentiable.

Periodic orbits, stable or not: `find_orbits` from a sequence of impacts, `orbits_from_states` from states; an `Orbit`
has its Floquet `multipliers`, and `orbit_impacts`, `orbit_labels`, `orbit_power` and `orbit_path` tell more.
`follow_orbits` gives the `Branch` of each along a parameter, `follow_families` also those that begin on it,
`branch_dataset` both as a dataset; `ContinuationSettings` decide the steps. `follow_curves` follows what branches met
in a plane of two parameters, each a `BifurcationCurve`; `bifurcation_curves` finds those that explain a map, as
`MapCurves`, and `curves_about` those that bound an orbit; from `limit_points` on limits of a device are followed too;
`curve_dataset` makes a dataset of them, `curve_rows` a table.

The best device: `steady` is the steady state of an orbit, a `Steady` with derivatives; `average` is that of any motion,
chaos too, an `Average` with derivatives, their errors and their `Smoothness`; `optimise` finds the `Design` that
harvests most, an `Optimum` on an orbit or an `AperiodicOptimum` in chaos; `under_tolerances` says what becomes of it
when constants scatter as a `Tolerance` says, `surroundings` what lies around it (`Surroundings`), `design_plane` what
bounds it where two constants are off (`TolerancePlane`), `design_extents` how far off it may be, `design_arrival` how
balls arrive at it, `weigh_basins` which is best if its basin counts; `DesignSettings` decide where ascents begin and
how they climb.

A page in the browser: `explore` looks into a map, cell by cell.

Pictures: `plots`, which is loaded, and matplotlib with it, when it is first asked for.
"""

import os
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from vijax.runtime import forks  # noqa: F401, which watches them from now on

if TYPE_CHECKING:
    from vijax.public import *  # noqa: F403

    __version__: str
else:
    # The command `vijax` has to import this package before it can answer --help, or a shell that completes. With JAX
    # that would take ten times as long, so of what is offered each name is loaded when it is first asked for.
    def __getattr__(name):
        if name == "__version__":
            from importlib import metadata

            return metadata.version("vijax")
        if name == "__all__":
            return __dir__()
        if name.startswith("__") or name not in _homes():
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from vijax.runtime.offered import load

        found = load(_homes()[name])
        if "jax" in sys.modules:
            _said_of_bits()
        return found

    def __dir__():
        return sorted(_homes())

    @cache
    def _homes():
        from vijax.runtime.offered import homes

        return homes(__name__, Path(__file__).with_name("public.py"))


_X64 = "JAX_ENABLE_X64"
_SAID = os.environ.get(_X64)


def _said_of_bits() -> None:
    """Leave the environment, which child processes inherit, as it was found: JAX has read it."""
    if _SAID is None:
        os.environ.pop(_X64, None)
    else:
        os.environ[_X64] = _SAID


if "jax" in sys.modules:
    import jax

    jax.config.update("jax_enable_x64", True)
else:
    os.environ[_X64] = "true"  # read as JAX is imported, by whomever
