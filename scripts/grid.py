"""A map of harvested energy from one command: a labelled store, a picture, a closing summary.

    python scripts/grid.py
    python scripts/grid.py --gamma 0.1 --out inclined.zarr --plot inclined.png  # stopped, it goes on when given again
    python scripts/grid.py --omega pi:6pi:96 --omega0 20:400:96 --plot device.png
    python scripts/grid.py --show label --plot labels.png
    python scripts/grid.py --show max_penetration --plot depth.png
    python scripts/grid.py --kappa 3:4000:128:log --compare rigid --tolerance 5%

An axis is a number, a comma list, LO:HI:N, LO:HI:N:log or @FILE; arrays become dimensions in the order given: x, y and
panels of the picture. Write a range that begins with a minus as --u0=-0.1:0.1:9.
"""

import math
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import command
from command import flags, keep_compiled, tally

if TYPE_CHECKING:
    import xarray as xr

    from vijax.planes.compare import Comparison
    from vijax.planes.dataset import Plan

_DEFAULT_PLANE = {"d": "0.05:0.3:128", "kappa": "3:400:128:log"}
_METHOD_OPTIONS = ("method", "solver", "rtol", "atol", "steps", "membrane", "chi", "exponent")
_LONG = 9  # periods from here on are counted together
_FILES = {
    "P": ("power_map.zarr", "power_map.png"),
    "label": ("label_map.zarr", "label_map.png"),
    "difference": ("comparison.zarr", "comparison.png"),
}


def _options() -> list[click.Parameter]:
    planes = {
        name: f"{command.AXES[name]} [{text} unless --s, --omega0 or --k is given]"
        for name, text in _DEFAULT_PLANE.items()
    }
    return [
        *command.axis_options(**planes),
        *command.device_options(),
        click.Option(["--periods"], default=400, show_default=True, help="forcing periods to run, at most"),
        click.Option(["--until"], default="attractor", show_default=True, help="attractor or window"),
        click.Option(["--transient"], default=0, show_default=True, help="forcing periods to drop before a window"),
        click.Option(["--wall"], default="soft", show_default=True, help="soft or rigid"),
        click.Option(["--compare"], metavar="rigid", help="map what rigid walls change instead: P and the label"),
        click.Option(["--tolerance"], metavar="5%", help="with --compare: part of P that they may change"),
        click.Option(["--method"], default="exact", show_default=True, help="exact, ode or rk4"),
        click.Option(["--solver"], help="of ode: Tsit5, Dopri5, Dopri8, Kvaerno5 ... [Tsit5]"),
        click.Option(["--rtol"], type=float, help="of ode: relative tolerance of a step [1e-8]"),
        click.Option(["--atol"], type=float, help="of ode: absolute tolerance of a step [1e-10]"),
        click.Option(["--steps"], type=int, help="of rk4: steps per forcing period [1000]"),
        click.Option(["--membrane"], help="of ode and rk4: linear or hunt-crossley [linear]"),
        click.Option(["--chi"], type=float, help="of hunt-crossley: damping over stiffness"),
        click.Option(["--exponent"], type=float, help="of hunt-crossley: exponent of the penetration [1.5]"),
        click.Option(["--dtype"], default="float64", show_default=True, help="float64 or float32"),
        click.Option(
            ["--outputs"],
            metavar="NAME,NAME",
            help="variables wanted [all but asymmetry, lyapunov; for labels lyapunov too]",
        ),
        click.Option(
            ["--refine"],
            type=int,
            metavar="LEVELS",
            help="compute every 2^LEVELS-th cell along each axis, then those at borders; fill the others",
        ),
        click.Option(["--show"], default="P", show_default=True, help="what the picture shows: any variable, or label"),
        *command.file_options(),
        click.Option(["--workers"], type=int, help="processes that share the cores and write the store, by Dask"),
        click.Option(["--scheduler"], metavar="ADDRESS", help="of Dask: its workers, which see the store, write it"),
        command.size_option(),
    ]


