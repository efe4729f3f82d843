"""What the process of a command does: bad input is one line, warnings are, and every end has its exit code.

A page is one `door`, one run under `progress` and one `closing.finish`.
"""

import gc
import io
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any, NoReturn

import click

from vijax.cli import signals
from vijax.runtime.pages import see

if TYPE_CHECKING:
    from vijax.planes.estimate import Estimate


# XLA takes this from its environment alone, which a library leaves as it is. Without it LLVM makes one long piece of
# code of a loop over 64 lanes, which takes longer to compile, and a plane a twentieth longer to run.
_ROLLED = "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling"


@contextmanager
def door() -> Iterator[None]:
    """Turn an error within into one line and exit code 2: bad input, before anything runs. A run may begin after it."""
    try:
        yield
    except (ValueError, TypeError, OSError, ImportError) as error:
        raise click.UsageError(str(error)) from None
    signals.begin_run()


def agree(expected: "Estimate", yes: bool) -> None:
    """Ask whether a long run is meant, or refuse it where nobody can answer."""
    if not expected.long or yes:
        return
    if not sys.stdin.isatty():
        raise ValueError(
            see("studies", f"yes must be given beyond an hour or 10 GB; got {expected}; add --yes, or ask for less")
        )
    click.confirm(f"{expected}: begin?", abort=True, err=True)


def import_beside(module: str) -> None:
    """Import what will be wanted at the end while XLA compiles or loads, which needs no Python."""
    threading.Thread(target=import_module, args=(module,), daemon=True).start()


def run(command: click.Command, arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code, with which `leave` ends the process.

    It is 0; 1 if what is to be written could not be, or `doctor` found a wrong number; 2 after bad input, when nothing
    was run; 130 after Ctrl-C and 143 after SIGTERM.
    """
    _open_streams()
    with signals.handled():
        try:
            with _compiler_told(), _warnings_told():
                return command.main(arguments, standalone_mode=False) or 0
        except click.ClickException as error:
            click.echo(f"error: {error.format_message()}", err=True)
            return 2
        except (click.Abort, KeyboardInterrupt) as error:
            cause = error.__cause__ or error
            click.echo(f"stopped; {_kept(cause)}", err=True)
            return 143 if isinstance(cause, signals.Terminated) else 130
        except OSError as error:
            where = f" ({error.filename})" if error.filename else ""
            click.echo(f"error: {error.strerror or error}{where}; {_kept(error)}", err=True)
            return 1


def stop(note: str) -> NoReturn:
    """End a run whose Ctrl-C, or SIGTERM, was caught to keep its results until then; the note says what is kept."""
    error = signals.stopped()
    error.add_note(note)
    raise error


def command(main: Callable[[], int]) -> NoReturn:
    """Run what is the whole process, and end the process with the exit code that it returns."""
    signals.own_process()
    leave(main())


def leave(code: int) -> NoReturn:
    """End the process with the exit code of `run`, at once where the run came to no end.

    A compiled call that is under way then cannot be stopped, and leaving as Python does would wait for it.
    """
    if code == 0:
        signals.ignore()
    if code in (0, 2):
        # What is left goes back to the system, with the process: to look through all of it first takes a third of a
        # second where programs were traced.
        gc.freeze()
        sys.exit(code)
    os._exit(code)


def _open_streams() -> None:
    """Open the standard streams that are closed, on the null device, and let none of them fail at a character.

    A file that is opened while descriptor 2 is closed becomes descriptor 2, and what a library writes to the standard
    error goes into the file.
    """
    descriptor = os.open(os.devnull, os.O_RDWR)
    while descriptor <= 2:
        os.set_inheritable(descriptor, True)  # processes that this one starts need it, too
        descriptor = os.dup(descriptor)
    os.close(descriptor)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, open until the process ends
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # what a terminal cannot show must not end a finished run


@contextmanager
def _compiler_told() -> Iterator[None]:
    """Have XLA leave loops of lanes as they are, unless its environment says something of the kind already."""
    said = os.environ.get("XLA_FLAGS")
    if "xla_backend_extra_options" not in (said or ""):
        os.environ["XLA_FLAGS"] = f"{said or ''} {_ROLLED}".strip()
    try:
        yield
    finally:
        os.environ.pop("XLA_FLAGS")
        if said is not None:
            os.environ["XLA_FLAGS"] = said


@contextmanager
def _warnings_told() -> Iterator[None]:
    """Turn what vijax warns of into one line, told once."""
    from tqdm import tqdm

    told: set[str] = set()

    def tell(message: Warning | str, *_: Any, **__: Any) -> None:
        if str(message) not in told:
            told.add(str(message))
            tqdm.write(f"warning: {message}", file=sys.stderr)  # beside a bar that may be there

    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=UserWarning, module="vijax")
        warnings.showwarning = tell
        yield


def _kept(error: BaseException) -> str:
    """Say what became of the files of a run that came to no end."""
    return " ".join(getattr(error, "__notes__", ["nothing half-written is left"]))
