"""Is every malformed call and command line met by one clear line that names the argument?

    python benchmarks/doors.py                # both tables
    python benchmarks/doors.py --only lines   # one of them: calls, lines
    python benchmarks/doors.py --limit 20     # seconds that a door may take to refuse [15]

The tables are those of `malformed.py` and `malformed_lines.py`. Each case is tried in a process that is ended when it
takes too long and may hold so much memory and no more. Clear is, of a call: an error of this package (or Python's own,
of an argument that is unknown), in one line that names the argument. Of a command line: exit code 2, one line that
begins with "error: " and names the option, nothing else. Every case that was not met so is listed with what came in its
place. Exit code 1 if more than 1 % of a table are, or one was met with silence.
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
_MEMORY = 16  # GiB of addresses, most of which nobody touches
_LONGEST = 400  # characters of a line that can be read at a glance
_HERE = (Path(malformed.__file__).parent, Path(malformed.vijax.__file__).parent)
_REFUSALS = (ValueError, TypeError, OSError, ModuleNotFoundError)


def called(case: Case) -> str:
    """Say what is wrong with how a call was met; nothing if all is well."""
    try:
        case.make()
    except _REFUSALS as error:
        where = Path(traceback.extract_tb(error.__traceback__)[-1].filename).parent
        ours = any(where.is_relative_to(home) for home in _HERE) or "unexpected keyword argument" in str(error)
        return _unclear(case, str(error)) or ("" if ours else f"{type(error).__name__} from {where.name}: {error}")
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "silent"


def told(case: Case) -> str:
    """Say what is wrong with how a command line was met; nothing if all is well."""
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = case.make()
    except Exception as error:
        return f"traceback of {type(error).__name__}: {error}"
    said = err.getvalue().removesuffix("\n")
    if not code:
        return "silent"
    if code != 2 or out.getvalue() or not said.startswith("error: "):
        return f"exit code {code}: {said} {out.getvalue()}"
    return _unclear(case, said)


JUDGES = {"calls": called, "lines": told}


def _unclear(case: Case, said: str) -> str:
    if "\n" in said or len(said) > _LONGEST:
        return f"{said.count(chr(10)) + 1} lines of {len(said)} characters: {said}"
    missing = [name for name in case.names if not re.search(rf"(?<!\w)({_either(name)})(?!\w)", said)]
    return f"{', '.join(missing)} not named: {said}" if missing else ""


def _either(name: str) -> str:
    """Match a name as an argument has it or as an option, with hyphens."""
    return "|".join(map(re.escape, (name, name.replace("_", "-"))))


def _serve(table: str, ours: Connection) -> None:
    """Try the cases whose numbers come in, in a process of its own."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY << 30, _MEMORY << 30))
    # What a door lets through writes here, and what XLA says of it is not asked for.
    os.chdir(tempfile.mkdtemp())
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    cases = list(TABLES[table]())
    ours.send("")
    while True:
        ours.send(JUDGES[table](cases[ours.recv()]))


class Server:
    """A process that tries cases, and its successor where one has hung or died."""

    def __init__(self, table: str, limit: float):
        self._table, self._limit = table, limit
        self._begin()

    def _begin(self) -> None:
        self._ours, theirs = multiprocessing.Pipe()
        self._process = multiprocessing.get_context("spawn").Process(target=_serve, args=(self._table, theirs))
        self._process.start()
        theirs.close()
        self._ours.recv()

    def verdict(self, number: int) -> str:
        """Say what is wrong with how a case was met; nothing if all is well."""
        self._ours.send(number)
        try:
            if self._ours.poll(self._limit):
                return self._ours.recv()
            found = f"hung: no answer in {self._limit:g} s"
        except EOFError:
            found = "died"
        self.end()
        self._begin()
        return found

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()


def tried(table: str, limit: float) -> list[tuple[Case, str]]:
    """Try every case of a table; give each with what is wrong with how it was met."""
    server = Server(table, limit)
    try:
        return [(case, server.verdict(number)) for number, case in enumerate(TABLES[table]())]
    finally:
        server.end()


def main() -> int:
    """Try all; exit with 0 if at most 1 % of each table are not met clearly, and none by silence."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", choices=TABLES, help="one table")
    parser.add_argument("--limit", type=float, default=15, help="seconds that a door may take to refuse [15]")
    given = parser.parse_args()
    good = True
    for table in TABLES if given.only is None else [given.only]:
        rows = tried(table, given.limit)
        wrong = [(case, flaw) for case, flaw in rows if flaw]
        kinds = Counter(flaw.split(":")[0].split()[0] for _, flaw in wrong)
        print(f"{table}: {len(wrong)} of {len(rows)} malformed not met clearly ({len(wrong) / len(rows):.1%})")
        for case, flaw in wrong:
            print(f"    {case.text}: {' '.join(flaw.split())[:160]}")
        good &= len(wrong) <= MOST_UNCLEAR * len(rows) and not kinds["silent"] and not kinds["hung"]
    return not good


if __name__ == "__main__":
    sys.exit(main())
