"""What the scripts share: axes, device and files on the command line, progress, the closing lines, exit codes.

A script is a click command whose body is one `door`, one run under `progress`, and one `finish`.
"""

import io
import logging
import math
import os
import signal
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    import xarray as xr

    from vijax.model.device import Harvester
    from vijax.model.pair import ImpactPair
    from vijax.planes.estimate import Estimate

_STARTED = time.perf_counter()
_WAITING = logging.getLogger("vijax.waiting")
_MANY = 10_000  # from here on a bar counts by thousands
VALUES = (
    "VALUES are a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE (negative ranges as --u0=-0.1:0.1:9); a number "
    "may be a multiple of pi, as in 6pi, and all may have units, as in 2Hz:10Hz:9 or 20deg (Hz are turns a second)."
)
AXES = {
    "d": "gap, dimensionless",
    "kappa": "stiffness, dimensionless",
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
# One physical name among these, and the plane is the device's: what is not given is taken from Tables I and II.
PHYSICAL = {"s", "omega0", "k"}
DEVICE = PHYSICAL | {"omega", "A", "beta"}


def axis_options(**changed: str | None) -> list[click.Parameter]:
    """An option for every axis.

    Args:
        changed: Another help text for an axis; None where there is no such option.
    """
    helps = AXES | changed
    return [click.Option([f"--{name}", name], metavar="VALUES", help=text) for name, text in helps.items() if text]


def device_options() -> list[click.Parameter]:
    """Constants of the device that are no axes."""
    text = "any other constant of the device"
    return [click.Option(["--set", "constants"], multiple=True, metavar="NAME=VALUE", help=text)]


def file_options(ending: str = ".zarr", what: str = "store") -> list[click.Parameter]:
    """The store (or what a script writes in its place), the picture, and whether they may replace what is there."""
    return [
        click.Option(["--out"], metavar=f"FILE{ending}", help=f"{what} to write"),
        click.Option(["--plot"], metavar="FILE.png", help="picture to write"),
        click.Option(["--overwrite"], is_flag=True, help="replace what is there"),
    ]


def size_option() -> click.Parameter:
    """Whether a run may take more than an hour or 10 GB."""
    return click.Option(["--yes"], is_flag=True, help="begin also what takes more than an hour or 10 GB")


def agree(expected: "Estimate", yes: bool) -> None:
    """Ask whether a long run is meant, or refuse it where nobody can answer."""
    if not expected.long or yes:
        return
    if not sys.stdin.isatty():
        raise ValueError(f"yes must be given beyond an hour or 10 GB; got {expected}; add --yes, or ask for less")
    click.confirm(f"{expected}: begin?", abort=True, err=True)


def take_axes(given: dict[str, Any], defaults: Mapping[str, str]) -> dict[str, Any]:
    """Values of the axes, taken out of what was given.

    Args:
        given: What click parsed, by name; the axes leave it.
        defaults: Texts of axes that count as given where no physical name is among those that are.
    """
    from vijax.planes.axes import parse_axis

    axes = {name: given.pop(name) for name in list(given) if name in AXES}
    texts = {name: text for name, text in axes.items() if text is not None}
    # The defaults come first, so that what is given besides makes panels of their plane.
    if not PHYSICAL & set(texts):
        texts = {name: text for name, text in defaults.items() if name not in texts} | texts
    return {name: parse_axis(name, text) for name, text in texts.items()}


def device(constants: Iterable[str]) -> "Harvester":
    """The device of Tables I and II with other constants, each written NAME=VALUE, with a unit or in SI."""
    from vijax.model import units
    from vijax.model.device import Harvester, with_constants

    values = {}
    for text in constants:
        name, _, value = text.partition("=")
        if not name:
            raise ValueError(f"set must be NAME=VALUE with a number; got {text!r}")
        if name in AXES:
            raise ValueError(
                f"set must name a constant that has no option of its own; got {text!r}; give --{name}={value}"
            )
        number, unit = units.split(value)
        try:
            values[name] = float(number)
        except ValueError:
            raise ValueError(f"set must be NAME=VALUE with a number; got {text!r}") from None
        if unit:
            values[name] = units.with_unit(name, values[name], unit)
    with about("set"):
        return with_constants(Harvester(), **values)


@contextmanager
def about(option: str) -> Iterator[None]:
    """Whatever is found wrong within names the option that it came by."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"--{option}: {error}") from None


def part(option: str, text: str) -> float:
    """A part of a whole, written 5% or 0.05."""
    try:
        return float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        raise ValueError(f"{option} must be a part such as 5% or 0.05; got {text!r}") from None


def at_one_point(axes: Mapping[str, Any], device: "Harvester", wall: str = "soft") -> "tuple[ImpactPair, Harvester]":
    """The pair that the axes give, each by one number, and the device that has it."""
    from vijax.model.device import with_constants, with_pair
    from vijax.model.pair import WALLS, impact_pair
    from vijax.planes.axes import cells
    from vijax.runtime import checks

    for name, values in axes.items():
        if values.size != 1:
            raise ValueError(f"{name} must be one number here; got {values.size} of them")
    checks.choice("wall", wall, WALLS)
    given = cells({name: float(values.flat[0]) for name, values in axes.items()}, device, wall).quantities
    d, kappa, r, gamma, A, omega = (float(given[name]) for name in ("d", "kappa", "r", "gamma", "A", "omega"))
    device = with_constants(device, A=A, omega=omega, omega0=kappa * omega / math.pi)
    pair = impact_pair(d, kappa if wall == "soft" else None, r, gamma)
    return pair, with_pair(device, pair)


def targets(
    out: str | None,
    plot: str | None,
    defaults: tuple[str, str],
    overwrite: bool,
    ending: str = ".zarr",
    goes_on: bool = False,
) -> tuple[Path | None, Path | None]:
    """Store and picture to write, both defaults where neither was given; raises unless they can be written.

    With `goes_on` a store that is there is left to `tiled_store.check`; its picture is drawn again if vijax drew it.
    """
    if out is None and plot is None:
        out, plot = defaults
    store = None if out is None else _store(out, ending, overwrite, goes_on)
    again = goes_on and not overwrite and store is not None and store.exists()
    return store, None if plot is None else _picture(plot, overwrite, again)


def _store(out: str, ending: str, overwrite: bool, goes_on: bool) -> Path:
    from vijax.planes.store import check_place, check_store
    from vijax.runtime.files import check_ending, check_output

    if ending != ".zarr":
        check_ending("out", out, ending)
        return check_output("out", out, overwrite)
    place = check_place("out", out)
    return place if goes_on and not overwrite and place.exists() else check_store("out", out, overwrite)


def _picture(plot: str, overwrite: bool, again: bool) -> Path:
    from vijax.plots.style import is_drawn
    from vijax.runtime.files import check_output

    picture = check_output("plot", plot, overwrite or again)
    if again and picture.exists() and not is_drawn(picture):
        raise FileExistsError(f"plot must be new or a picture drawn by vijax; got {plot}; take another name")
    return picture


@contextmanager
def door() -> Iterator[None]:
    """What is raised within becomes one line and exit code 2: bad input, before anything runs."""
    try:
        yield
    except (ValueError, TypeError, OSError, ImportError) as error:
        raise click.UsageError(str(error)) from None


def keep_compiled() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX was told of another."""
    import jax

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(cache / "vijax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def import_beside(module: str) -> None:
    """Import what will be wanted at the end while XLA compiles or loads, which needs no Python."""
    threading.Thread(target=import_module, args=(module,), daemon=True).start()


@contextmanager
def progress(total: int, unit: str = "cells") -> Iterator[Callable[[int, int], None]]:
    """A progress bar that says what is being waited for, as the callback (done, in all) that runs take."""
    from tqdm import tqdm

    with tqdm(total=total, desc="starting", unit=unit, unit_scale=total >= _MANY) as bar, _told_of_waiting(bar):

        def show(done: int, total: int) -> None:
            if done:
                bar.set_description(unit, refresh=False)
            bar.total = total
            bar.update(done - bar.n)

        yield show


def waiting(what: str) -> None:
    """Say at the progress bar what is being waited for."""
    _WAITING.info(what)


@contextmanager
def _told_of_waiting(bar: Any) -> Iterator[None]:
    """What vijax says it waits for stands before the bar, whose clock goes on while nothing is done."""
    handler, ended = logging.Handler(), threading.Event()
    handler.emit = lambda record: bar.set_description(record.getMessage())  # type: ignore[method-assign]

    def tick() -> None:
        while not ended.wait(1.0):
            bar.refresh()

    level, passed_on = _WAITING.level, _WAITING.propagate
    _WAITING.addHandler(handler)
    _WAITING.setLevel(logging.INFO)
    _WAITING.propagate = False  # the bar shows it, and nothing else twice
    clock = threading.Thread(target=tick, daemon=True)
    if sys.stderr.isatty():  # a log would fill with it
        clock.start()
    try:
        yield
    finally:
        ended.set()
        _WAITING.removeHandler(handler)
        _WAITING.setLevel(level)
        _WAITING.propagate = passed_on


def finish(
    dataset: "xr.Dataset",
    summary: str,
    out: Path | None,
    plot: Path | None,
    picture: "Callable[[xr.Dataset, Path], Any]",
    overwrite: bool,
    kept: bool = False,
) -> None:
    """Write the store, unless the run did, and the picture; say what was found and written, and how long it took."""
    if out is not None and not kept:
        from vijax.planes.store import save

        save(dataset, out, overwrite=overwrite)
    if plot is not None:
        picture(dataset, plot)
    close(summary, out, plot)


def close(summary: str, *written: Path | None) -> None:
    """Say what the run found, what was written and how long it all took."""
    click.echo(summary)
    click.echo(f"wrote {', '.join(str(path) for path in written if path)}")
    click.echo(f"{time.perf_counter() - _STARTED:.1f} s from start to end")


def pace(count: int, seconds: float, unit: str = "cells") -> str:
    """How much was done in what time."""
    rate = count / seconds
    return f"{count:,} {unit} in {seconds:.2f} s, {rate:{',.0f' if rate >= 100 else '.3g'}} {unit}/s"


def flags(variable: "xr.DataArray") -> str:
    """How often each value of a variable with CF flags occurs."""
    names = dict(zip(variable.flag_values, variable.flag_meanings.split(), strict=True))
    return tally(variable.values, names.get)


def statuses(variable: "xr.DataArray", of: str = "cells") -> str:
    """How often each status occurs; below, what to do about those that are not OK."""
    from vijax.model.records import Status

    lines = [f"{of} by status: {flags(variable)}"]
    found = [status for status in Status if status != Status.OK and (variable == status).any()]
    return "\n".join([*lines, *(f"    {status.name.lower()}: {status.advice}" for status in found)])


def tally(values: Any, name: Callable[[Any], Any], order: Callable[[Any], Any] | None = None) -> str:
    """How often each name occurs among that many values, the least values first, or those least by `order`."""
    import numpy as np

    kinds, counts = np.unique(values, return_counts=True)
    found: Counter[str] = Counter()
    rows = zip(kinds.tolist(), counts.tolist(), strict=True)
    for kind, count in sorted(rows, key=lambda row: (order or float)(row[0])):
        found[str(name(kind))] += count
    return ", ".join(f"{word} {n:,}" for word, n in found.items())


@contextmanager
def _warnings_told() -> Iterator[None]:
    """What vijax warns of becomes one line, told once."""
    from tqdm import tqdm

    told: set[str] = set()

    def tell(message: Warning | str, *_: Any, **__: Any) -> None:
        if str(message) not in told:
            told.add(str(message))
            tqdm.write(f"warning: {message}", file=sys.stderr)  # beside a bar that may be there

    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=UserWarning, module="vijax")
        warnings.showwarning = tell
        yield


class _Terminated(KeyboardInterrupt):
    """What SIGTERM raises."""


def _terminate(signum: int, frame: Any) -> None:
    raise _Terminated


def run(command: click.Command, arguments: list[str] | None = None) -> int:
    """Exit code of a script: 0; 1 if what it writes could not be written; 2 after bad input, when nothing was run.

    After Ctrl-C the process ends with 130, after SIGTERM with 143.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _terminate)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # what a terminal cannot show must not end a finished run
    try:
        with _warnings_told():
            command.main(arguments, standalone_mode=False)
    except click.ClickException as error:
        click.echo(f"error: {error.format_message()}", err=True)
        return 2
    except (click.Abort, KeyboardInterrupt) as error:
        cause = error.__cause__ or error
        click.echo(f"stopped; {_kept(cause)}", err=True)
        # A compiled call cannot be stopped: leave without waiting for it.
        os._exit(143 if isinstance(cause, _Terminated) else 130)
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        click.echo(f"error: {error.strerror or error}{where}; {_kept(error)}", err=True)
        os._exit(1)
    return 0


def _kept(error: BaseException) -> str:
    """What a run that came to no end says of its files."""
    return " ".join(getattr(error, "__notes__", ["nothing half-written is left"]))