@click.command(
    params=_options(),
    epilog=f"{command.VALUES} With neither --out nor --plot, power_map.zarr and power_map.png are written, "
    "or the same of label_map, comparison or NAME_map, by what is shown. A map is written as it is made: stopped in "
    "whatever way, the same command goes on with it, and --overwrite begins anew.",
    context_settings={"max_content_width": 120},
)
def power_map(
    constants: tuple[str, ...],
    outputs: str | None,
    compare: str | None,
    tolerance: str | None,
    show: str,
    overwrite: bool,
    workers: int | None,
    scheduler: str | None,
    yes: bool,
    **given: Any,
) -> None:
    """Map the energy harvested over a plane of parameters."""
    with command.door():
        _check_show(show, compare, given["until"])
        picture = show if compare is None else "difference"
        files = _FILES.get(picture, (f"{picture}_map.zarr", f"{picture}_map.png"))
        out, plot = command.targets(given.pop("out"), given.pop("plot"), files, overwrite, goes_on=compare is None)
        axes, device = command.take_axes(given, _DEFAULT_PLANE), command.device(constants)
        if compare is None and tolerance is not None:
            raise ValueError(f"tolerance must come with compare; got {tolerance} alone; add --compare rigid")
        planned: Plan | Comparison
        if compare is None:
            planned = _plan(axes, device, _wanted(outputs, show), given)
        else:
            planned = _comparison(axes, device, outputs, compare, tolerance, given)
        if plot is not None:
            _check_picture(plot, planned, show)
        crew = _crew(planned, workers, scheduler, out)
        _check_room(planned, out, overwrite)
        keep_compiled()
        _agree(planned, yes)
    if plot is not None:
        command.import_beside("vijax.plots.maps")
    dataset, pace = _run(planned, out, overwrite, crew)
    summary = (_summary if compare is None else _comparison_summary)(dataset)
    kept = compare is None
    command.finish(dataset, f"{pace}\n{summary}", out, plot, partial(_draw, picture), overwrite, kept)


def _crew(
    planned: "Plan | Comparison", workers: int | None, scheduler: str | None, out: Path | None
) -> int | str | None:
    """Who runs the tiles, unless this process does."""
    from vijax.planes.compare import Comparison
    from vijax.planes.sweep import check_workers

    if workers is not None and scheduler is not None:
        raise ValueError(f"workers must be left out with scheduler, which has its own; got {workers}")
    crew = scheduler if workers is None else workers
    if crew is None:
        return None
    if isinstance(planned, Comparison):
        raise ValueError(f"workers must be left out with compare, which runs in one process; got {crew}")
    check_workers(planned, crew, out)
    return crew


def _check_room(planned: "Plan | Comparison", out: Path | None, overwrite: bool) -> None:
    from vijax.planes import sweep
    from vijax.planes.compare import Comparison

    if isinstance(planned, Comparison):
        sweep.check_room(planned.soft)
    elif out is None:
        sweep.check_room(planned)
    else:
        sweep.check(planned, out, overwrite)


def _agree(planned: "Plan | Comparison", yes: bool) -> None:
    from vijax.planes import estimate
    from vijax.planes.compare import Comparison

    plans = (planned.soft, planned.rigid) if isinstance(planned, Comparison) else (planned,)
    command.agree(estimate.of(*plans), yes)


def _check_show(show: str, compare: str | None, until: str) -> None:
    from vijax.planes.dataset import OUTPUTS

    if show != "label" and show not in OUTPUTS:
        raise ValueError(f"show must be label, or among {', '.join(OUTPUTS)}; got {show!r}")
    if show != "P" and compare is not None:
        raise ValueError(f"show must be left out with compare, which shows the difference in P; got {show}")
    if show == "label" and until != "attractor":
        raise ValueError(f"show must not be label unless cells are run until their attractor; got until {until}")


def _wanted(outputs: str | None, show: str) -> list[str] | None:
    if outputs is not None:
        return [name.strip() for name in outputs.split(",")]
    from vijax.planes.dataset import ON_REQUEST, OUTPUTS

    shown = "lyapunov" if show == "label" else show
    return [name for name in OUTPUTS if name not in ON_REQUEST or name == shown]


def _plan(axes: dict[str, Any], device: Any, outputs: list[str] | None, settings: dict[str, Any]) -> "Plan":
    from vijax.planes.sweep import plan

    settings["membrane"] = _membrane(settings["membrane"], settings.pop("chi"), settings.pop("exponent"))
    return plan(axes, outputs, device, **settings)


def _comparison(
    axes: dict[str, Any],
    device: Any,
    outputs: str | None,
    other: str,
    tolerance: str | None,
    settings: dict[str, Any],
) -> "Comparison":
    from vijax.planes.compare import plan

    if other != "rigid":
        raise ValueError(f'compare must be "rigid"; got {other!r}')
    if (wall := settings.pop("wall")) != "soft":
        raise ValueError(f"wall must not be chosen with compare, which runs soft and rigid ones; got {wall!r}")
    if outputs is not None:
        raise ValueError(f"outputs must not be chosen with compare; got {outputs!r}; leave them out")
    if (levels := settings.pop("refine")) is not None:
        raise ValueError(f"refine must not be chosen with compare, which computes every cell; got {levels}")
    for name in _METHOD_OPTIONS:
        if (value := settings.pop(name)) not in (None, "exact"):
            raise ValueError(f"{name} must not be chosen with compare, which is exact; got {value!r}")
    return plan(axes, None if tolerance is None else command.part("tolerance", tolerance), device, **settings)


def _membrane(name: str | None, chi: float | None, exponent: float | None) -> Any:
    from vijax.model.membrane import HuntCrossley, Linear

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


