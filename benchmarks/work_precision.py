"""Which method is the cheapest for an acceptable error: soft walls, stiff walls, rigid walls, grazing, chaos?

    python benchmarks/work_precision.py           # all scenes: rows/work_precision.csv and the chart of the README
    python benchmarks/work_precision.py --quick   # one scene, few methods, timings that mean nothing: does it run?

Regular scenes start on the attractor of each cell; the error is the error of (u, v) after 8 periods, against 50-digit
arithmetic, its median and maximum over near cells. In chaos only averages are meaningful: there the error is the
mean deviation of P from a run 20 times as long, in units of its standard error. The last scene measures the derivative
of the final state with respect to kappa, against differences in 50 digits. A cell without a number has an infinite
error. The time is a warm call's time on many cells, in microseconds per cell-period; compilation is reported
separately. Typical printout, two cores:

    2 cores, cpu, JAX 0.10.2
    soft, kappa = 4          exact               float64       0.285 us  error 1.5e-16
    soft, kappa = 4          exact float32       float32       0.168 us  error 1.3e-07
    soft, kappa = 4          ode Tsit5           1e-8           9.89 us  error 2.2e-09
"""

import argparse
import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import vijax
from benchmarks import peers, tables, yardstick
from benchmarks.charts import work_precision

HERE = Path(__file__).parent
CHART = HERE.parent / "scripts" / "gallery" / "work_precision.png"

R = 0.5
PERIODS = 8  # from the start to the state with the measured error
CAPACITY = 4 * PERIODS  # impacts
SETTLING = 40  # times PERIODS, from the default start to the attractor
COMPARED = 5  # cells of a scene with a measured error
NUDGE = mp.mpf("1e-18")  # relative change of kappa for central differences in 50 digits: exact to 36 digits

# Number of cells for a timing.
TIMED = {"exact": 16384, "ode": 2048, "rk4": 2048, "numba": 4096, "chain": 64, "scipy": COMPARED, "gradient": 64}
LEAST_SECONDS, MOST_PERIODS = 0.2, 100  # of a timing

CHAOTIC_CELLS, TRANSIENT, WINDOW, LONG = 1024, 50, 50, 20  # numbers of periods; length of the reference in windows


class Scene(NamedTuple):
    """Cells of one kind: a short range of d, all else equal."""

    name: str
    kappa: float | None
    d: tuple[float, float]
    gamma: float = 0.0

    @property
    def title(self) -> str:
        """Return the title in the chart."""
        return self.name + ("" if self.kappa is None else rf", $\kappa$ = {self.kappa:g}")


SCENES = (
    Scene("soft", 4.0, (0.15, 0.16)),
    Scene("mid", 40.0, (0.2, 0.21)),
    Scene("stiff", 400.0, (0.2, 0.21)),
    Scene("very stiff", 4000.0, (0.2, 0.21)),
    Scene("rigid", None, (0.2, 0.21)),
    Scene("grazing", 40.0, (0.1386, 0.1388)),  # every other period one impact at 0.01 to 0.02, others at 0.5
    Scene("inclined", 40.0, (0.21, 0.22), gamma=0.1),
)
MID = SCENES[1]
CHAOS = Scene("chaotic", 60.9, (0.1013, 0.1141))


class Cells(NamedTuple):
    """Cells of a scene and their starts at phase 0."""

    scene: Scene
    d: np.ndarray
    u0: Any
    v0: Any


class Row(NamedTuple):
    """One method with one setting on one scene, as stored in the CSV file and drawn in the chart."""

    scene: str
    measure: str  # quantity with the error: state, power or gradient
    method: str
    setting: str
    us: float  # microseconds per cell-period, warm
    compile_s: float  # of the programs that this row needs first
    error: float  # median
    worst: float
    lost: int  # cells without a number
    noise: float = 0.0  # standard error of an average


class Contender(NamedTuple):
    """A method with a setting: its result, and its run with a number of cells for the timing."""

    method: str
    setting: str
    answer: Callable[[Cells], tuple[np.ndarray, np.ndarray]]
    timed: Callable[[Cells, int], Any]
    cells: int


