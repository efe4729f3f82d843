"""Runs work in a separate process: work that compiles for long and reports no progress, yet must be cancellable.

Branches and optima are such work. Their programs are lowered for XLA under Python's lock, so in a thread of the server
they would block every page for seconds. A compiled call cannot be stopped except by ending its process. A worker
process is started for its first work, is reused for further work, and is ended when a work is cancelled.
"""

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

ProgressCallback = Callable[[int, int], None]
"""Function to which a job reports its progress: the finished and the total number of steps."""

_POLL_INTERVAL = 0.05  # seconds between two checks for cancellation
_PROGRAM = "from vijax.explorer.server.worker import serve; serve()"


class WorkerError(Exception):
    """An error of the work in the process, or the early end of the process, as a message of one line."""


class Worker:
    """A process that runs one piece of work after another; only one thread of the server may use it."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def run(self, work: Callable[..., Any], arguments: tuple[Any, ...], report: ProgressCallback) -> Any:
        """Run a piece of work in the process, and return its result.

        Args:
            work: A function at the top level of a module; the process imports the function.
            arguments: Arguments of the function; they are pickled.
            report: Called as `report(0, 1)` at every `_POLL_INTERVAL` until the work is done. If `report` raises an
                error, for example because the job is cancelled, the process ends.

        Raises:
            WorkerError: The work raised an error, or the process ended.
        """
        process = self._running_process()
        assert process.stdin is not None
        answer: list[bytes] = []
        reading = threading.Thread(target=lambda: answer.append(_receive(process.stdout)), daemon=True)
        try:
            _send(process.stdin, pickle.dumps((work, arguments)))
            reading.start()
            while reading.is_alive():
                reading.join(_POLL_INTERVAL)
                report(0, 1)
        except BaseException:
            self.close()
            raise
        if not answer or not answer[0]:
            self.close()
            raise WorkerError("the process of this work has ended; compute it again")
        succeeded, result = pickle.loads(answer[0])
        if not succeeded:
            raise WorkerError(result)
        return result

    def _running_process(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            line, pipe = [sys.executable, "-c", _PROGRAM], subprocess.PIPE
            # The process has its own process group, so that Ctrl-C in a terminal interrupts the server only. The server
            # then ends the process.
            self._process = subprocess.Popen(line, stdin=pipe, stdout=pipe, process_group=0)
        return self._process

    def close(self) -> None:
        """End the process if it was started; the next `run` starts a new process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()
            self._process = None


def serve() -> None:
    """Run in the worker process: execute each work received on standard input, until the input ends."""
    # Standard output carries the results, so all other output is redirected to standard error.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while content := _receive(sys.stdin.buffer):
        try:
            work, arguments = pickle.loads(content)
            answer = pickle.dumps((True, work(*arguments)))
        except Exception as error:  # any error of the work is sent to the server, which shows it on the page
            answer = pickle.dumps((False, error_line(error)))
        _send(answers, answer)


def error_line(error: BaseException) -> str:
    """Return the message of an error in one line."""
    return " ".join(str(error).split()) or type(error).__name__


_BYTES = 8  # a message begins with its size as an integer of 8 bytes


def _send(pipe: Any, content: bytes) -> None:
    pipe.write(len(content).to_bytes(_BYTES, "little") + content)
    pipe.flush()


def _receive(pipe: Any) -> bytes:
    """Return the content of the next message; empty bytes at the end of the stream."""
    try:
        return bytes(pipe.read(int.from_bytes(pipe.read(_BYTES), "little")))
    except (OSError, ValueError):
        return b""
