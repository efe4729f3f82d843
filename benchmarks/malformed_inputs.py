"""Does every malformed call and command line produce one clear line that names the argument?

    python benchmarks/malformed_inputs.py                # both tables
    python benchmarks/malformed_inputs.py --only lines   # one of them: calls, lines
    python benchmarks/malformed_inputs.py --limit 20     # most seconds until an error [15]

The tables are in `malformed.py` and `malformed_lines.py`. Each case runs in a separate process, with a limit on time
and memory. A call's result is clear if it is an error of this package (or Python's own error for an unknown argument)
with one line that names the argument. A command line's result is clear if the exit code is 2 and the output is one line
that begins with "error: " and names the option. Every other case is listed with its result. Exit code 1 if more than
1 % of a table are unclear, or a case has no error at all.
"""

import argparse
import contextlib
import io
import multiprocessing
import os
import re
import resource
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path

from benchmarks import malformed, malformed_lines
from benchmarks.malformed import Case

TABLES: dict[str, Callable[[], Iterator[Case]]] = {"calls": malformed.calls, "lines": malformed_lines.lines}
MOST_UNCLEAR = 0.01
_MEMORY = 16  # GiB of address space, most of it never touched
_LONGEST = 400  # characters of a line that is readable at a glance
_PROJECT_FOLDERS = (Path(malformed.__file__).parent, Path(malformed.vijax.__file__).parent)
_REFUSALS = (ValueError, TypeError, OSError, ModuleNotFoundError)


def flaw_of_call(case: Case) -> str:
    """Return the flaw of a call's error; "" if the error is clear."""
    try:
        case.make()
    except _REFUSALS as error:
        folder = Path(traceback.extract_tb(error.__traceback__)[-1].filename).parent
        is_project_error = any(
            folder.is_relative_to(project_folder) for project_folder in _PROJECT_FOLDERS
        ) or "unexpected keyword argument" in str(error)
        return _unclear(case, str(error)) or (
            "" if is_project_error else f"{type(error).__name__} from {folder.name}: {error}"
        )
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "silent"


def flaw_of_line(case: Case) -> str:
    """Return the flaw of a command line's error; "" if the error is clear."""
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = case.make()
    except Exception as error:
        return f"traceback of {type(error).__name__}: {error}"
    message = err.getvalue().removesuffix("\n")
    if not code:
        return "silent"
    if code != 2 or out.getvalue() or not message.startswith("error: "):
        return f"exit code {code}: {message} {out.getvalue()}"
    return _unclear(case, message)


FLAWS = {"calls": flaw_of_call, "lines": flaw_of_line}


def _unclear(case: Case, message: str) -> str:
    if "\n" in message or len(message) > _LONGEST:
        return f"{message.count(chr(10)) + 1} lines of {len(message)} characters: {message}"
    missing = [name for name in case.names if not re.search(rf"(?<!\w)({_either(name)})(?!\w)", message)]
    return f"{', '.join(missing)} not named: {message}" if missing else ""


def _either(name: str) -> str:
    """Return a pattern of a name as an argument or, with hyphens, as an option."""
    return "|".join(map(re.escape, (name, name.replace("_", "-"))))


def _serve(table: str, ours: Connection) -> None:
    """Run the cases that arrive by number, in this separate process."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY << 30, _MEMORY << 30))
    # A call that is wrongly accepted writes here; XLA's messages about it are discarded.
    os.chdir(tempfile.mkdtemp())
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    cases = list(TABLES[table]())
    ours.send("")
    while True:
        ours.send(FLAWS[table](cases[ours.recv()]))


class CaseProcess:
    """A process that runs cases; it is replaced when a case hangs or ends it."""

    def __init__(self, table: str, limit: float):
        self._table, self._limit = table, limit
        self._begin()

    def _begin(self) -> None:
        self._ours, theirs = multiprocessing.Pipe()
        self._process = multiprocessing.get_context("spawn").Process(target=_serve, args=(self._table, theirs))
        self._process.start()
        theirs.close()
        self._ours.recv()

    def flaw(self, number: int) -> str:
        """Return the flaw of a case; "" if its error is clear."""
        self._ours.send(number)
        try:
            if self._ours.poll(self._limit):
                return self._ours.recv()
            flaw = f"hung: no answer in {self._limit:g} s"
        except EOFError:
            flaw = "died"
        self.end()
        self._begin()
        return flaw

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()


def run_table(table: str, limit: float) -> list[tuple[Case, str]]:
    """Run every case of a table; return each with its flaw."""
    process = CaseProcess(table, limit)
    try:
        return [(case, process.flaw(number)) for number, case in enumerate(TABLES[table]())]
    finally:
        process.end()


def main() -> int:
    """Run all cases; return 0 if at most 1 % of each table are unclear and every case has an error."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", choices=TABLES, help="one table")
    parser.add_argument("--limit", type=float, default=15, help="seconds until an error [15]")
    options = parser.parse_args()
    passed = True
    for table in TABLES if options.only is None else [options.only]:
        rows = run_table(table, options.limit)
        wrong = [(case, flaw) for case, flaw in rows if flaw]
        kinds = Counter(flaw.split(":")[0].split()[0] for _, flaw in wrong)
        print(f"{table}: {len(wrong)} of {len(rows)} malformed without a clear error ({len(wrong) / len(rows):.1%})")
        for case, flaw in wrong:
            print(f"    {case.text}: {' '.join(flaw.split())[:160]}")
        passed &= len(wrong) <= MOST_UNCLEAR * len(rows) and not kinds["silent"] and not kinds["hung"]
    return not passed


if __name__ == "__main__":
    sys.exit(main())