# --- the runs -------------------------------------------------------------------------------------


def pair_of(cells: Cells, dtype: str = "float64", kappa: Any = None) -> vijax.ImpactPair:
    """Return the parameters of the cells, optionally with another kappa."""
    d, r, gamma = (jnp.broadcast_to(jnp.asarray(x, dtype), cells.d.shape) for x in (cells.d, R, cells.scene.gamma))
    if kappa is None and cells.scene.kappa is not None:
        kappa = jnp.full_like(d, cells.scene.kappa)
    return vijax.ImpactPair(d=d, kappa=kappa, r=r, gamma=gamma)


def follow(cells: Cells, dtype: str = "float64", **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the state after PERIODS by `vijax.trajectory`."""
    max_impacts = None if options else CAPACITY  # step budget and cost grow with it
    states = vijax.trajectory(
        pair_of(cells, dtype), cells.u0, cells.v0, PERIODS, max_impacts=max_impacts, **options
    ).states
    return np.asarray(states.u)[:, -1], np.asarray(states.v)[:, -1]


def sweep(cells: Cells, periods: int, **options: Any) -> Any:
    """Run a window by `vijax.sweep`, from axes to labelled dataset."""
    scene = cells.scene
    wall = {"wall": "rigid"} if scene.kappa is None else {"kappa": scene.kappa}
    starts = {name: start for name, start in (("u0", cells.u0), ("v0", cells.v0)) if start is not None}
    options = {"outputs": ("impacts_per_period",)} | options | wall | starts
    return vijax.sweep(d=cells.d, r=R, gamma=scene.gamma, until="window", periods=periods, **options)


def slope(cells: Cells, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate the state after PERIODS with respect to kappa."""

    def end(kappa):
        pair = pair_of(cells, kappa=kappa)
        states = vijax.trajectory(pair, cells.u0, cells.v0, PERIODS, max_impacts=CAPACITY, **options).states
        return states.u[:, -1], states.v[:, -1]

    kappa = pair_of(cells).kappa
    _, (u, v) = jax.jvp(end, (kappa,), (jnp.ones(cells.d.shape),))
    return np.asarray(u), np.asarray(v)


def rk4(cells: Cells, periods: int = PERIODS, *, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Run the peer without events."""
    d, kappa, u0, v0, gamma = cells.d, cells.scene.kappa, cells.u0, cells.v0, cells.scene.gamma
    _, u, v = peers.rk4(d, kappa, R, u0, v0, periods, steps, gamma=gamma)
    return u, v


def located(solve: Callable, cells: Cells, periods: int = PERIODS, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Run a peer with events."""
    scene = cells.scene
    return solve(cells.d, scene.kappa, R, scene.gamma, cells.u0, cells.v0, periods, **options)


# --- truth ----------------------------------------------------------------------------------------


def settled(scene: Scene) -> Cells:
    """Return the cells with measured errors, each on its attractor at phase 0."""
    cells = Cells(scene, np.linspace(*scene.d, COMPARED), 0.02, 0.3)
    for _ in range(SETTLING):
        u, v = follow(cells)
        cells = cells._replace(u0=u, v0=v)
    return cells


def truth(cells: Cells, by_kappa: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Compute the state after PERIODS in 50 digits, or its derivative by kappa.

    The exact engine's impacts are only the guesses for each event's root.
    """
    run = vijax.trajectory(pair_of(cells), cells.u0, cells.v0, PERIODS, max_impacts=CAPACITY)
    times, durations, filled = (np.asarray(x) for x in (run.impacts.t, run.impacts.duration, run.filled))
    onsets = times + 2 * np.asarray(run.impacts.n)
    ends = []
    for cell, count in enumerate(filled):
        onset, contact_durations = onsets[cell, :count], durations[cell, :count]
        if not (count and onset[-1] + contact_durations[-1] < 2 * PERIODS):
            raise SystemExit(f"{cells.scene.name}: the last period must end in flight")
        flights = np.diff(onset, prepend=0) - np.append(0, contact_durations[:-1])
        guesses = [(flight, s, 0.5 * s) for flight, s in zip(flights, contact_durations, strict=True)]
        parameters = [cells.d[cell], cells.scene.kappa, R, cells.scene.gamma, cells.u0[cell], cells.v0[cell]]
        with mp.workdps(yardstick.DIGITS):
            ends.append(_slope_50(parameters, guesses) if by_kappa else _state_50(parameters, guesses))
    u, v = np.array(ends, dtype=float).T
    return u, v


def _state_50(parameters: list[Any], guesses: list) -> tuple[mp.mpf, mp.mpf]:
    rows, _ = yardstick.mp_march(parameters, len(guesses), guesses)
    last, d, gamma = rows[-1], mp.mpf(parameters[0]), mp.mpf(parameters[3])
    exit_time = last.t + last.duration
    displacement, v = yardstick.mp_flight(gamma, exit_time, last.v_out, 2 * PERIODS - exit_time)
    return last.side * d / 2 + displacement, v


def _slope_50(parameters: list[Any], guesses: list) -> list[mp.mpf]:
    d, kappa, *others = parameters
    up, down = (_state_50([d, mp.mpf(kappa) * (1 + nudge), *others], guesses) for nudge in (NUDGE, -NUDGE))
    return [(high - low) / (2 * kappa * NUDGE) for high, low in zip(up, down, strict=True)]


# --- the contenders -------------------------------------------------------------------------------


def tolerances(*exponents: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield relative tolerances by their exponents, as text and as options; the absolute one is a hundredth."""
    for exponent in exponents:
        yield f"1e-{exponent}", {"rtol": 10.0**-exponent, "atol": 10.0 ** -(exponent + 2)}


SOLVERS = {"Tsit5": (4, 6, 8, 10, 12), "Dopri8": (6, 8, 10, 12), "Kvaerno5": (4, 6, 8)}
STEPS = (250, 1000, 4000)
MORE_STEPS = (16000, 64000)  # for the cheapest method only


def vijax_contenders(scene: Scene) -> Iterator[Contender]:
    """Yield the methods of vijax."""
    for name, dtype in (("exact", "float64"), ("exact float32", "float32")):
        yield Contender(name, dtype, partial(follow, dtype=dtype), partial(sweep, dtype=dtype), TIMED["exact"])
    if scene.kappa is None:
        return
    options: dict[str, Any]
    for solver, exponents in SOLVERS.items():
        for setting, numbers in tolerances(*exponents):
            options = {"method": "ode", "solver": solver} | numbers
            yield Contender(
                f"ode {solver}", setting, partial(follow, **options), partial(sweep, **options), TIMED["ode"]
            )
    for steps in STEPS:
        options = {"method": "rk4", "steps": steps}
        yield Contender("rk4", f"{steps}", partial(follow, **options), partial(sweep, **options), TIMED["rk4"])


def peer_contenders(scene: Scene) -> Iterator[Contender]:
    """Yield the peers."""
    if scene.kappa is not None:
        for steps in (*STEPS, *MORE_STEPS):
            run = partial(rk4, steps=steps)
            yield Contender("numba RK4", f"{steps}", run, run, TIMED["numba"])
    for setting, options in tolerances(4, 6, 8, 10, 12):
        run = partial(located, peers.dormand_prince, rtol=options["rtol"])
        yield Contender("numba DP5 + events", setting, run, run, TIMED["numba"])
    for setting, options in tolerances(6, 8, 10):
        run = partial(located, peers.diffrax_chain, rtol=options["rtol"])
        yield Contender("diffrax restarts", setting, run, run, TIMED["chain"])
    for solver, exponents in (("DOP853", (6, 9, 12)), ("Radau", (5, 8))):
        for setting, options in tolerances(*exponents):
            run = partial(located, peers.scipy_events, rtol=options["rtol"], solver=solver)
            yield Contender(f"SciPy {solver}", setting, run, run, TIMED["scipy"])


def of_gradients() -> Iterator[Contender]:
    """Yield the differentiable methods."""
    choices: list[tuple[str, str, dict[str, Any]]] = [("exact", "float64", {})]
    for solver in ("Tsit5", "Dopri8"):
        base_options: dict[str, Any] = {"method": "ode", "solver": solver}
        choices += [
            (f"ode {solver}", setting, base_options | tolerance) for setting, tolerance in tolerances(4, 6, 8, 10)
        ]
    choices += [("rk4", f"{steps}", {"method": "rk4", "steps": steps}) for steps in STEPS]
    for name, setting, options in choices:
        run = partial(slope, **options)
        yield Contender(name, setting, run, partial(as_it_is, run), TIMED["gradient"])


def of_averages() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield the methods that can run for long enough: names, settings, options of a sweep."""
    for name, dtype in (("exact", "float64"), ("exact float32", "float32")):
        yield name, dtype, {"dtype": dtype}
    for setting, options in tolerances(4, 6, 8):
        yield "ode Tsit5", setting, {"method": "ode", "solver": "Tsit5"} | options
    for steps in (100, *STEPS[:2]):
        yield "rk4", f"{steps}", {"method": "rk4", "steps": steps}


# --- measuring ------------------------------------------------------------------------------------


def seconds(call: Callable[[], Any]) -> float:
    """Time a call with its result in host memory."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def timing(run: Callable[[int], Any], cells: int, periods: int | None = None) -> tuple[float, float]:
    """Return a warm call's time in microseconds per cell-period, and the additional seconds of its first call.

    Args:
        run: A call for a number of periods; it compiles one program for all of them.
        cells: Number of its cells.
        periods: The number of periods, if it is fixed; by default enough periods for a reliable timing.
    """
    count = periods or 1
    cold, warm = seconds(partial(run, count)), seconds(partial(run, count))
    compiling = max(cold - warm, 0.0)
    if periods is None and warm < LEAST_SECONDS:
        count = min(int(LEAST_SECONDS / warm) + 1, MOST_PERIODS)
        warm = seconds(partial(run, count))
    return 1e6 * min(warm, seconds(partial(run, count))) / (cells * count), compiling


def as_it_is(answer: Callable[[Cells], Any], cells: Cells, _: int) -> Any:
    """Run for PERIODS; another number of periods would need another compilation."""
    return answer(cells)


def deviation(computed: tuple[np.ndarray, np.ndarray], exact: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the distance of each cell's result from the exact one, infinite without a result."""
    error = np.hypot(*(np.asarray(a, float) - b for a, b in zip(computed, exact, strict=True)))
    return np.where(np.isfinite(error), error, np.inf)


def regular(scene: Scene, contenders: Iterator[Contender], quick: bool) -> Iterator[Row]:
    """Measure the final state's error, cost and compile time of every contender on one scene."""
    cells = settled(scene)
    exact = truth(cells)
    middle = COMPARED // 2
    for contender in contenders:
        if quick:
            us, compiling = timing(partial(as_it_is, contender.answer, cells), COMPARED, PERIODS)
        else:
            many = Cells(scene, np.linspace(*scene.d, contender.cells), cells.u0[middle], cells.v0[middle])
            us, compiling = timing(partial(contender.timed, many), contender.cells)
        error = deviation(contender.answer(cells), exact)
        yield Row(scene.title, "state", contender.method, contender.setting, us, compiling, *summary(error))


def summary(error: np.ndarray) -> tuple[float, float, int]:
    """Return median, maximum and number of infinite errors."""
    return float(np.median(error)), float(error.max()), int(np.isinf(error).sum())


def gradients(scene: Scene) -> Iterator[Row]:
    """Measure the relative error of the derivative of the final state with respect to kappa."""
    cells = settled(scene)
    exact = truth(cells, by_kappa=True)
    copies = np.resize(np.arange(COMPARED), TIMED["gradient"])
    many = Cells(scene, *(np.asarray(x)[copies] for x in cells[1:]))
    for contender in of_gradients():
        us, compiling = timing(partial(contender.timed, many), contender.cells, PERIODS)
        u, v = contender.answer(many)
        error = deviation((u[:COMPARED], v[:COMPARED]), exact) / np.hypot(*exact)
        name = scene.title.replace(scene.name, "gradient")
        yield Row(name, "gradient", contender.method, contender.setting, us, compiling, *summary(error))


def averages(scene: Scene) -> Iterator[Row]:
    """Measure the mean relative deviation of P over chaotic cells, and its standard error."""
    cells = Cells(scene, np.linspace(*scene.d, CHAOTIC_CELLS), None, None)

    def power(periods: int, transient: int, **options: Any) -> np.ndarray:
        return sweep(cells, periods, transient=transient, outputs=("P",), **options).P.values.ravel().astype(float)

    reference = power(LONG * WINDOW, TRANSIENT)
    for name, setting, options in of_averages():
        compiling = seconds(partial(power, 1, 0, **options))
        start = time.perf_counter()
        relative_deviation = power(WINDOW, TRANSIENT, **options) / reference - 1
        us = 1e6 * (time.perf_counter() - start) / (CHAOTIC_CELLS * (TRANSIENT + WINDOW))
        lost = int((~np.isfinite(relative_deviation)).sum())
        error = float("inf") if lost else abs(float(relative_deviation.mean()))
        noise = float(np.std(relative_deviation[np.isfinite(relative_deviation)])) / CHAOTIC_CELLS**0.5
        yield Row(
            scene.title,
            "power",
            name,
            setting,
            us,
            compiling,
            error,
            float(np.abs(relative_deviation).max()),
            lost,
            noise,
        )


def quick_contenders() -> Iterator[Contender]:
    """Yield a few contenders that compile in seconds."""
    settings = {
        "exact": {"float64"},
        "ode Tsit5": {"1e-4", "1e-6", "1e-8"},
        "numba RK4": {"250", "4000"},
        "numba DP5 + events": {"1e-4", "1e-6", "1e-8"},
        "SciPy DOP853": {"1e-6", "1e-9"},
    }
    all_contenders = (*vijax_contenders(MID), *peer_contenders(MID))
    return (contender for contender in all_contenders if contender.setting in settings.get(contender.method, ()))


def measure(quick: bool) -> Iterator[Row]:
    """Measure all rows."""
    if quick:
        yield from regular(MID, quick_contenders(), quick)
        return
    for scene in SCENES:
        yield from regular(scene, iter((*vijax_contenders(scene), *peer_contenders(scene))), quick)
    yield from averages(CHAOS)
    yield from gradients(MID)


def row_text(row: Row) -> str:
    """Return the text of a row."""
    name = row.scene.replace("$", "").replace("\\", "")
    noise = f" +- {row.noise:.1e}" if row.noise else ""
    lost = f"  {row.lost} CELLS LOST" if row.lost else ""
    return f"{name:24} {row.method:19} {row.setting:8} {row.us:10.3g} us  error {row.error:.1e}{noise}{lost}"


def main() -> None:
    """Measure, print and store the rows, and draw the chart."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one scene, few methods, seconds in all: does it run?")
    parser.add_argument("--rows", type=Path, default=tables.ROWS, help="folder for the raw rows")
    parser.add_argument("--chart", type=Path, help="picture to draw; that of the README unless --quick")
    parser.add_argument("--redraw", action="store_true", help="draw the stored rows again, measure nothing")
    options = parser.parse_args()
    chart = options.chart or (None if options.quick else CHART)
    path = options.rows / f"work_precision{'_quick' if options.quick else ''}.csv"
    if not options.redraw:
        print(f"{os.cpu_count()} cores, {jax.devices()[0].device_kind}, JAX {jax.__version__}")
        tables.write(path, Row._fields, print_rows(measure(options.quick)))
    if chart is not None:
        work_precision(tables.read(path), chart)


def print_rows(rows: Iterator[Row]) -> Iterator[Row]:
    """Print rows as they are measured."""
    for row in rows:
        print(row_text(row), flush=True)
        yield row


if __name__ == "__main__":
    main()
