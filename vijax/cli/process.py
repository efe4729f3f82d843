"""The process of a command: one-line errors and warnings, confirmation of long runs, and exit codes.

A subcommand consists of argument checks within `usage_errors`, one run under `progress`, and one `closing.finish`.
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
from vijax.runtime.doc_pages import see

if TYPE_CHECKING:
    from vijax.maps.execution.estimate import Estimate


# The command sets this XLA option in the environment, its only source; a library must not change the environment.
# Without the option LLVM unrolls loops over 64 lanes, so that compilation takes longer and a plane runs 5 % longer.
_ROLLED = "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling"


@contextmanager
def usage_errors() -> Iterator[None]:
    """Convert errors of a block of argument checks to a usage error: one line, and exit code 2.

    A block without error is the end of the checks: from then on, Ctrl-C and SIGTERM are handled as during a run.
    """
    try:
        yield
    except (ValueError, TypeError, OSError, ImportError) as error:
        raise click.UsageError(str(error)) from None
    signals.begin_run()


def agree(expected: "Estimate", yes: bool) -> None:
    """Request confirmation of a run over an hour or 10 GB, unless `yes`; raise ValueError if there is no terminal."""
    if not expected.needs_confirmation or yes:
        return
    if not sys.stdin.isatty():
        raise ValueError(
            see("studies", f"yes must be given beyond an hour or 10 GB; got {expected}; add --yes, or ask for less")
        )
    click.confirm(f"{expected}: begin?", abort=True, err=True)


def import_in_background(module: str) -> None:
    """Import a module, needed at the end of the run, in a thread while XLA compiles without Python's lock."""
    threading.Thread(target=import_module, args=(module,), daemon=True).start()


def run(command: click.Command, arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code, which `leave` expects.

    0: success. 1: an output could not be written, or `doctor` computed a wrong number. 2: the input is invalid, and
    nothing was run. 130: Ctrl-C. 143: SIGTERM.
    """
    _open_streams()
    with signals.handled():
        try:
            with _xla_option(), _single_line_warnings():
                return command.main(arguments, standalone_mode=False) or 0
        except click.ClickException as error:
            click.echo(f"error: {error.format_message()}", err=True)
            return 2
        except (click.Abort, KeyboardInterrupt) as error:
            cause = error.__cause__ or error
            click.echo(f"stopped; {_file_note(cause)}", err=True)
            return 143 if isinstance(cause, signals.Terminated) else 130
        except OSError as error:
            where = f" ({error.filename})" if error.filename else ""
            click.echo(f"error: {error.strerror or error}{where}; {_file_note(error)}", err=True)
            return 1


def stop(note: str) -> NoReturn:
    """Raise the exception of the last Ctrl-C or SIGTERM, which the run caught to keep its partial results.

    `note` describes the partial results in the message of the command.
    """
    error = signals.stopped()
    error.add_note(note)
    raise error


def command(main: Callable[[], int]) -> NoReturn:
    """Run `main` and end the process with the exit code that it returns."""
    signals.own_signals()
    leave(main())


def leave(code: int) -> NoReturn:
    """End the process with the exit code of `run`.

    If the run was stopped or failed (a code other than 0 and 2), the process ends at once by `os._exit`, because a
    regular exit of Python would wait for a compiled call in progress, which cannot be stopped.
    """
    if code == 0:
        signals.ignore()
    if code in (0, 2):
        # Skip the last garbage collection, which takes a third of a second after JAX has traced; the system frees the
        # memory of an ended process anyway.
        gc.freeze()
        sys.exit(code)
    os._exit(code)


def _open_streams() -> None:
    """Open closed standard streams on the null device, and escape printed characters that a stream cannot encode.

    If descriptor 2 is closed, the next file opened becomes descriptor 2, and messages of libraries to the standard
    error would be written into that file.
    """
    descriptor = os.open(os.devnull, os.O_RDWR)
    while descriptor <= 2:
        os.set_inheritable(descriptor, True)  # child processes inherit the standard streams
        descriptor = os.dup(descriptor)
    os.close(descriptor)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, open until the process ends
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # an unencodable character must not fail a finished run


@contextmanager
def _xla_option() -> Iterator[None]:
    """Set XLA's option against unrolled loops during the block, unless the user's XLA_FLAGS set backend options."""
    flags = os.environ.get("XLA_FLAGS")
    if "xla_backend_extra_options" not in (flags or ""):
        os.environ["XLA_FLAGS"] = f"{flags or ''} {_ROLLED}".strip()
    try:
        yield
    finally:
        os.environ.pop("XLA_FLAGS")
        if flags is not None:
            os.environ["XLA_FLAGS"] = flags


@contextmanager
def _single_line_warnings() -> Iterator[None]:
    """Print each distinct warning of vijax once, as one line."""
    from tqdm import tqdm

    printed: set[str] = set()

    def print_once(message: Warning | str, *_: Any, **__: Any) -> None:
        if str(message) not in printed:
            printed.add(str(message))
            tqdm.write(f"warning: {message}", file=sys.stderr)  # keeps a progress bar below the printed line

    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=UserWarning, module="vijax")
        warnings.showwarning = print_once
        yield


def _file_note(error: BaseException) -> str:
    """Return the notes of the error on the written files; by default, that no half-written file is left."""
    return " ".join(getattr(error, "__notes__", ["nothing half-written is left"]))
