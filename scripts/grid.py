"""A map of harvested energy from one command: a labelled store, a picture, a closing summary.

    python scripts/grid.py
    python scripts/grid.py --gamma 0.1 --out inclined.zarr --plot inclined.png
    python scripts/grid.py --omega pi:6pi:96 --omega0 20:400:96 --plot device.png
    python scripts/grid.py --kappa 3:4000:128:log --compare rigid --tolerance 0.05

An axis is a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE; arrays become dimensions in the order given: x, y and
panels of the picture. Write a range that begins with a minus as --u0=-0.1:0.1:9.
"""

import math
import os
import sys
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    import xarray as xr

    from vijax.compare import Comparison
    from vijax.dataset import Plan

_STARTED = time.perf_counter()
_DEFAULT_PLANE = {"d": "0.05:0.3:128", "kappa": "3:400:128:log"}
# One physical name among these, and the plane is the device's: what is not given is taken from Tables I and II.
_PHYSICAL = {"s", "omega0", "k"}
_METHOD_OPTIONS = ("method", "solver", "rtol", "atol", "steps", "membrane", "chi", "exponent")
_LONG = 9  # periods from here on are counted together
_DEFAULT_FILES = ("power_map.zarr", "power_map.png")
_COMPARISON_FILES = ("comparison.zarr", "comparison.png")
_AXES = {
    "d": "gap, dimensionless [0.05:0.3:128 unless --s, --omega0 or --k is given]",
    "kappa": "stiffness, dimensionless [3:400:128:log unless --s, --omega0 or --k is given]",
    "r": "coefficient of restitution [0.5]",
    "gamma": "gravity along the axis over forcing amplitude [0]",
    "omega": "frequency of the forcing, rad/s [pi]",
    "s": "gap, m [0.3]",
    "omega0": "natural frequency of ball and membrane, rad/s [400]",
    "k": "stiffness, N/m [560]",
    "A": "amplitude of the forcing, m/s^2 [1]",
    "beta": "inclination, rad [0]",
    "u0": "displacement at the start, dimensionless [min(0.05853, 0.49 d)]",
    "v0": "velocity at the start, dimensionless [-0.47898]",
}


def _options() -> list[click.Parameter]:
    axes = [click.Option([f"--{name}", name], metavar="VALUES", help=text) for name, text in _AXES.items()]
    return [
        *axes,
        click.Option(
            ["--set", "constants"], multiple=True, metavar="NAME=VALUE", help="any other constant of the device"
        ),
        click.Option(["--periods"], default=400, show_default=True, help="forcing periods to run, at most"),
        click.Option(["--until"], default="attractor", show_default=True, help="attractor or window"),
        click.Option(["--transient"], default=0, show_default=True, help="forcing periods to drop first"),
        click.Option(["--wall"], default="soft", show_default=True, help="soft or rigid"),
        click.Option(["--compare"], metavar="rigid", help="map what rigid walls change instead: P and the label"),
        click.Option(["--tolerance"], type=float, help="with --compare: part of P that they may change"),
        click.Option(["--method"], default="exact", show_default=True, help="exact, ode or rk4"),
        click.Option(["--solver"], help="of ode: Tsit5, Dopri5, Dopri8, Kvaerno5 ... [Tsit5]"),
        click.Option(["--rtol"], type=float, help="of ode: relative tolerance of a step [1e-8]"),
        click.Option(["--atol"], type=float, help="of ode: absolute tolerance of a step [1e-10]"),
        click.Option(["--steps"], type=int, help="of rk4: steps per forcing period [1000]"),
        click.Option(["--membrane"], help="of ode and rk4: linear or hunt-crossley [linear]"),
        click.Option(["--chi"], type=float, help="of hunt-crossley: damping over stiffness"),
        click.Option(["--exponent"], type=float, help="of hunt-crossley: exponent of the penetration [1.5]"),
        click.Option(["--dtype"], default="float64", show_default=True, help="float64 or float32"),
        click.Option(["--outputs"], metavar="NAME,NAME", help="variables wanted [all but lyapunov]"),
        click.Option(["--out"], metavar="FILE.zarr", help="store to write"),
        click.Option(["--plot"], metavar="FILE.png", help="picture to write"),
        click.Option(["--overwrite"], is_flag=True, help="replace what is there"),
    ]


