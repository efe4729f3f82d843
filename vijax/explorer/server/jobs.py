"""Runs the work of pages in threads, so that the server's event loop stays free.

A page has at most one job per kind of work (motion, line, basin, ...): a new job cancels the current one of its kind. A
cancelled job ends when it next reports its progress. All threads share the compiled programs of the server, which XLA
runs without Python's lock. Work that compiles for long and reports no progress runs in a separate process: `worker`.
"""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from vijax.explorer.server.worker import ProgressCallback, Worker, error_line


class CancelledError(Exception):
    """Raised inside a job to end it, because a new job of its kind replaces it or its page has cancelled it."""


@dataclass
class Job:
    """One piece of work.

    Attributes:
        kind: Kind of the work; a page has at most one job per kind.
        cancelled: Set once the job is cancelled.
        future: Future of the thread that runs the job.
    """

    kind: str
    cancelled: threading.Event = field(default_factory=threading.Event)
    future: "Future[Any] | None" = None


class JobThreads:
    """Threads of a server, one per kind of work. All pages share them, so jobs of one kind run one after the other."""

    def __init__(self) -> None:
        self._threads: dict[str, ThreadPoolExecutor] = {}
        self._workers: dict[str, Worker] = {}

    def submit(self, kind: str, work: Callable[[], Any]) -> "Future[Any]":
        """Queue a piece of work for the thread of its kind, and return its future."""
        if kind not in self._threads:
            self._threads[kind] = ThreadPoolExecutor(1, thread_name_prefix=f"vijax-{kind}")
        return self._threads[kind].submit(work)

    def worker(self, kind: str) -> Worker:
        """Return the worker process of a kind of work; only the thread of this kind may use the worker."""
        return self._workers.setdefault(kind, Worker())

    def close(self) -> None:
        """Accept no more work, drop work that has not started, and end all worker processes."""
        for worker in self._workers.values():
            worker.close()
        for thread in self._threads.values():
            thread.shutdown(wait=False, cancel_futures=True)


class Jobs:
    """The jobs of one page.

    Args:
        threads: Threads that run the jobs.
        deliver: Takes a function from any thread, and lets the event loop call the function.
    """

    def __init__(self, threads: JobThreads, deliver: Callable[[Callable[[], None]], Any]) -> None:
        self._threads, self._deliver = threads, deliver
        self._current: dict[str, Job] = {}

    def start(
        self,
        kind: str,
        work: Callable[[ProgressCallback], Any],
        done: Callable[[Any], None],
        failed: Callable[[str], None],
        progress: ProgressCallback | None = None,
    ) -> Job:
        """Start a job, and cancel the current job of its kind.

        Args:
            kind: Kind of the work; the page has at most one job per kind.
            work: Called in a thread; its argument is a function that takes the progress (done, total).
            done: Called on the event loop with the result of `work`, unless the job is cancelled.
            failed: Called on the event loop with the error in one line, unless the job is cancelled.
            progress: Called on the event loop with the progress, unless the job is cancelled.
        """
        self.cancel(kind)
        job = self._current[kind] = Job(kind)

        def deliver_if_current(callback: Callable[[], None]) -> None:
            def call_if_current() -> None:
                if self._current.get(kind) is job and not job.cancelled.is_set():
                    callback()

            self._deliver(call_if_current)

        def report(count: int, total: int) -> None:
            if job.cancelled.is_set():
                raise CancelledError
            if progress is not None:
                deliver_if_current(lambda: progress(count, total))

        def run() -> None:
            if job.cancelled.is_set():
                return
            try:
                result = work(report)
            except CancelledError:
                return
            except Exception as error:  # the page shows any error; the server must survive a failed job
                message = error_line(error)
                deliver_if_current(lambda: self._end(job, lambda: failed(message)))
                return
            deliver_if_current(lambda: self._end(job, lambda: done(result)))

        job.future = self._threads.submit(kind, run)
        return job

    def _end(self, job: Job, callback: Callable[[], None]) -> None:
        del self._current[job.kind]
        callback()

    def cancel(self, kind: str) -> bool:
        """Cancel the page's job of a kind; return True if there was such a job."""
        job = self._current.pop(kind, None)
        if job is None:
            return False
        job.cancelled.set()
        if job.future is not None:
            job.future.cancel()
        return True

    def running(self) -> tuple[str, ...]:
        """Return the kinds of work for which the page has a job."""
        return tuple(self._current)

    def close(self) -> None:
        """Cancel all jobs."""
        for kind in self.running():
            self.cancel(kind)
