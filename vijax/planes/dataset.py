"""The map that a sweep returns: its variables (`outputs`), coordinates, and the record of how it was made."""

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

from vijax.batch import simulate
from vijax.engine.method import Method
from vijax.engine.method_choice import record
from vijax.model.device import CONSTANTS, Harvester
from vijax.model.quantities import AXES
from vijax.model.records import Status
from vijax.model.sides import Sides, named
from vijax.planes.cells import Cells
from vijax.planes.expected import NEEDS, ManyStarts
from vijax.planes.outputs import VARIED, Found, Output, flagged, needs, table
from vijax.planes.sweep_settings import SweepSettings
from vijax.runtime import tiles
from vijax.runtime.pages import see

if TYPE_CHECKING:
    import xarray as xr

# Made here because making it loads JAX, which the room of the settings must not.
DEFAULT = SweepSettings()


@dataclass(frozen=True)
class SweepPlan:
    """A sweep that has passed the door.

    Attributes:
        cells: What is simulated.
        settings: How.
        method: The method of the settings, with what it is told; None for the exact one.
        outputs: Variables of the map.
        device: Constants that no axis gives.
        refine: Levels of refinement, 0 where every cell is computed.
        starts: How many starts every cell has, spread as those of `basin_fractions`; 1 is that of its axes u0 and v0.
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
        """Count the cells that are simulated, from one start or from many."""
        return self.cells.count

    @property
    def mirrored(self) -> bool:
        """Say whether the mirror image of a motion is one too, wherever the pair does not say otherwise."""
        excitation, law = self.settings.excitation, None if self.method is None else self.method.law
        forced_alike = excitation is None or excitation.mirrored
        return self.device.alike and forced_alike and not isinstance(law, Sides)

    @property
    def table(self) -> dict[str, Output]:
        """Give the outputs among which those of the map are."""
        return table(self.starts)

    @property
    def size(self) -> int:
        """Count the bytes of the variables wanted, at eight a number; a store compresses them."""
        of = self.cells
        variants = math.prod(of.sizes[dim] for dim in of.variant)
        varied = sum(bool(VARIED & set(self.table[name].needs)) for name in self.outputs)
        return 8 * self.count * (varied * variants + len(self.outputs) - varied)

    @property
    def needs(self) -> frozenset[str]:
        """Name the fields that the outputs are made of: of `Summary`, or of `expected.ManyStarts`."""
        return frozenset(need for name in self.outputs for need in needs(self.table[name], self.device))

    def cut(self, block: Mapping[str, slice]) -> "SweepPlan":
        """Plan a block of the cells alone."""
        return replace(self, cells=self.cells.cut(block))


def label(planned: SweepPlan, fields_found: dict[str, np.ndarray]) -> "xr.Dataset":
    """Make the map of the fields of `Summary`, each [cells] or [cells, variants] in the flat order of the plan."""
    import xarray as xr  # here, as importing vijax must not load it

    return xr.Dataset(variables(planned, fields_found), coords=coordinates(planned.cells), attrs=provenance(planned))


def variables(planned: SweepPlan, fields_found: dict[str, np.ndarray]) -> "dict[str, xr.Variable]":
    """Make the variables of `label`, without what is the same for every tile of a plane."""
    import xarray as xr

    of = planned.cells
    found = {}
    for name, values in fields_found.items():
        dims = of.dynamic + (of.variant if values.ndim > 1 else ())
        found[name] = xr.Variable(dims, values.reshape([of.sizes[dim] for dim in dims]))
    return {name: _variable(name, found, planned) for name in planned.outputs}


def specimen(planned: SweepPlan) -> "xr.Dataset":
    """Make the map of the first cell alone, its numbers void: what kind of variables there will be."""
    first = planned.cut({dim: slice(1) for dim in planned.cells.dynamic})
    variants = math.prod(planned.cells.sizes[dim] for dim in planned.cells.variant)
    blank = simulate.blank(1, variants, planned.settings.dtype)
    if planned.starts == 1:
        return label(first, {name: np.asarray(getattr(blank, name)) for name in planned.needs})
    one = ManyStarts(np.array([True]))
    one.add({name: np.asarray(getattr(blank, name)) for name in NEEDS | (planned.needs & simulate.DEEP)})
    return label(first, one.fields())


def best(dataset: "xr.Dataset") -> "xr.DataArray | None":
    """Find the largest admissible P with the coordinates of its cell; None if no cell yields any."""
    power = dataset["P"].where(dataset["admissible"]).fillna(0.0)
    peak = power.isel({dim: int(i) for dim, i in power.argmax(...).items()})
    return peak if peak > 0 else None


def warn_if_held(dataset: "xr.Dataset") -> None:
    """Warn where gravity along the axis keeps the ball on a wall in every cell: then there is nothing to see."""
    status, gamma = dataset["status"], dataset["gamma"]
    # The first cell is read alone, as a store may be larger than memory.
    if status.isel(dict.fromkeys(status.dims, 0)) != Status.PERMANENT_CONTACT or not gamma.all():
        return
    if (status == Status.PERMANENT_CONTACT).all():
        span = " to ".join(f"{x:.4g}" for x in np.unique([gamma.min(), gamma.max()]))
        advice = "from 1 on it outweighs the forcing; raise A or lower beta"
        warnings.warn(
            see("status", f"gravity holds the ball: gamma = {span}, permanent contact everywhere; {advice}"),
            stacklevel=2,
        )


def _variable(name: str, found: Found, planned: SweepPlan) -> "xr.Variable":
    output = planned.table[name]
    values = output.formula(found, planned.cells, planned.device) if output.formula else found[output.needs[0]]
    values = values.transpose(*(dim for dim in planned.cells.sizes if dim in values.dims))
    # Scales are float64 whatever the cells were computed in.
    values = values.astype(planned.settings.dtype if values.dtype.kind == "f" else values.dtype, copy=False)
    values.attrs = {"units": output.units, "long_name": output.description}
    return flagged(values, output.flags) if output.flags else values


def coordinates(of: Cells) -> "dict[str, xr.Variable]":
    """Give the axes as given and the quantities of the cells, with symbols and units."""
    found = {}
    for name, values in {**of.given, **of.quantities}.items():
        found[name] = values.transpose(*(dim for dim in of.sizes if dim in values.dims))
        found[name].attrs = AXES[name].attributes
    return found | of.labels


def provenance(planned: SweepPlan, **further: Any) -> dict[str, Any]:
    """Tell how a map was made: versions, commit, machine, `further` facts, and all that was asked."""
    return {
        "title": "Energy harvested by a vibro-impact pair",
        "Conventions": "CF-1.11",
        **made_by(),
        **further,
        **asked(planned),
    }


@cache
def made_by() -> dict[str, str]:
    """Tell what computes here: versions, commit, machine."""
    places = tiles.places()
    return {
        "source": f"vijax {_version('vijax')}",
        "commit": _commit(),
        **{f"version_{name}": _version(name) for name in ("jax", "jaxlib", "equinox", "numpy", "xarray", "zarr")},
        "version_python": platform.python_version(),
        "device": f"{len(set(places))} {places[0].device_kind} ({places[0].platform}), {platform.machine()}, "
        f"{os.cpu_count()} cores",
    }


def asked(planned: SweepPlan) -> dict[str, Any]:
    """Tell what a map holds besides its coordinates: settings, outputs, constants, tolerances."""
    # The constants that axes stand for are coordinates.
    constants = [name for name in CONSTANTS if name not in AXES]
    limit = float(planned.device.energy_ratio_limit)
    return {
        **planned.settings.told,
        **record(planned.method, planned.settings.excitation),
        "outputs": " ".join(planned.outputs),
        **({} if planned.starts == 1 else {"starts": planned.starts}),
        **{
            f"harvester_{argument}": float(value)
            for name in constants
            for argument, value in named(name, getattr(planned.device, name)).items()
        },
        **{
            f"harvester_{argument}": float(value)
            for argument, value in named("penetration_limit", planned.device.depth_limit).items()
        },
        # Stores of earlier versions have no such limit, and go on.
        **({} if limit == 1 else {"harvester_energy_ratio_limit": limit}),
        **{f"tolerance_{name}": value for name, value in simulate.tolerances(planned.settings.dtype).items()},
    }


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def _commit() -> str:
    """Find the commit of the source that runs, with -dirty if changed; "unknown" outside its own repository."""
    git = ["git", "-C", str(Path(__file__).parent)]
    options: dict[str, Any] = {"capture_output": True, "text": True, "check": True}
    try:
        # An installed copy may lie inside some other repository, whose commit would say nothing.
        subprocess.run([*git, "ls-files", "--error-unmatch", Path(__file__).name], **options)
        described = subprocess.run([*git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"], **options)
        return described.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
