"""Tasks on the workers of a Dask cluster, of this machine or of many; knows neither what a task does nor its results.

Dask finds who is idle, runs again what a lost worker was at, and says what is done. Nothing but tasks and the word
that they are done goes over the network: a task writes its own results.
"""

import asyncio
import itertools
import logging
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import partial
from multiprocessing import resource_tracker
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import jax

from vijax.runtime import checks
from vijax.runtime.pages import see

if TYPE_CHECKING:
    from distributed import Client, Future

Task = TypeVar("Task")
Workers = int | str
"""So many processes of this machine, among which its cores are divided; or the address of a scheduler."""

# Processes of one machine, at most: more are taken for a slip of the finger.
_MOST_WORKERS = 4096
# Seconds that a scheduler has to answer: with fewer, a busy one counts as absent.
ANSWER = 10
# Tasks for a thread of a worker: while one runs the next waits beside it, so that the thread never does.
_WAITING = 2
# Loggers that print tracebacks of connections that are lost.
_LOGS = ("distributed.batched", "distributed.client", "distributed.core", "distributed.utils", "tornado.application")
# Settings of Dask by which schedulers and workers serve no page: their pages need no credentials.
_NO_PAGES: dict[str, list[str]] = {f"distributed.{role}.http.routes": [] for role in ("scheduler", "worker")}
# Settings of JAX by which new processes keep compiled programs where their driver does.
_CACHE = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


def check(workers: Workers, answer: float = ANSWER) -> None:
    """Raise unless there are such workers, or can be; starts none.

    Args:
        workers: So many processes, or the address of a scheduler.
        answer: Seconds that a scheduler has to answer.

    Raises:
        ValueError: If a number is none, or an address no address.
        OSError: If no scheduler answers there.
        ModuleNotFoundError: Without Dask, or without what makes certificates for processes of this machine.
    """
    if isinstance(workers, str):
        with _joined(workers, answer):
            pass
    else:
        _dask()
        checks.whole("workers", workers, 1, _MOST_WORKERS)
        _credentials()


def done(work: Callable[[Task], None], tasks: Iterable[Task], workers: Workers) -> Iterator[Task]:
    """Work on every task, once or more often; yields each as it is done.

    Args:
        work: What a worker does with a task, whole or not at all; what it raises is raised here.
        tasks: Each light enough to be sent; taken only as workers need them, so that there may be any number.
        workers: Of a scheduler those that it has, as they come and go; without any this waits.

    Raises:
        As `check`; ChildProcessError if a task lost one worker after another; ConnectionError if the scheduler is lost.
    """
    with _joined(workers) if isinstance(workers, str) else _local(workers) as client:
        try:
            yield from _in_turn(client, work, iter(tasks))
        except (_dask().comm.CommClosedError, CancelledError):
            raise ConnectionError("the scheduler was lost") from None


def _in_turn(client: "Client", work: Callable[[Task], None], tasks: Iterator[Task]) -> Iterator[Task]:
    from distributed import as_completed

    running: dict[Future, Task] = {}
    finished = as_completed(loop=client.loop)

    def fill() -> None:
        most = _WAITING * max(sum(client.nthreads().values()), 1)
        some = list(itertools.islice(tasks, max(most - len(running), 0)))
        # A task is not pure: it is there for what it writes, which may be gone since the same was asked before.
        futures = client.map(work, some, pure=False)
        running.update(zip(futures, some, strict=True))
        finished.update(futures)

    fill()
    for batch in finished.batches():
        ended = []
        for future in batch:
            _check_ended(future)
            ended.append(running.pop(future))
        fill()
        yield from ended


def _check_ended(future: "Future") -> None:
    """Raise what ended a task, if it did not come to its own end."""
    from distributed.scheduler import KilledWorker

    try:
        future.result()
    except KilledWorker as error:
        lost = error.allowed_failures + 1
        raise ChildProcessError(
            see("studies", f"{lost} workers were lost, one after another, at the same tile")
        ) from None


def _dask() -> ModuleType:
    try:
        import distributed
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            see("studies", "workers must have Dask to be led by; got none; install vijax[cluster]")
        ) from None
    return distributed


def _credentials() -> Any:
    """Make a key and a certificate that exist in memory alone: without them no other process can connect.

    Raises:
        ModuleNotFoundError: Without the package that makes them.
    """
    try:
        return _dask().security.Security.temporary()
    except ImportError:
        raise ModuleNotFoundError(
            see("studies", "workers must have cryptography, for their credentials; got none; install vijax[cluster]")
        ) from None


@contextmanager
def _joined(address: str, answer: float = ANSWER) -> "Iterator[Client]":
    """Join the scheduler at an address."""
    dask = _dask()
    try:
        dask.comm.get_address_host_port(address)
    except ValueError:
        raise ValueError(
            see(
                "studies",
                f"workers or scheduler must be an address such as tcp://10.0.0.1:8786; got {checks.shown(address)}",
            )
        ) from None
    try:
        client = dask.Client(address, timeout=answer, set_as_default=False)
    except TypeError as error:  # which TLS without certificates raises
        raise ValueError(
            see(
                "studies",
                f"workers or scheduler must be one that Dask's configuration knows how to reach; got {address} "
                f"({error})",
            )
        ) from None
    except OSError:
        raise ConnectionError(
            see(
                "studies",
                f"workers or scheduler must answer within {answer} s; got {address}, where none did; start it, or give "
                "its address",
            )
        ) from None
    with _quiet(), client:
        yield client


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep from the logs the tracebacks of connections that are lost: what is raised here says it in one line."""

    def other(record: logging.LogRecord) -> bool:
        return not (record.exc_info and isinstance(record.exc_info[1], OSError | asyncio.CancelledError))

    loggers = [logging.getLogger(name) for name in _LOGS]
    for logger in loggers:
        logger.addFilter(other)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeFilter(other)


@contextmanager
def _local(number: int) -> "Iterator[Client]":
    """Start so many processes, which share the cores and end with this one, however that ends.

    All connections are encrypted and need a certificate of this run: whoever reaches a scheduler can run code by it.
    """
    import dask

    # A worker that replaces a lost one reads the settings, too.
    with dask.config.set(_NO_PAGES):
        with _without_interrupts():
            made = _dask().LocalCluster(
                n_workers=number,
                threads_per_worker=max((os.cpu_count() or 1) // number, 1),
                memory_limit=None,  # set by the tile; a worker holds no results that it could spill
                security=_credentials(),
                dashboard_address=None,
                scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # of no fixed port, which another run may have
            )
        with made, _dask().Client(made, set_as_default=False) as client:
            kept = {name: getattr(jax.config, name) for name in _CACHE}
            client.register_worker_callbacks(partial(_settle, kept))
            yield client


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Leave Ctrl-C, which reaches all processes of a terminal, to this one alone.

    Threads and processes inherit which signals are blocked: those that are started here, and what they start later.
    Here a signal that comes meanwhile is handled at the end.
    """
    resource_tracker.ensure_running()  # which unblocks the signal in the thread that starts it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _settle(kept: dict[str, Any]) -> None:
    """Make a new process keep compiled programs where its driver does."""
    for name, value in kept.items():
        jax.config.update(name, value)
