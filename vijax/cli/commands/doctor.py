"""`vijax doctor`: prints versions, machine and settings, and tests vijax against values known to 50 digits."""

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
_REGISTERS = {"avx512f": "512 bits", "avx2": "256 bits", "asimd": "128 bits", "sse2": "128 bits"}  # widest first
_SETTINGS = "XLA_FLAGS", "JAX_", "VIJAX_"  # prefixes of environment variables that change how vijax runs


class _Check(NamedTuple):
    """A quantity with a known value.

    Attributes:
        name: Name of the quantity.
        expected: Its value, from 50-digit arithmetic.
        computed: Its value on this machine.
        bound: Largest acceptable relative error.
    """

    name: str
    expected: float
    computed: float
    bound: float

    @property
    def error(self) -> float:
        """Return the relative error."""
        return abs(self.computed / self.expected - 1)

    @property
    def right(self) -> bool:
        """Return True if the relative error is within the bound, False if the error is NaN."""
        return self.error <= self.bound


def run_self_test() -> None:
    """Show versions and settings, and check known numbers.

    The exit code is 1 if one of them is wrong.
    """
    for name, value in (*_machine(), *_programs()):
        click.echo(f"{name:<14}{value}")
    start = time.perf_counter()
    checks = _checks()
    for check in checks:
        outcome = "right" if check.right else "WRONG"
        click.echo(
            f"{outcome:<14}{check.name}: {check.computed:.15g}, relative error {check.error:.1e}, "
            f"at most {check.bound:.0e}"
        )
    click.echo(f"{'self-test':<14}{time.perf_counter() - start:.1f} s")
    if not all(check.right for check in checks):
        click.echo("vijax computes wrong numbers here: report these lines; VIJAX_KERNELS=0 may help", err=True)
        raise click.exceptions.Exit(1)


def _machine() -> Iterator[tuple[str, str]]:
    """Yield names and values of versions, processor and settings."""
    from vijax.runtime import validation

    yield "packages", ", ".join(f"{name} {_version(name)}" for name in _PACKAGES)
    yield "python", f"{platform.python_version()} on {platform.platform()}"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield "processor", f"{_processor()}, {cores} cores, {validation.gigabytes(validation.memory())} of memory"
    settings = {name: value for name, value in sorted(os.environ.items()) if name.startswith(_SETTINGS)}
    yield "settings", " ".join(f"{name}={value}" for name, value in settings.items()) or "none in the environment"


def _version(package: str) -> str:
    """Return the version of an installed package, or "is not installed"."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "is not installed"


def _processor() -> str:
    """Return the model of the processor and the width of its registers, as far as the system reports them."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    about = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    flags = about.get("flags", about.get("Features", "")).split()
    width = next((width for flag, width in _REGISTERS.items() if flag in flags), "of unknown width")
    return f"{about.get('model name', platform.machine())}, registers {width}"


def _programs() -> Iterator[tuple[str, str]]:
    """Yield (name, value) for JAX's devices, for the folder of kept compiled programs, and for the use of kernels."""
    import jax

    from vijax.runtime.compilation import cache_folder

    yield "devices", ", ".join(f"{device.platform}:{device.id} {device.device_kind}" for device in jax.devices())
    cache_folder.keep_programs()
    folder = cache_folder.program_folder()
    if folder is None:
        yield "kept programs", "none: turned off by a setting of JAX, or the folder is not trusted"
    else:
        number, size = cache_folder.content(folder)
        most = cache_folder.MOST_BYTES
        yield "kept programs", f"{number} files of {size / 1e6:,.0f} MB, at most {most / 1e6:,.0f} MB, in {folder}"
    yield "kernels", _kernels()


def _kernels() -> str:
    """Return "on" if vijax compiles parts of its programs to single kernels here, else "off" with the reason."""
    from vijax.runtime.compilation import xla

    if not xla.KERNELS:
        return "off: VIJAX_KERNELS is 0"
    if xla.platform() not in ("cpu", "gpu"):
        return f"off: none for {xla.platform()}"
    failure = xla.kernel_failure() if xla.on_cpu() else ""
    return f"off, planes take longer: {failure}" if failure else "on"


def _checks() -> list[_Check]:
    """Compute quantities that are known from 50-digit arithmetic.

    Every quantity has a compiled program. Most of the time is spent on reading the programs, so three threads read them
    in parallel. P is computed without `sweep`, because `sweep` imports xarray.
    """
    import jax.numpy as jnp
    import numpy as np

    from vijax.model.device import Harvester
    from vijax.model.pair import ImpactPair, impact_pair
    from vijax.model.quantities import START
    from vijax.runtime import public_api
    from vijax.simulation import simulate
    from vijax.simulation.trajectory import trajectory

    def time_of_impact(d: float, kappa: float | None) -> float:
        impacts = trajectory(impact_pair(d, kappa, 0.5), 0.02, 0.3, 9).impacts
        return float(2 * np.asarray(impacts.n)[15] + np.asarray(impacts.t)[15])

    def power() -> float:
        device, unit = Harvester(), jnp.ones(1)
        scale = simulate.Scale(device.length_unit * unit, device.speed_unit * unit, unit, unit)
        pair = ImpactPair(0.2 * unit, 12.65 * unit, 0.5 * unit, 0.0 * unit)
        return float(np.asarray(simulate.summarise(pair, START[0] * unit, START[1] * unit, scale, device).P)[0, 0])

    with public_api.pool(3) as threads:
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
    run_self_test,
    {"Options": []},
    examples=[""],
    epilog="Send these lines with a report of an error.",
)