@click.command(params=_options(), context_settings={"max_content_width": 120})
def power_map(
    constants: tuple[str, ...],
    outputs: str | None,
    compare: str | None,
    tolerance: float | None,
    overwrite: bool,
    **given: Any,
) -> None:
    """Map the energy harvested over a plane of parameters.

    VALUES are a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE (negative ranges as --u0=-0.1:0.1:9); a number may
    be a multiple of pi, as in 6pi. With neither --out nor --plot, power_map.zarr and power_map.png are written, or
    comparison.zarr and comparison.png.
    """
    try:
        defaults = _DEFAULT_FILES if compare is None else _COMPARISON_FILES
        out, plot = _targets(given.pop("out"), given.pop("plot"), defaults, overwrite)
        axes, device = _axes(given), _device(constants)
        if compare is None and tolerance is not None:
            raise ValueError(f"tolerance must come with compare; got {tolerance:g} alone; add --compare rigid")
        planned: Plan | Comparison
        if compare is None:
            planned = _plan(axes, device, outputs, given)
        else:
            planned = _comparison(axes, device, outputs, compare, tolerance, given)
        if plot is not None:
            _check_picture(plot, planned)
    except (ValueError, TypeError, OSError) as error:
        raise click.UsageError(str(error)) from None
    keep_compiled()
    began = time.perf_counter()
    dataset = _run(planned)
    seconds = time.perf_counter() - began
    if out is not None:
        from vijax.store import save

        save(dataset, out, overwrite=overwrite)
    if plot is not None:
        from vijax import plot as pictures

        (pictures.power_map if compare is None else pictures.difference_map)(dataset, plot)
    click.echo((_summary if compare is None else _comparison_summary)(dataset, planned.count, seconds))
    click.echo(f"wrote {', '.join(str(path) for path in (out, plot) if path)}")
    click.echo(f"{time.perf_counter() - _STARTED:.1f} s from start to end")


