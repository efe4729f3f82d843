"""Python's collector of garbage, which looks seldom while a public function runs.

A program that is traced is hundreds of thousands of records that stay. Python looks among new objects after every 700
of them, among all after some 70,000, and finds nothing: of the tests' processor time a sixth went there. Memory that
nothing refers to is given back at once as always; only circles wait, for at most so many objects.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

SELDOM = 200_000, 20, 20  # new objects before it looks among them; the last two are looks of the generation before

_lock = Lock()
_inside = 0
_before = gc.get_threshold()


def public_function_runs() -> bool:
    """Say whether one does, in any thread."""
    return _inside > 0


@contextmanager
def seldom_collected() -> Iterator[None]:
    """Let the collector look seldom; as the program around has it again once the last thread is out."""
    global _inside, _before
    with _lock:
        if not _inside:
            _before = gc.get_threshold()
            # Where a program has turned the collector off (0) or looks more seldom itself, that stands.
            if 0 < _before[0] < SELDOM[0]:
                gc.set_threshold(*SELDOM)
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if not _inside:
                gc.set_threshold(*_before)
