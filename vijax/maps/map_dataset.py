"""The map that a sweep returns: variables (`outputs`), coordinates, and the attributes that record its provenance."""

import math
import os
import platform
import subprocess
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vijax.impact.method import Method
from vijax.impact.method_choice import method_attributes
from vijax.maps.cells import Cells
from vijax.maps.outputs import VARIED, FieldVariables, Output, available_outputs, flagged, needs
from vijax.maps.start_statistics import SUMMARY_FIELDS, StartStatistics
from vijax.maps.sweep_settings import SweepSettings
from vijax.model.device import CONSTANTS, Harvester
from vijax.model.quantities import AXES
from vijax.model.records import Status
from vijax.model.walls.sides import Sides, values_by_name
from vijax.runtime import tiles
from vijax.runtime.doc_pages import see
from vijax.simulation import simulate

if TYPE_CHECKING:
    import xarray as xr

# Created here because creating a `SweepSettings` imports JAX, and importing the module `sweep_settings` must not.
DEFAULT = SweepSettings()


@dataclass(frozen=True)
class SweepPlan:
    """A validated sweep.

    Attributes:
        cells: Cells to simulate.
        settings: How the cells are simulated.
        method: Integration method of the settings, with its options; None for the exact engine.
        outputs: Names of the variables of the map.
        device: Device that supplies the constants without an axis.
        refine: Levels of refinement, 0 if every cell is computed.
        starts: Number of starts of every cell, spread as in `basin_fractions`. If it is 1, the axes u0 and v0 specify
            the start.
    """

    cells: Cells
    settings: SweepSettings
    method: Method | None
    outputs: tuple[str, ...]
    device: Harvester
    refine: int = 0
    starts: int = 1

    @property
    def count(self) -> int:
        """Number of cells to simulate, each from one start or from many."""
        return self.cells.count

    @property
    def mirrored(self) -> bool:
        """Whether device, excitation and membranes permit that the mirror image of a motion is a motion too.

        In a cell, the mirror image is a motion if its impact pair is symmetric as well: gamma is 0 and both walls are
        alike.
        """
        excitation, law = self.settings.excitation, None if self.method is None else self.method.law
        # The forcing changes sign under a shift by half a period, unless the excitation has even harmonics or noise.
        forced_alike = excitation is None or excitation.has_half_wave_symmetry
        return self.device.has_equal_membranes and forced_alike and not isinstance(law, Sides)

    @property
    def available_outputs(self) -> dict[str, Output]:
        """Outputs that a map with this number of starts can have, by name."""
        return available_outputs(self.starts)

    @property
    def size(self) -> int:
        """Bytes of the variables of the map, at eight per number; a store compresses them."""
        cells = self.cells
        variants = math.prod(cells.sizes[dim] for dim in cells.variant)
        # An output from a field with variants has a number per cell and variant, any other output a number per cell.
        with_variants = sum(bool(VARIED & set(self.available_outputs[name].needs)) for name in self.outputs)
        return 8 * self.count * (with_variants * variants + len(self.outputs) - with_variants)

    @property
    def needs(self) -> frozenset[str]:
        """Names of the fields of `Summary`, or of `StartStatistics` with several starts, that the outputs require."""
        return frozenset(need for name in self.outputs for need in needs(self.available_outputs[name], self.device))

    def cut(self, block: Mapping[str, slice]) -> "SweepPlan":
        """Return the plan of a block of the cells; `block` maps dimensions to slices."""
        return replace(self, cells=self.cells.cut(block))


def make_map(plan: SweepPlan, fields: dict[str, np.ndarray]) -> "xr.Dataset":
    """Return the map made of fields of `Summary`, each [cells] or [cells, variants] in the flat order of the plan."""
    import xarray as xr  # here, as importing vijax must not load it

    return xr.Dataset(variables(plan, fields), coords=coordinates(plan.cells), attrs=provenance(plan))


def variables(plan: SweepPlan, fields: dict[str, np.ndarray]) -> "dict[str, xr.Variable]":
    """Return the variables of `make_map` alone; coordinates and attributes are the same for every tile of a plane."""
    import xarray as xr

    cells = plan.cells
    field_variables = {}
    for name, values in fields.items():
        # Fields are in the flat order of the plan: dynamic dimensions first, then one axis of all variants.
        dims = cells.dynamic + (cells.variant if values.ndim > 1 else ())
        field_variables[name] = xr.Variable(dims, values.reshape([cells.sizes[dim] for dim in dims]))
    return {name: _variable(name, field_variables, plan) for name in plan.outputs}


def blank_map(plan: SweepPlan) -> "xr.Dataset":
    """Return a map of the first cell with blank numbers and the variables, dtypes and attributes of the full map."""
    # One cell, but all variants, so that the variables have the same dimensions as in the full map.
    first = plan.cut({dim: slice(1) for dim in plan.cells.dynamic})
    variants = math.prod(plan.cells.sizes[dim] for dim in plan.cells.variant)
    blank = simulate.blank(1, variants, plan.settings.dtype)
    if plan.starts == 1:
        return make_map(first, {name: np.asarray(getattr(blank, name)) for name in plan.needs})
    statistics = StartStatistics(np.array([True]))
    # One blank start yields all fields with their dtypes.
    statistics.add({name: np.asarray(getattr(blank, name)) for name in SUMMARY_FIELDS | (plan.needs & simulate.DEEP)})
    return make_map(first, statistics.fields())


