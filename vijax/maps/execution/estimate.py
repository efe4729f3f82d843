"""Estimates of the duration and the size of a run before it starts, from the measured cost of recent runs.

The duration is cells x starts x periods x cost, with the cost in seconds per cell and forcing period. The cost of the
last run of each kind is stored next to the compiled programs. Without a stored cost the machine is assumed to be slow.
"""

import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from vijax.maps.map_dataset import SweepPlan
from vijax.runtime import validation
from vijax.runtime.compilation import cache_folder
from vijax.runtime.files import write_json
from vijax.runtime.public_api import public_api
from vijax.runtime.tiles import tile_devices

# Seconds and bytes above which a user should confirm a run before it starts.
_HOUR, _GIGABYTES = 3600.0, 10e9
# Default costs in seconds per cell and period, measured on two slow cores (rk4 with 1000 steps per period). With the
# smaller costs of a fast machine, a run of a whole night could start without confirmation.
_DEFAULT_COSTS = {"exact level": 2e-7, "exact inclined": 5e-7, "ode": 2e-5, "rk4": 2e-6}
# Cost in seconds per cell and period with an excitation other than the sine, for 64 samples per period.
_DRIVEN_COST = 4e-6
_RECORDED_COST = 1e-5  # cost where the impacts of cells are recorded
# Least duration [s] and least number of cells of a run for its cost to be stored: a shorter run does not represent a
# long one, and the slowest cell dominates the time of few cells.
_LEAST_TIMED, _LEAST_CELLS = 2.0, 256
_UNITS = (("days", 86400.0), ("h", 3600.0), ("min", 60.0), ("s", 1.0))
_FILE = "costs.json"


class Estimate(NamedTuple):
    """Time and memory that a run needs.

    Attributes:
        cells: Number of simulations.
        size: Bytes of the map, at most.
        seconds: Approximate duration [s].
    """

    cells: int
    size: float
    seconds: float

    @property
    def needs_confirmation(self) -> bool:
        """Whether a user should confirm the run before it starts: more than an hour, or more than 10 GB."""
        return self.seconds > _HOUR or self.size > _GIGABYTES

    def __str__(self) -> str:
        unit, length = next((row for row in _UNITS if self.seconds >= row[1]), _UNITS[-1])
        return (
            f"{self.cells:,} cells, up to {validation.gigabytes(self.size)}, about {self.seconds / length:,.2g} {unit}"
        )


@public_api
def estimate_runs(*plans: SweepPlan) -> Estimate:
    """Estimate the total duration and size of runs of these plans."""
    costs = _stored_costs()
    return Estimate(
        sum(plan.count * plan.starts for plan in plans),
        sum(plan.size for plan in plans),
        sum(
            plan.count * plan.starts * _periods(plan) * costs.get(_run_kind(plan), _default_cost(plan))
            for plan in plans
        ),
    )


@public_api
def estimate_recorded_run(cells: int, periods: int, size: float) -> Estimate:
    """Estimate a run that records the impacts of its cells: points of an orbit diagram, samples of a survey."""
    return Estimate(cells, size, cells * periods * _RECORDED_COST)


class CostMeter:
    """A progress callback that forwards each call, and measures the cost of the run.

    The time before the first completed cells is excluded, because programs are compiled then.
    """

    def __init__(self, notify: Callable[[int, int], None]):
        self._notify = notify
        self._steps: list[tuple[int, float]] = []

    def __call__(self, done: int, total: int) -> None:
        """Forward the number of completed cells and their total."""
        # A call that only changes the total, as during refinement, is not recorded as a step.
        if not self._steps or done > self._steps[-1][0]:
            self._steps.append((done, time.perf_counter()))
        self._notify(done, total)

    def store_cost(self, plan: SweepPlan) -> None:
        """Store the cost of the run next to the compiled programs, if the run was long enough to measure it."""
        if len(self._steps) < 3:
            return
        # The first entry is the call before any cell is done; programs are compiled until the second.
        (first, began), (last, ended) = self._steps[1], self._steps[-1]
        file = _file()
        if file is not None and ended - began >= _LEAST_TIMED and last - first >= _LEAST_CELLS:
            # Seconds per start of a cell and per requested forcing period, although many cells end after fewer periods:
            # the estimate of the next run uses the same definition.
            cost = (ended - began) / ((last - first) * plan.starts * _periods(plan))
            with suppress(OSError):  # the folder may be read-only or full; the run must not fail for it
                file.parent.mkdir(parents=True, exist_ok=True)
                write_json(_stored_costs() | {_run_kind(plan): cost}, file)


def _periods(plan: SweepPlan) -> int:
    return plan.settings.periods + plan.settings.transient


def _level(plan: SweepPlan) -> str:
    return "inclined" if plan.cells.quantities["gamma"].values.any() else "level"


def _run_kind(plan: SweepPlan) -> str:
    """Return the kind of a run; runs of one kind share one stored cost."""
    settings = plan.settings
    # The kind includes number and model of the devices, because machines may share a folder of compiled programs.
    devices = f"{len(tile_devices())} {tile_devices()[0].device_kind}"
    driven = "" if settings.excitation is None else "driven "
    return f"{driven}{settings.method} {settings.until} {settings.dtype} {_level(plan)} {devices}"


def _default_cost(plan: SweepPlan) -> float:
    """Return the cost that is assumed where none is stored."""
    method = plan.settings.method
    if plan.settings.excitation is not None:
        return _DRIVEN_COST
    return _DEFAULT_COSTS[f"exact {_level(plan)}" if method == "exact" else method]


def _file() -> Path | None:
    folder = cache_folder.program_folder()
    return None if folder is None else folder / _FILE


def _stored_costs() -> dict[str, float]:
    """Return the stored costs; empty if the file is missing, not trusted or broken."""
    file = _file()
    content = None if file is None else cache_folder.read(file)
    try:
        stored = {} if content is None else json.loads(content)
    except ValueError:
        return {}
    entries = stored.items() if isinstance(stored, dict) else ()
    # Other entries, edited by hand or of other versions, are ignored.
    return {kind: cost for kind, cost in entries if isinstance(cost, float) and 0 < cost < math.inf}
