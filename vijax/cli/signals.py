"""What Ctrl-C and SIGTERM do to the process of a command, and which exit code they give it.

Until a run begins nothing is written, and a signal ends the process at once. An exception would not: where it is raised
in a callback of the interpreter, of which imports call hundreds, Python prints it and goes on. Once a run has begun a
signal raises an exception, so that the run keeps its results; an exception that Python drops is raised again.
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

_REPEATED = 1.0  # seconds in which a further signal is taken for the one that is being handled
_AGAIN = 0.01  # seconds after which a dropped exception is raised again: outside of the callback that dropped it


class Terminated(KeyboardInterrupt):
    """Raised by SIGTERM."""


class SignalState:
    """What the handlers know of this process.

    Attributes:
        owned: Whether it is the process of a command alone, which a signal may end at once.
        running: Whether a run has begun.
        last: When a signal last raised an exception, by the monotonic clock.
        received: The signals that raised one.
    """

    owned = False
    running = False
    last = -_REPEATED
    received: ClassVar[list[int]] = []


def own_process() -> None:
    """End this process at a signal, until a run begins. To be called first, by what is the whole process."""
    SignalState.owned = True
    _install()


@contextmanager
def handled() -> Iterator[None]:
    """Handle signals while a command runs; afterwards as before, unless the process is owned."""
    if not _in_main_thread():
        yield
        return
    before, hook = {number: signal.getsignal(number) for number in CODES}, sys.unraisablehook
    SignalState.running, SignalState.last = False, -_REPEATED
    SignalState.received.clear()
    _install()
    sys.unraisablehook = _raised_again(hook)
    try:
        yield
    finally:
        SignalState.running = False
        sys.unraisablehook = hook
        if not SignalState.owned:
            for number, handler in before.items():
                signal.signal(number, handler)


def begin_run() -> None:
    """Raise an exception at a signal from now on."""
    SignalState.running = True


def ignore() -> None:
    """Ignore signals: all is done, and the process ends."""
    if _in_main_thread():
        for number in CODES:
            signal.signal(number, signal.SIG_IGN)


def stopped() -> KeyboardInterrupt:
    """Return the exception of the signal that came last."""
    return Terminated() if SignalState.received[-1:] == [signal.SIGTERM] else KeyboardInterrupt()


def _in_main_thread() -> bool:
    import threading

    return threading.current_thread() is threading.main_thread()


def _install() -> None:
    """Install the handler, except for a signal that whoever started this process has it ignore."""
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
        os.write(2, f"{STOPPED}\n".encode())  # sys.stderr may be in the middle of a line
    os._exit(CODES[signal.Signals(number)])


def _raise(number: int) -> NoReturn:
    SignalState.last = time.monotonic()
    SignalState.received.append(number)
    raise stopped()


def _raised_again(hook: Any) -> Any:
    """Return a hook for dropped exceptions that lets the alarm raise those of signals again."""

    def dropped(unraisable: Any) -> None:
        if unraisable.exc_type is None or not issubclass(unraisable.exc_type, KeyboardInterrupt):
            hook(unraisable)
            return
        number = SignalState.received[-1] if SignalState.received else signal.SIGINT
        signal.signal(signal.SIGALRM, lambda *_: _raise(number))
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)

    return dropped
