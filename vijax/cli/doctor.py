"""`vijax doctor`: what vijax runs on, and whether numbers that are known to many digits come out right."""

import os
import platform
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import click

from vijax.cli.page import Page

_PACKAGES = (
    "vijax",
    "jax",
    "jaxlib",
    "diffrax",
    "equinox",
    "optax",
    "numpy",
    "zarr",
    "numcodecs",
    "xarray",
    "matplotlib",
)
_REGISTERS = {"avx512f": "512 bits", "avx2": "256 bits", "asimd": "128 bits", "sse2": "128 bits"}  # the widest first
_SETTINGS = "XLA_FLAGS", "JAX_", "VIJAX_"  # what variables of the environment begin with that change how vijax runs


class _Check(NamedTuple):
    """A quantity whose value is known.

    Attributes:
        what: The quantity.
        known: Its value, from 50-digit arithmetic.
        found: Its value here.
        bound: The largest relative error that is right.
    """

    what: str
    known: float
    found: float
    bound: float

    @property
    def error(self) -> float:
        """Return the relative error."""
        return abs(self.found / self.known - 1)

    @property
    def right(self) -> bool:
        """Return whether the error is within the bound; NaN is not."""
        return self.error <= self.bound


def checked() -> None:
    """Show what vijax runs on, and check known numbers.

    The exit code is 1 if one of them is wrong.
    """
    for name, value in (*_machine(), *_programs()):
        click.echo(f"{name:<14}{value}")
    begun = time.perf_counter()
    checks = _checks()
    for one in checks:
        verdict = "right" if one.right else "WRONG"
        click.echo(
            f"{verdict:<14}{one.what}: {one.found:.15g}, relative error {one.error:.1e}, at most {one.bound:.0e}"
        )
    click.echo(f"{'self-test':<14}{time.perf_counter() - begun:.1f} s")
    if not all(one.right for one in checks):
        click.echo("vijax computes wrong numbers here: report these lines; VIJAX_KERNELS=0 may help", err=True)
        raise click.exceptions.Exit(1)


def _machine() -> Iterator[tuple[str, str]]:
    """Yield names and values of the versions, the processor and the settings."""
    from vijax.runtime import checks

    yield "packages", ", ".join(f"{name} {_version(name)}" for name in _PACKAGES)
    yield "python", f"{platform.python_version()} on {platform.platform()}"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield "processor", f"{_processor()}, {cores} cores, {checks.gigabytes(checks.memory())} of memory"
    given = {name: value for name, value in sorted(os.environ.items()) if name.startswith(_SETTINGS)}
    yield "settings", " ".join(f"{name}={value}" for name, value in given.items()) or "none in the environment"


def _version(package: str) -> str:
    """Return the version of an installed package, or that there is none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "is not installed"


def _processor() -> str:
    """Return the model of the processor and the width of its registers, as far as the system says."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    about = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    flags = about.get("flags", about.get("Features", "")).split()
    width = next((width for flag, width in _REGISTERS.items() if flag in flags), "of unknown width")
    return f"{about.get('model name', platform.machine())}, registers {width}"


def _programs() -> Iterator[tuple[str, str]]:
    """Yield names and values of the devices, the folder of kept programs, and whether kernels are on and why."""
    import jax

    from vijax.runtime import cache_folder

    yield "devices", ", ".join(f"{one.platform}:{one.id} {one.device_kind}" for one in jax.devices())
    cache_folder.keep_programs()
    folder = cache_folder.kept()
    if folder is None:
        yield "kept programs", "none: turned off by a setting of JAX, or the folder is not trusted"
    else:
        number, size = cache_folder.content(folder)
        most = cache_folder.MOST_BYTES
        yield "kept programs", f"{number} files of {size / 1e6:,.0f} MB, at most {most / 1e6:,.0f} MB, in {folder}"
    yield "kernels", _kernels()


def _kernels() -> str:
    """Return whether kernels are on, and why not if they are off."""
    from vijax.runtime import xla

    if not xla.KERNELS:
        return "off: VIJAX_KERNELS is 0"
    if xla.platform() not in ("cpu", "gpu"):
        return f"off: none for {xla.platform()}"
    failure = xla.kernel_failure() if xla.on_cpu() else ""
    return f"off, planes take longer: {failure}" if failure else "on"


def _checks() -> list[_Check]:
    """Compute quantities that are known from 50-digit arithmetic.

    Most of the time goes into reading kept programs, one for each quantity: threads read them side by side. The cell
    is computed without `sweep`, which loads xarray.
    """
    import jax.numpy as jnp
    import numpy as np

    from vijax.batch import simulate
    from vijax.batch.trajectory import trajectory
    from vijax.model.device import Harvester
    from vijax.model.pair import ImpactPair, impact_pair
    from vijax.model.quantities import START
    from vijax.runtime import context

    def time_of_impact(d: float, kappa: float | None) -> float:
        impacts = trajectory(impact_pair(d, kappa, 0.5), 0.02, 0.3, 9).impacts
        return float(2 * np.asarray(impacts.n)[15] + np.asarray(impacts.t)[15])

    def power() -> float:
        device, one = Harvester(), jnp.ones(1)
        scale = simulate.Scale(device.length_unit * one, device.speed_unit * one, one, one)
        pair = ImpactPair(0.2 * one, 12.65 * one, 0.5 * one, 0.0 * one)
        return float(np.asarray(simulate.summarise(pair, START[0] * one, START[1] * one, scale, device).P)[0, 0])

    with context.pool(3) as threads:
        cell = threads.submit(power)
        soft, rigid = threads.submit(time_of_impact, 0.2, 4.0), threads.submit(time_of_impact, 0.12, None)
    return [
        _Check("time of the 16th impact at soft walls", 15.18805892317775144521, soft.result(), 1e-11),
        _Check("time of the 16th impact at rigid walls", 12.32561093526565372993, rigid.result(), 1e-11),
        _Check("P of a periodic cell [J]", 0.00411184436875454804, cell.result(), 1e-11),
    ]


# --- the page --------------------------------------------------------------------------------------------------------

doctor = Page(
    "doctor",
    checked,
    {"Options": []},
    examples=[""],
    epilog="Send these lines with a report of an error.",
)
