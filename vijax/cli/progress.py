"""Progress bar of a run; until the first step is done, its description is the current stage, such as compilation."""

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from vijax.cli.closing import rate_text

T = TypeVar("T")

_WAITING = logging.getLogger("vijax.waiting")
_MANY = 10_000  # bars with at least this total write counts with a prefix, as 12.3k


@contextmanager
def progress(total: int, unit: str = "cells") -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar during the block; yield a function (done, total) that updates the bar."""
    from tqdm import tqdm

    with tqdm(total=total, desc="starting", unit=unit, unit_scale=total >= _MANY) as bar, _description_from_log(bar):

        def show(done: int, total: int) -> None:
            if done:
                bar.set_description(unit, refresh=False)
            bar.total = total
            bar.update(done - bar.n)

        yield show


def counted(total: int, run: Callable[[Callable[[int, int], None]], T]) -> tuple[T, str]:
    """Call `run` with a function that updates a progress bar of cells; return the result and a line with the rate.

    Args:
        total: Number of cells.
        run: Function that computes the cells and reports (done, total) to its argument.
    """
    # Reported numbers of finished cells; the first is the number of cells that a store contained before the run.
    done_counts: list[int] = []

    with progress(total) as show:

        def report(done: int, total: int) -> None:
            done_counts.append(done)
            show(done, total)

        began = time.perf_counter()
        result = run(report)
    rate = rate_text(done_counts[-1] - done_counts[0], time.perf_counter() - began)
    return result, f"{rate}, {done_counts[0]:,} already stored" if done_counts[0] else rate


def waiting(stage: str) -> None:
    """Set the description of the progress bar, if one is shown, to the current stage."""
    _WAITING.info(stage)


@contextmanager
def _description_from_log(bar: Any) -> Iterator[None]:
    """Show messages of the logger "vijax.waiting" as the bar's description, and redraw the elapsed time each second."""
    handler, ended = logging.Handler(), threading.Event()
    handler.emit = lambda record: bar.set_description(record.getMessage())  # type: ignore[method-assign]

    def tick() -> None:
        while not ended.wait(1.0):
            bar.refresh()

    level, propagate = _WAITING.level, _WAITING.propagate
    _WAITING.addHandler(handler)
    _WAITING.setLevel(logging.INFO)
    _WAITING.propagate = False  # the bar shows the message; other handlers must not repeat it
    clock = threading.Thread(target=tick, daemon=True)
    if sys.stderr.isatty():  # not in a log file, where every refresh would add a line
        clock.start()
    try:
        yield
    finally:
        ended.set()
        _WAITING.removeHandler(handler)
        _WAITING.setLevel(level)
        _WAITING.propagate = propagate
