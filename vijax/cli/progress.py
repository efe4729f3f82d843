"""A progress bar, and what stands before it while nothing is done yet."""

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from vijax.cli.closing import pace

T = TypeVar("T")

_WAITING = logging.getLogger("vijax.waiting")
_MANY = 10_000  # From so many on a bar counts by thousands.


@contextmanager
def progress(total: int, unit: str = "cells") -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar that says what is being waited for, as the callback (done, in all) that runs take."""
    from tqdm import tqdm

    with tqdm(total=total, desc="starting", unit=unit, unit_scale=total >= _MANY) as bar, _told_of_waiting(bar):

        def show(done: int, total: int) -> None:
            if done:
                bar.set_description(unit, refresh=False)
            bar.total = total
            bar.update(done - bar.n)

        yield show


def counted(total: int, run: Callable[[Callable[[int, int], None]], T]) -> tuple[T, str]:
    """Run under a progress bar that counts cells; return what was found and how fast, in words."""
    # Numbers of cells done; at first those that a store held already.
    told: list[int] = []

    with progress(total) as show:

        def tell(done: int, total: int) -> None:
            told.append(done)
            show(done, total)

        began = time.perf_counter()
        found = run(tell)
    said = pace(told[-1] - told[0], time.perf_counter() - began)
    return found, f"{said}, {told[0]:,} were there" if told[0] else said


def waiting(what: str) -> None:
    """Say at the progress bar what is being waited for."""
    _WAITING.info(what)


@contextmanager
def _told_of_waiting(bar: Any) -> Iterator[None]:
    """Show before the bar what vijax says it waits for; its clock goes on while nothing is done."""
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