def best(dataset: "xr.Dataset") -> "xr.DataArray | None":
    """Return the largest admissible P with the coordinates of its cell; None if no admissible cell has P > 0."""
    # Failed and inadmissible cells count as 0, because argmax fails on an array of NaN alone.
    power = dataset["P"].where(dataset["admissible"]).fillna(0.0)
    peak = power.isel({dim: int(i) for dim, i in power.argmax(...).items()})
    return peak if peak > 0 else None


def warn_if_permanent_contact(dataset: "xr.Dataset") -> None:
    """Warn if gravity along the axis keeps the ball on a wall in every cell, so that no cell harvests energy."""
    status, gamma = dataset["status"], dataset["gamma"]
    # The first cell is tested alone before all cells are read, because a store may be larger than memory.
    if status.isel(dict.fromkeys(status.dims, 0)) != Status.PERMANENT_CONTACT or not gamma.all():
        return
    if (status == Status.PERMANENT_CONTACT).all():
        span = " to ".join(f"{x:.4g}" for x in np.unique([gamma.min(), gamma.max()]))
        advice = "from 1 on it outweighs the forcing; raise A or lower beta"
        warnings.warn(
            see("status", f"gravity keeps the ball in permanent contact everywhere: gamma = {span}; {advice}"),
            stacklevel=2,
        )


def _variable(name: str, fields: FieldVariables, plan: SweepPlan) -> "xr.Variable":
    """Return one output as a variable with its dimensions in the order of the plan, its dtype and its attributes."""
    output = plan.available_outputs[name]
    values = output.formula(fields, plan.cells, plan.device) if output.formula else fields[output.needs[0]]
    # Dimensions in the order of the axes as specified by the user; the formula returns dynamic dimensions first.
    values = values.transpose(*(dim for dim in plan.cells.sizes if dim in values.dims))
    # A formula may return float64 for cells computed in float32, because it multiplies by scales, which are float64.
    values = values.astype(plan.settings.dtype if values.dtype.kind == "f" else values.dtype, copy=False)
    values.attrs = {"units": output.units, "long_name": output.description}
    return flagged(values, output.flags) if output.flags else values


def coordinates(cells: Cells) -> "dict[str, xr.Variable]":
    """Return the axes as specified and the quantities of the cells, with symbols and units."""
    result = {}
    for name, values in {**cells.axes, **cells.quantities}.items():
        result[name] = values.transpose(*(dim for dim in cells.sizes if dim in values.dims))
        result[name].attrs = AXES[name].attributes
    return result | cells.labels


def provenance(plan: SweepPlan, **further: Any) -> dict[str, Any]:
    """Return attributes that record how a map was made: versions, commit, machine, `further` facts and all settings."""
    return {
        "title": "Energy harvested by a vibro-impact pair",
        "Conventions": "CF-1.11",
        **installation_attributes(),
        **further,
        **request_attributes(plan),
    }


@cache
def installation_attributes() -> dict[str, str]:
    """Return attributes that describe this installation: versions, commit, machine."""
    # Cached: every record of a tile needs these facts, and git and package metadata are slow to read.
    places = tiles.tile_devices()
    return {
        "source": f"vijax {_version('vijax')}",
        "commit": _commit(),
        **{f"version_{name}": _version(name) for name in ("jax", "jaxlib", "equinox", "numpy", "xarray", "zarr")},
        "version_python": platform.python_version(),
        "device": f"{len(set(places))} {places[0].device_kind} ({places[0].platform}), {platform.machine()}, "
        f"{os.cpu_count()} cores",
    }


def request_attributes(plan: SweepPlan) -> dict[str, Any]:
    """Return the attributes that, besides the coordinates, define the content of a map.

    These are settings, outputs, constants and tolerances. A run continues an existing store only if these attributes of
    its plan and of the store are equal.
    """
    # Constants that may be axes are stored as coordinates.
    constants = [name for name in CONSTANTS if name not in AXES]
    limit = float(plan.device.energy_ratio_limit)
    return {
        **plan.settings.dataset_attributes,
        **method_attributes(plan.method, plan.settings.excitation),
        "outputs": " ".join(plan.outputs),
        **({} if plan.starts == 1 else {"starts": plan.starts}),
        **{
            f"harvester_{argument}": float(value)
            for name in constants
            for argument, value in values_by_name(name, getattr(plan.device, name)).items()
        },
        **{
            f"harvester_{argument}": float(value)
            for argument, value in values_by_name("penetration_limit", plan.device.depth_limit).items()
        },
        # Omitted at the default limit, so that a run can continue stores of earlier versions, which lack this
        # attribute.
        **({} if limit == 1 else {"harvester_energy_ratio_limit": limit}),
        **{f"tolerance_{name}": value for name, value in simulate.tolerances(plan.settings.dtype).items()},
    }


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def _commit() -> str:
    """Return the commit of the running source, with -dirty if changed; "unknown" outside its own repository."""
    git = ["git", "-C", str(Path(__file__).parent)]
    options: dict[str, Any] = {"capture_output": True, "text": True, "check": True}
    try:
        # Fails if git does not track this file, for example for an installed copy within another repository. The commit
        # of that repository would be meaningless.
        subprocess.run([*git, "ls-files", "--error-unmatch", Path(__file__).name], **options)
        described = subprocess.run([*git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"], **options)
        return described.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
