"""Handling of Ctrl-C and SIGTERM in the process of a command, and their exit codes.

Before a run begins, nothing is written, and a signal ends the process at once. A signal handler that raises an
exception would be unreliable during imports: they run hundreds of callbacks of the interpreter (of weak references, for
example), and Python only prints an exception that such a callback raises. During a run a signal raises an exception, so
that the run keeps its results. If this happens in such a callback, a timer raises the exception again.
"""

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, ClassVar, NoReturn

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
STOPPED = "stopped; nothing half-written is left"

_REPEATED = 1.0  # a signal within this number of seconds after one that raised an exception is ignored
_AGAIN = 0.01  # seconds until an exception lost in a callback is raised again, after the callback has ended


class Terminated(KeyboardInterrupt):
    """The exception that SIGTERM raises during a run; Ctrl-C raises KeyboardInterrupt."""


class SignalState:
    """State of the signal handlers of this process.

    Attributes:
        owned: Whether the process runs nothing but the command, so that a signal may end the process at once.
        running: Whether a run has begun.
        last: Time on the monotonic clock when a signal last raised an exception.
        received: Numbers of the signals that raised an exception, the latest last.
    """

    owned = False
    running = False
    last = -_REPEATED
    received: ClassVar[list[int]] = []


def own_signals() -> None:
    """Let a signal end this process at once until a run begins; for a process that runs nothing but a command."""
    SignalState.owned = True
    _install()


@contextmanager
def handled() -> Iterator[None]:
    """Handle signals while a command runs; afterwards restore the earlier handlers, unless `SignalState.owned`."""
    if not _in_main_thread():
        yield
        return
    before, hook = {number: signal.getsignal(number) for number in CODES}, sys.unraisablehook
    SignalState.running, SignalState.last = False, -_REPEATED
    SignalState.received.clear()
    _install()
    sys.unraisablehook = _reraising_hook(hook)
    try:
        yield
    finally:
        SignalState.running = False
        sys.unraisablehook = hook
        if not SignalState.owned:
            for number, handler in before.items():
                signal.signal(number, handler)


def begin_run() -> None:
    """Mark the begin of a run: from now on, signals raise an exception instead of ending the process."""
    SignalState.running = True


def ignore() -> None:
    """Ignore signals from now on, because the work is finished and the process is about to end."""
    if _in_main_thread():
        for number in CODES:
            signal.signal(number, signal.SIG_IGN)


def stopped() -> KeyboardInterrupt:
    """Return a new exception for the last received signal: `Terminated` for SIGTERM, else KeyboardInterrupt."""
    return Terminated() if SignalState.received[-1:] == [signal.SIGTERM] else KeyboardInterrupt()


def _in_main_thread() -> bool:
    import threading

    return threading.current_thread() is threading.main_thread()


def _install() -> None:
    """Install the handler of Ctrl-C and SIGTERM, except for signals that the parent process has set to be ignored."""
    for number in CODES:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)


def _handle(number: int, frame: FrameType | None) -> None:
    if SignalState.owned and not SignalState.running:
        _quit(number)
    if time.monotonic() - SignalState.last >= _REPEATED:
        _raise(number)


def _quit(number: int) -> NoReturn:
    with suppress(OSError):
        os.write(2, f"{STOPPED}\n".encode())  # not by sys.stderr, which the signal may have interrupted
    os._exit(CODES[signal.Signals(number)])


def _raise(number: int) -> NoReturn:
    SignalState.last = time.monotonic()
    SignalState.received.append(number)
    raise stopped()


def _reraising_hook(hook: Any) -> Any:
    """Return a replacement of `sys.unraisablehook`: a timer raises the lost exception of a signal again.

    All other exceptions are passed to the original `hook`.
    """

    def dropped(unraisable: Any) -> None:
        if unraisable.exc_type is None or not issubclass(unraisable.exc_type, KeyboardInterrupt):
            hook(unraisable)
            return
        number = SignalState.received[-1] if SignalState.received else signal.SIGINT
        signal.signal(signal.SIGALRM, lambda *_: _raise(number))
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)

    return dropped
