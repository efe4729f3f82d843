"""Says, once and only to somebody who watches, that it is the compiler that is being waited for."""

import logging
import sys
import threading
from functools import cache

import jax

from vijax.runtime.garbage import public_function_runs

PATIENCE = 2.0  # seconds after which a wait is worth a line
# What JAX says of itself as it begins to compile a program, and when it has compiled it.
_BEGINS, _ENDS = "/jax/compilation_cache/compile_requests_use_cache", "/jax/core/compile/backend_compile_duration"
_LINE = "vijax: compiling, which takes seconds the first time; it is kept for the next"

_lock = threading.Lock()
_own = threading.local()
_said = False


@cache
def tell_of_compilation() -> None:
    """Say so from now on where a public function waits long, stderr is a terminal, and no bar says it."""
    if sys.stderr is not None and sys.stderr.isatty():
        jax.monitoring.register_event_listener(_begin)
        jax.monitoring.register_event_duration_secs_listener(_end)


def _begin(event: str, **_: object) -> None:
    if event == _BEGINS and public_function_runs() and not _said:
        _own.timer = threading.Timer(PATIENCE, _say)
        _own.timer.daemon = True
        _own.timer.start()


def _end(event: str, duration_secs: float, **_: object) -> None:
    timer = getattr(_own, "timer", None)
    if event == _ENDS and timer is not None:
        timer.cancel()


def _say() -> None:
    global _said
    with _lock:
        # A bar that shows what a run waits for listens to this logger.
        if _said or logging.getLogger("vijax.waiting").handlers:
            return
        _said = True
    print(_LINE, file=sys.stderr, flush=True)
