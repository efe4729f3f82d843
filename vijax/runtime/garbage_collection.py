"""Less frequent garbage collection while a public function runs.

A traced program consists of hundreds of thousands of permanent records. By default Python searches for cycles after
every 700 new objects, and in all objects after about 70,000, without a result: a sixth of the tests' processor time.
Objects without references are still freed at once; only reference cycles wait, for at most the thresholds below.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

RELAXED_THRESHOLDS = 200_000, 20, 20  # number of new objects, then of collections per generation, that trigger one

_lock = Lock()
_inside = 0
_before = gc.get_threshold()


def public_function_runs() -> bool:
    """Return True if a public function runs in any thread."""
    return _inside > 0


@contextmanager
def infrequent_collection() -> Iterator[None]:
    """Raise the collector's thresholds while the block runs; the last thread that leaves restores the program's own."""
    global _inside, _before
    with _lock:
        if not _inside:
            # The first thread that enters stores the program's thresholds, and the last one that leaves restores them.
            _before = gc.get_threshold()
            # If the program has disabled the collector (0), or uses a larger threshold itself, nothing is changed.
            if 0 < _before[0] < RELAXED_THRESHOLDS[0]:
                gc.set_threshold(*RELAXED_THRESHOLDS)
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if not _inside:
                gc.set_threshold(*_before)
