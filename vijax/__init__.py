"""Power maps of vibro-impact energy harvesters with soft and hard walls, by an exact event-driven engine in JAX.

Importing vijax switches JAX to 64 bits, before any array is made: impact times need double precision. All public names
are listed here; their docstrings describe arguments and results.

Devices and pairs: a `Harvester` (SI units) gives an `ImpactPair` (nondimensional), as `impact_pair` does from numbers;
`Sides` holds values that differ between the two walls. `HuntCrossley` and `Hyperelastic` are other membranes,
`MembraneLaw` defines a custom one; `harvested_energy` is the energy of one impact. An `Excitation` replaces the sine:
`Harmonics`, a measured `Record`, a `Waveform`, `Noise`, or a sum of them. `State`, `Impact` and `Status` are the types
of recorded motion.

Parameter planes, as `xarray.Dataset`: `sweep` maps power, kind of motion and the conditions under which the power is
valid; `compare` maps the error of the rigid-wall model, which `cheapest_model` and `rigid_from` summarise; `basins` and
`basin_fractions` determine the coexisting attractors; `orbit_diagram` follows attractors along an axis; `lyapunov` and
`survival` measure chaos and its duration; `response` measures a device under noise. `save` and `load` keep datasets in
stores.

Device identification from impacts: `fit` makes a `Fit` of times measured on a test bench, with errors, its `Misfit`,
and a `ConstancyTest` of the restitution.

Single motions: `trajectory` returns a `Trajectory`, impact by impact, differentiable.

Periodic orbits, stable or not: `find_orbits` computes them from a sequence of impacts, `orbits_from_states` from
states. An `Orbit` has Floquet `multipliers`; `orbit_impacts`, `orbit_labels`, `orbit_power` and `orbit_path` compute
its properties. `follow_orbits` computes the `Branch` of each along a parameter, `follow_families` also the branches
that start on it, `branch_dataset` both as a dataset; `ContinuationSettings` control the steps. `follow_curves`
continues the bifurcations of branches in a plane of two parameters, each as a `BifurcationCurve`. `bifurcation_curves`
computes the curves that explain a map, as `MapCurves`, and `curves_about` the curves that bound an orbit;
`limit_points` starts curves of the limits of a device. `curve_dataset` makes a dataset of curves, `curve_rows` a table.

Design: `steady` is the steady state of an orbit, a `Steady` with derivatives. `average` is the average of any motion,
chaos included, an `Average` with derivatives, their errors and their `Smoothness`. `optimise` computes the `Design` of
greatest power, an `Optimum` on an orbit or an `AperiodicOptimum` in chaos. `tolerance_statistics` computes its power
when constants scatter by a `Tolerance`, `surroundings` its neighbourhood (`Surroundings`), `tolerance_plane` its limits
when two constants deviate (`TolerancePlane`), `parameter_ranges` the permitted deviations, `arrival_statistics` the
starts that reach it; `maximise_basin_power` maximises power times basin share. `DesignSettings` control the starts and
the steps of the ascents.

Browser: `explore` shows a map, cell by cell.

Pictures: `plots`; matplotlib is imported at its first use.
"""

import os
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from vijax.runtime import fork_safety  # noqa: F401, imported to register its fork handlers

if TYPE_CHECKING:
    from vijax.public import *  # noqa: F403

    __version__: str
else:
    # The command `vijax` imports this package before it answers --help or a shell completion. With JAX that would take
    # ten times as long, so each public name is imported at its first use.
    def __getattr__(name):
        if name == "__version__":
            from importlib import metadata

            return metadata.version("vijax")
        if name == "__all__":
            return __dir__()
        if name.startswith("__") or name not in _locations():
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from vijax.runtime.lazy_imports import load

        value = load(_locations()[name])
        if "jax" in sys.modules:
            _restore_environment()
        return value

    def __dir__():
        return sorted(_locations())

    @cache
    def _locations():
        from vijax.runtime.lazy_imports import name_locations

        return name_locations(__name__, Path(__file__).with_name("public.py"))


_X64 = "JAX_ENABLE_X64"
_ORIGINAL_X64 = os.environ.get(_X64)


def _restore_environment() -> None:
    """Restore JAX_ENABLE_X64 in the environment once JAX has read it, because child processes inherit it."""
    if _ORIGINAL_X64 is None:
        os.environ.pop(_X64, None)
    else:
        os.environ[_X64] = _ORIGINAL_X64


if "jax" in sys.modules:
    import jax

    jax.config.update("jax_enable_x64", True)
else:
    os.environ[_X64] = "true"  # read when JAX is imported, by any module
