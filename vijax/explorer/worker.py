"""Work in a process of its own: what compiles long, tells no progress, and yet has to be cancelled.

Branches and optima are such. XLA lowers their programs under Python's lock, for seconds in which a thread of the server
would keep every page from answering; and a compiled call that is under way ends only with its process. The process
starts with its first work, stays for the next, and is ended where work is cancelled.
"""

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

Tell = Callable[[int, int], None]
"""What a job tells its progress to: how much is done, and of how much."""

_LOOK = 0.05  # seconds after which a cancelled job is noticed
_PROGRAM = "from vijax.explorer.worker import serve; serve()"


class WorkerError(Exception):
    """What was raised in the process, in a line."""


class Worker:
    """A process that does one piece of work after another, for one thread."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def run(self, work: Callable[..., Any], given: tuple[Any, ...], tell: Tell) -> Any:
        """Do a piece of work there, and give what comes out.

        Args:
            work: A function of a module, which the process imports.
            given: Its arguments.
            tell: Called again and again with no progress; what it raises ends the process.

        Raises:
            WorkerError: What the work raised, or that the process ended.
        """
        process = self._started()
        assert process.stdin is not None
        answer: list[bytes] = []
        reading = threading.Thread(target=lambda: answer.append(_received(process.stdout)), daemon=True)
        try:
            _sent(process.stdin, pickle.dumps((work, given)))
            reading.start()
            while reading.is_alive():
                reading.join(_LOOK)
                tell(0, 1)
        except BaseException:
            self.close()
            raise
        if not answer or not answer[0]:
            self.close()
            raise WorkerError("the process of this work has ended; compute it again")
        good, found = pickle.loads(answer[0])
        if not good:
            raise WorkerError(found)
        return found

    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            line, pipe = [sys.executable, "-c", _PROGRAM], subprocess.PIPE
            # In a group of its own, which Ctrl-C in a terminal does not reach: the server ends it.
            self._process = subprocess.Popen(line, stdin=pipe, stdout=pipe, process_group=0)
        return self._process

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()
            self._process = None


def serve() -> None:
    """Do what comes by standard input, until it ends."""
    # What anything prints goes to standard error: standard output is the way of the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while content := _received(sys.stdin.buffer):
        try:
            work, given = pickle.loads(content)
            answer = pickle.dumps((True, work(*given)))
        except Exception as error:  # whatever it is, the page says it
            answer = pickle.dumps((False, one_line(error)))
        _sent(answers, answer)


def one_line(error: BaseException) -> str:
    """Return what an error says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


_BYTES = 8  # that say how long a message is


def _sent(pipe: Any, content: bytes) -> None:
    pipe.write(len(content).to_bytes(_BYTES, "little") + content)
    pipe.flush()


def _received(pipe: Any) -> bytes:
    """Read a message; nothing where there is none any more."""
    try:
        return bytes(pipe.read(int.from_bytes(pipe.read(_BYTES), "little")))
    except (OSError, ValueError):
        return b""
