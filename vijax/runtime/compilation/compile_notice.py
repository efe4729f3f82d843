"""Message on a terminal, printed once, if a call waits long for the compiler."""

import logging
import sys
import threading
from functools import cache

import jax

from vijax.runtime.garbage_collection import public_function_runs

NOTICE_DELAY = 2.0  # seconds of compilation before the message
# Events of JAX at the start and at the end of a compilation.
_BEGINS, _ENDS = "/jax/compilation_cache/compile_requests_use_cache", "/jax/core/compile/backend_compile_duration"
_MESSAGE = "vijax: compiling; the first call takes some seconds, later calls reuse the program"

_lock = threading.Lock()
# One timer per compiling thread.
_thread = threading.local()
_printed = False


@cache
def notify_slow_compile() -> None:
    """From now on print the message if a compilation takes more than NOTICE_DELAY and no progress bar reports it.

    The message is printed only within a public function, and only if stderr is a terminal.
    """
    if sys.stderr is not None and sys.stderr.isatty():
        jax.monitoring.register_event_listener(_begin)
        jax.monitoring.register_event_duration_secs_listener(_end)


def _begin(event: str, **_: object) -> None:
    if event == _BEGINS and public_function_runs() and not _printed:
        _thread.timer = threading.Timer(NOTICE_DELAY, _print_notice)
        # A daemon does not delay the end of the process.
        _thread.timer.daemon = True
        _thread.timer.start()


def _end(event: str, duration_secs: float, **_: object) -> None:
    timer = getattr(_thread, "timer", None)
    if event == _ENDS and timer is not None:
        timer.cancel()


def _print_notice() -> None:
    global _printed
    with _lock:
        # A progress bar that reports the wait has a handler on this logger.
        if _printed or logging.getLogger("vijax.waiting").handlers:
            return
        _printed = True
    print(_MESSAGE, file=sys.stderr, flush=True)