def _check_picture(path: Path, planned: "Plan | Comparison", show: str) -> None:
    from vijax.planes.compare import Comparison
    from vijax.planes.dataset import specimen
    from vijax.plots import style
    from vijax.plots.style import check_format

    check_format(path)
    if isinstance(planned, Comparison):
        style.layout(planned.soft.cells.sizes)
        return
    needs = {"label": style.LABEL_NEEDS, "P": style.NEEDS}.get(show, (show,))
    missing = [name for name in needs if name not in planned.outputs]
    if missing:
        raise ValueError(f"outputs must hold {', '.join(missing)} for a picture; add them, or give --out alone")
    sizes = planned.cells.sizes
    if show == "label":
        style.layout_of_kinds({dim: sizes[dim] for dim in planned.cells.dynamic})
        return
    if show == "P":
        style.layout(sizes)
        return
    drawn = specimen(planned)[show]  # its dimensions are those that it depends on
    fits = style.layout_of_kinds if style.is_kind(drawn) else style.layout
    fits({str(dim): sizes[str(dim)] for dim in drawn.dims})


def _run(
    planned: "Plan | Comparison", out: Path | None, overwrite: bool, crew: int | str | None
) -> "tuple[xr.Dataset, str]":
    """The map, and how fast it was made."""
    from vijax.planes import sweep
    from vijax.planes.compare import Comparison, run

    told: list[int] = []  # cells done, at first those that a store held already

    with command.progress(planned.count) as show:

        def tell(done: int, total: int) -> None:
            told.append(done)
            show(done, total)

        began = time.perf_counter()
        found = (
            run(planned, tell) if isinstance(planned, Comparison) else sweep.run(planned, tell, out, overwrite, crew)
        )
    pace = command.pace(told[-1] - told[0], time.perf_counter() - began)
    return found, f"{pace}, {told[0]:,} were there" if told[0] else pace


def _draw(picture: str, dataset: "xr.Dataset", path: Path) -> None:
    from vijax.plots import maps as pictures

    known = {"P": pictures.power_map, "label": pictures.label_map, "difference": pictures.difference_map}
    if picture in known:
        known[picture](dataset, path)
    else:
        pictures.variable_map(dataset, picture, path)


def _summary(dataset: "xr.Dataset") -> str:
    """What the map holds, in a few lines: cells by status and by period, the best of them."""
    from vijax.planes.dataset import best

    lines = [command.statuses(dataset["status"])]
    if "computed" in dataset:
        computed, shown = dataset.attrs["refine_computed"], dataset.attrs["refine_shown"]
        lines.insert(0, f"cells computed: {computed:,} of {shown:,} shown, {computed / shown:.1%}; the others filled")
    if "period" in dataset:
        names = {-1: "undecided", 0: "aperiodic"} | {n: f"period {n}" for n in range(1, _LONG)}
        periods = tally(
            dataset["period"].values,
            lambda period: names.get(period, f"{_LONG} and more"),
            order=lambda period: period if period > 0 else math.inf,
        )
        lines.append(f"cells by period: {periods}")
    if {"P", "admissible"} <= set(dataset):
        peak = best(dataset)
        lines.append(f"largest admissible P: {'none' if peak is None else _place(peak, dataset)}")
    return "\n".join(lines)


def _comparison_summary(dataset: "xr.Dataset") -> str:
    """What the comparison holds, in a few lines: how cells ended, labels, verdicts, from where rigid is enough."""
    lines = [command.statuses(dataset[f"status_{wall}"], f"{wall} cells") for wall in ("soft", "rigid")]
    lines.append(f"label: {flags(dataset['label'])}")
    lines.append(f"median difference in P: {100 * float(dataset['relative_difference'].median()):.3g} %")
    if "cheapest_model" in dataset:
        verdict = dataset["cheapest_model"]
        within = f"{100 * verdict.attrs['tolerance']:g} %"
        lines.append(f"cheapest model within {within}: {flags(verdict)}")
    if "rigid_from" in dataset:
        onset = dataset["rigid_from"]
        found = onset.values[onset.notnull().values]
        span = f"{found.min():.4g} to {found.max():.4g}, median {onset.median():.4g}" if found.size else "none"
        lines.append(f"least {onset.axis} from which on it is rigid: {span} ({found.size} of {onset.size} found)")
    return "\n".join(lines)


def _place(peak: "xr.DataArray", dataset: "xr.Dataset") -> str:
    where = ", ".join(f"{dim} = {float(peak[dim]):.6g}" for dim in dataset["P"].dims)
    return f"{float(peak):.6g} J per half period at {where or 'the only cell'}"


def main(arguments: list[str] | None = None) -> int:
    """Exit code; see `command.run`."""
    return command.run(power_map, arguments)


if __name__ == "__main__":
    sys.exit(main())
