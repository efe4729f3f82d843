"""Work off the event loop: one job a kind, the newest wins, the older is cancelled.

Jobs are threads of the server: they share its compiled programs, which XLA runs without Python's lock, and end, once
cancelled, when they next tell their progress. What tells none, and compiles long, a job has done by a process of its
own; see `worker`.
"""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from vijax.explorer.worker import Tell, Worker, one_line


class CancelledError(Exception):
    """What ends a job from within: another took its place, or nobody wants it any more."""


@dataclass
class Job:
    """One piece of work.

    Attributes:
        kind: Of which there is one at a time.
        over: Whether it has been cancelled.
        future: What runs it.
    """

    kind: str
    over: threading.Event = field(default_factory=threading.Event)
    future: "Future[Any] | None" = None


class Crew:
    """The threads of a server: one a kind, whichever page asks, so that two pages wait for each other in turn."""

    def __init__(self) -> None:
        self._threads: dict[str, ThreadPoolExecutor] = {}
        self._workers: dict[str, Worker] = {}

    def submit(self, kind: str, work: Callable[[], Any]) -> "Future[Any]":
        """Run a piece of work when the thread of its kind is free."""
        if kind not in self._threads:
            self._threads[kind] = ThreadPoolExecutor(1, thread_name_prefix=f"vijax-{kind}")
        return self._threads[kind].submit(work)

    def worker(self, kind: str) -> Worker:
        """Give the process of a kind, which its thread alone may use."""
        return self._workers.setdefault(kind, Worker())

    def close(self) -> None:
        """Take no more work, drop what has not begun, and end all processes."""
        for worker in self._workers.values():
            worker.close()
        for thread in self._threads.values():
            thread.shutdown(wait=False, cancel_futures=True)


class Jobs:
    """The jobs of one page.

    Args:
        crew: Whose threads run them.
        deliver: Called from a thread with what is to be called on the event loop.
    """

    def __init__(self, crew: Crew, deliver: Callable[[Callable[[], None]], Any]) -> None:
        self._crew, self._deliver = crew, deliver
        self._current: dict[str, Job] = {}

    def start(
        self,
        kind: str,
        work: Callable[[Tell], Any],
        done: Callable[[Any], None],
        failed: Callable[[str], None],
        progress: Tell | None = None,
    ) -> Job:
        """Begin a job, in place of the one of its kind that there is.

        Args:
            kind: Of which there is one at a time.
            work: Called in a thread with what it tells its progress to.
            done, failed, progress: Called on the event loop with what came out, with what was raised in one line, and
                with how far it is; no more once the job is cancelled.
        """
        self.cancel(kind)
        job = self._current[kind] = Job(kind)

        def current(then: Callable[[], None]) -> None:
            def unless_over() -> None:
                if self._current.get(kind) is job and not job.over.is_set():
                    then()

            self._deliver(unless_over)

        def tell(count: int, total: int) -> None:
            if job.over.is_set():
                raise CancelledError
            if progress is not None:
                current(lambda: progress(count, total))

        def run() -> None:
            if job.over.is_set():
                return
            try:
                found = work(tell)
            except CancelledError:
                return
            except Exception as error:  # whatever it is, the page says it: a server does not end with a job
                said = one_line(error)
                current(lambda: self._end(job, lambda: failed(said)))
                return
            current(lambda: self._end(job, lambda: done(found)))

        job.future = self._crew.submit(kind, run)
        return job

    def _end(self, job: Job, then: Callable[[], None]) -> None:
        del self._current[job.kind]
        then()

    def cancel(self, kind: str) -> bool:
        """End the job of a kind; say whether there was one."""
        job = self._current.pop(kind, None)
        if job is None:
            return False
        job.over.set()
        if job.future is not None:
            job.future.cancel()
        return True

    def running(self) -> tuple[str, ...]:
        """Name the kinds of which there is a job."""
        return tuple(self._current)

    def close(self) -> None:
        """End all of them."""
        for kind in self.running():
            self.cancel(kind)
