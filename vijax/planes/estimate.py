"""How long a run takes and how much it makes, said before it begins, from what this machine did lately.

Wherever compiled programs are kept, so are the paces of the last runs: seconds of a cell and a period asked for, by
kind of run. A machine that has none yet is taken for a slow one.
"""

import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from vijax.planes.dataset import SweepPlan
from vijax.runtime import cache_folder, checks
from vijax.runtime.context import door
from vijax.runtime.files import write_json
from vijax.runtime.tiles import places

# Seconds and bytes from which on somebody should agree before a run begins.
_HOUR, _GIGABYTES = 3600.0, 10e9
# Seconds of a cell and a period where no pace was kept, by two slow cores; of rk4 at 1000 steps. With smaller ones a
# run that takes the night begins unasked.
_SLOW = {"exact level": 2e-7, "exact inclined": 5e-7, "ode": 2e-5, "rk4": 2e-6}
# The same where the excitation is not the sine, of 64 samples a period.
_DRIVEN = 4e-6
_RECORDED = 1e-5  # The same where the impacts of cells are recorded.
# Seconds that a run lasts, and cells that it has, for its pace to be kept: a shorter one says little of a long one, and
# few cells take as long as the slowest of them.
_LEAST_TIMED, _LEAST_CELLS = 2.0, 256
_UNITS = (("days", 86400.0), ("h", 3600.0), ("min", 60.0), ("s", 1.0))
_FILE = "paces.json"


class Estimate(NamedTuple):
    """What a run asks of the machine.

    Attributes:
        cells: Simulations.
        size: Bytes of the map, at most.
        seconds: That it takes, about.
    """

    cells: int
    size: float
    seconds: float

    @property
    def long(self) -> bool:
        """Say whether somebody should agree before it begins: an hour, or 10 GB."""
        return self.seconds > _HOUR or self.size > _GIGABYTES

    def __str__(self) -> str:
        unit, length = next((row for row in _UNITS if self.seconds >= row[1]), _UNITS[-1])
        return f"{self.cells:,} cells, up to {checks.gigabytes(self.size)}, about {self.seconds / length:,.2g} {unit}"


@door
def of(*plans: SweepPlan) -> Estimate:
    """Estimate what runs of such plans take together."""
    kept = _paces()
    return Estimate(
        sum(plan.count * plan.starts for plan in plans),
        sum(plan.size for plan in plans),
        sum(plan.count * plan.starts * _periods(plan) * kept.get(_kind(plan), _slow(plan)) for plan in plans),
    )


@door
def of_recorded(cells: int, periods: int, size: float) -> Estimate:
    """Estimate what cells take whose impacts are recorded: points of an orbit diagram, balls of a survey."""
    return Estimate(cells, size, cells * periods * _RECORDED)


class Watch:
    """Progress that is passed on, and timed from the first cells that are done: until then programs are compiled."""

    def __init__(self, tell: Callable[[int, int], None]):
        self._tell = tell
        self._seen: list[tuple[int, float]] = []

    def __call__(self, done: int, total: int) -> None:
        """Pass on how many cells are done, of how many."""
        if not self._seen or done > self._seen[-1][0]:
            self._seen.append((done, time.perf_counter()))
        self._tell(done, total)

    def keep(self, planned: SweepPlan) -> None:
        """Keep the pace, if it is one, beside compiled programs."""
        if len(self._seen) < 3:
            return
        # In the first entry nothing is done yet, and programs are compiled until the second.
        (first, began), (last, ended) = self._seen[1], self._seen[-1]
        file = _file()
        if file is not None and ended - began >= _LEAST_TIMED and last - first >= _LEAST_CELLS:
            pace = (ended - began) / ((last - first) * planned.starts * _periods(planned))
            with suppress(OSError):  # a folder may be closed or full; what was run is worth more than how fast it ran
                file.parent.mkdir(parents=True, exist_ok=True)
                write_json(_paces() | {_kind(planned): pace}, file)


def _periods(planned: SweepPlan) -> int:
    return planned.settings.periods + planned.settings.transient


def _level(planned: SweepPlan) -> str:
    return "inclined" if planned.cells.quantities["gamma"].values.any() else "level"


def _kind(planned: SweepPlan) -> str:
    """Name the kind of a run: those of one kind keep one pace."""
    settings = planned.settings
    devices = f"{len(places())} {places()[0].device_kind}"
    driven = "" if settings.excitation is None else "driven "
    return f"{driven}{settings.method} {settings.until} {settings.dtype} {_level(planned)} {devices}"


def _slow(planned: SweepPlan) -> float:
    method = planned.settings.method
    if planned.settings.excitation is not None:
        return _DRIVEN
    return _SLOW[f"exact {_level(planned)}" if method == "exact" else method]


def _file() -> Path | None:
    folder = cache_folder.kept()
    return None if folder is None else folder / _FILE


def _paces() -> dict[str, float]:
    """Return the paces that were kept; none if the file is missing, not trusted or broken."""
    file = _file()
    content = None if file is None else cache_folder.read(file)
    try:
        kept = {} if content is None else json.loads(content)
    except ValueError:
        return {}
    numbers = kept.items() if isinstance(kept, dict) else ()
    return {kind: pace for kind, pace in numbers if isinstance(pace, float) and 0 < pace < math.inf}