def keep_compiled() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX was told of another."""
    import jax

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(cache / "vijax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _targets(
    out: str | None, plot: str | None, defaults: tuple[str, str], overwrite: bool
) -> tuple[Path | None, Path | None]:
    from vijax.store import check_output

    if out is None and plot is None:
        out, plot = defaults
    if out is not None and not out.endswith(".zarr"):
        raise ValueError(f"out must end in .zarr; got {out!r}")
    return (
        None if out is None else check_output("out", out, overwrite),
        None if plot is None else check_output("plot", plot, overwrite),
    )


def _axes(given: dict[str, Any]) -> dict[str, Any]:
    """Values of the axes, taken out of what was given; the default plane where no physical name is among them."""
    from vijax.axes import parse_axis

    axes = {name: given.pop(name) for name in list(given) if name in _AXES}
    texts = {name: text for name, text in axes.items() if text is not None}
    # A plane of the default ranges comes first, so that what is given besides makes panels of it.
    if not _PHYSICAL & set(texts):
        texts = {name: text for name, text in _DEFAULT_PLANE.items() if name not in texts} | texts
    return {name: parse_axis(name, text) for name, text in texts.items()}


def _plan(axes: dict[str, Any], device: Any, outputs: str | None, settings: dict[str, Any]) -> "Plan":
    from vijax.grid import plan

    wanted = None if outputs is None else [name.strip() for name in outputs.split(",")]
    settings["membrane"] = _membrane(settings["membrane"], settings.pop("chi"), settings.pop("exponent"))
    return plan(axes, wanted, device, **settings)


def _comparison(
    axes: dict[str, Any],
    device: Any,
    outputs: str | None,
    other: str,
    tolerance: float | None,
    settings: dict[str, Any],
) -> "Comparison":
    from vijax.compare import plan

    if other != "rigid":
        raise ValueError(f'compare must be "rigid"; got {other!r}')
    if (wall := settings.pop("wall")) != "soft":
        raise ValueError(f"wall must not be chosen with compare, which runs soft and rigid ones; got {wall!r}")
    if outputs is not None:
        raise ValueError(f"outputs must not be chosen with compare; got {outputs!r}; leave them out")
    for name in _METHOD_OPTIONS:
        if (value := settings.pop(name)) not in (None, "exact"):
            raise ValueError(f"{name} must not be chosen with compare, which is exact; got {value!r}")
    return plan(axes, tolerance, device, **settings)


def _membrane(name: str | None, chi: float | None, exponent: float | None) -> Any:
    from vijax.membrane import HuntCrossley, Linear

    if name == "hunt-crossley":
        if chi is None:
            raise ValueError("chi must be given with --membrane hunt-crossley; got none")
        return HuntCrossley(chi) if exponent is None else HuntCrossley(chi, exponent)
    for option, value in (("chi", chi), ("exponent", exponent)):
        if value is not None:
            raise ValueError(f"{option} must be left out unless --membrane is hunt-crossley; got {value:g}")
    if name not in (None, "linear"):
        raise ValueError(f"membrane must be linear or hunt-crossley; got {name!r}")
    return None if name is None else Linear()


def _device(constants: tuple[str, ...]) -> Any:
    from vijax.model import Harvester, with_constants

    values = {}
    for text in constants:
        name, _, value = text.partition("=")
        if name in _AXES:
            raise ValueError(
                f"set must name a constant that has no option of its own; got {text!r}; give --{name}={value}"
            )
        try:
            values[name] = float(value)
        except ValueError:
            raise ValueError(f"set must be NAME=VALUE with a number; got {text!r}") from None
    return with_constants(Harvester(), **values)


def _check_picture(path: Path, planned: "Plan | Comparison") -> None:
    from vijax import plot as pictures
    from vijax.compare import Comparison

    pictures.check_format(path)
    if isinstance(planned, Comparison):
        pictures.layout(planned.soft.cells.sizes)
        return
    pictures.layout(planned.cells.sizes)
    missing = [name for name in pictures.NEEDS if name not in planned.outputs]
    if missing:
        raise ValueError(f"outputs must hold {', '.join(missing)} for a picture; add them, or give --out alone")


def _run(planned: "Plan | Comparison") -> "xr.Dataset":
    from tqdm import tqdm

    from vijax import grid
    from vijax.compare import Comparison, run

    with tqdm(total=planned.count, desc="compiling", unit="cells", unit_scale=True) as bar:

        def show(done: int, total: int) -> None:
            if done:
                bar.set_description("cells", refresh=False)
            bar.update(done - bar.n)

        return run(planned, show) if isinstance(planned, Comparison) else grid.run(planned, show)


def _summary(dataset: "xr.Dataset", count: int, seconds: float) -> str:
    """What the map holds, in a few lines: cells by status and by period, the best of them, the time."""
    from vijax.dataset import best

    lines = [_pace(count, seconds), f"cells by status: {_flags(dataset['status'])}"]
    if "period" in dataset:
        names = {-1: "undecided", 0: "aperiodic"} | {n: f"period {n}" for n in range(1, _LONG)}
        periods = sorted(dataset["period"].values.flat, key=lambda period: period if period > 0 else math.inf)
        lines.append(f"cells by period: {_tally(names.get(period, f'{_LONG} and more') for period in periods)}")
    if {"P", "admissible"} <= set(dataset):
        peak = best(dataset)
        lines.append(f"largest admissible P: {'none' if peak is None else _place(peak, dataset)}")
    return "\n".join(lines)


def _comparison_summary(dataset: "xr.Dataset", count: int, seconds: float) -> str:
    """What the comparison holds, in a few lines: how cells ended, labels, verdicts, from where rigid is enough."""
    lines = [_pace(count, seconds)]
    lines += [f"{wall} cells by status: {_flags(dataset[f'status_{wall}'])}" for wall in ("soft", "rigid")]
    lines.append(f"label: {_flags(dataset['label'])}")
    lines.append(f"median difference in P: {100 * float(dataset['relative_difference'].median()):.3g} %")
    if "cheapest_model" in dataset:
        verdict = dataset["cheapest_model"]
        within = f"{100 * verdict.attrs['tolerance']:g} %"
        lines.append(f"cheapest model within {within}: {_flags(verdict)}")
    if "rigid_from" in dataset:
        onset = dataset["rigid_from"]
        found = onset.values[onset.notnull().values]
        span = f"{found.min():.4g} to {found.max():.4g}, median {onset.median():.4g}" if found.size else "none"
        lines.append(f"least {onset.axis} from which on it is rigid: {span} ({found.size} of {onset.size} found)")
    return "\n".join(lines)


def _pace(count: int, seconds: float) -> str:
    return f"{count:,} cells in {seconds:.2f} s, {count / seconds:,.0f} cells/s"


def _flags(variable: "xr.DataArray") -> str:
    names = dict(zip(variable.flag_values, variable.flag_meanings.split(), strict=True))
    return _tally(names[value] for value in variable.values.flat)


def _tally(words: Iterable[str]) -> str:
    return ", ".join(f"{word} {n:,}" for word, n in Counter(words).items())


def _place(peak: "xr.DataArray", dataset: "xr.Dataset") -> str:
    where = ", ".join(f"{dim} = {float(peak[dim]):.6g}" for dim in dataset["P"].dims)
    return f"{float(peak):.6g} J per half period at {where or 'the only cell'}"


def main(arguments: list[str] | None = None) -> int:
    """Exit code: 0, or 2 after bad input, when nothing was run; after Ctrl-C the process ends with 130."""
    try:
        power_map.main(arguments, standalone_mode=False)
    except click.ClickException as error:
        click.echo(f"error: {error.format_message()}", err=True)
        return 2
    except (click.Abort, KeyboardInterrupt):
        click.echo("stopped; nothing half-written is left", err=True)
        # A compiled call cannot be stopped: leave without waiting for it.
        os._exit(130)
    return 0


if __name__ == "__main__":
    sys.exit(main())
