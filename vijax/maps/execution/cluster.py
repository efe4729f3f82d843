"""Execution of tasks on the workers of a Dask cluster, on this machine or on many.

This module is independent of the content of tasks and of their results. Dask assigns tasks to idle workers, runs the
tasks of a lost worker again, and reports completed tasks. Only tasks and the report of their completion pass over the
network: a task writes its own results.
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

from vijax.runtime import validation
from vijax.runtime.doc_pages import see

if TYPE_CHECKING:
    from distributed import Client, Future

Task = TypeVar("Task")
Workers = int | str
"""Number of processes of this machine, which share its cores; or the address of a scheduler."""

# Maximum number of processes of one machine; a larger number is taken for a typing error.
_MOST_WORKERS = 4096
# Seconds that a scheduler has to answer. With fewer, a busy scheduler would count as absent.
CONNECT_TIMEOUT = 10
# Tasks submitted per thread of a worker. While one task runs the next is already there, so the thread never idles.
_TASKS_PER_THREAD = 2
# Loggers that print tracebacks of lost connections.
_NOISY_LOGGERS = (
    "distributed.batched",
    "distributed.client",
    "distributed.core",
    "distributed.utils",
    "tornado.application",
)
# Dask settings that stop schedulers and workers from serving web pages, because these are open without credentials.
_NO_PAGES: dict[str, list[str]] = {f"distributed.{role}.http.routes": [] for role in ("scheduler", "worker")}
# JAX settings that make new processes use the compilation cache of their driver.
_CACHE_SETTINGS = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


def check_available(workers: Workers, timeout: float = CONNECT_TIMEOUT) -> None:
    """Raise an error unless the specified workers exist or can be started; starts no worker.

    Args:
        workers: Number of processes, or the address of a scheduler.
        timeout: Seconds that a scheduler has to answer.

    Raises:
        ValueError: If the number or the address is invalid.
        OSError: If no scheduler answers at the address.
        ModuleNotFoundError: If Dask is missing, or, for processes of this machine, the package that makes certificates.
    """
    if isinstance(workers, str):
        # Connecting is the test that a scheduler answers.
        with _connected(workers, timeout):
            pass
    else:
        _dask()
        validation.validate_integer("workers", workers, 1, _MOST_WORKERS)
        _credentials()


def run_tasks(work: Callable[[Task], None], tasks: Iterable[Task], workers: Workers) -> Iterator[Task]:
    """Run every task, again if a worker is lost, and yield each task when it is complete.

    Args:
        work: Function of one task that a worker calls. It must have its complete effect or none, because a lost task
            runs again. Its errors are raised here.
        tasks: Tasks, each small enough to be sent over the network. They are taken from the iterable only as workers
            need them, so there may be any number.
        workers: As in `check_available`. The workers of a scheduler may join and leave; without any worker the call
            waits for one.

    Raises:
        As `check_available`; ChildProcessError if a task lost one worker after another; ConnectionError if the
            scheduler is lost.
    """
    with _connected(workers) if isinstance(workers, str) else _local_cluster(workers) as client:
        try:
            yield from _run_all(client, work, iter(tasks))
        # A lost scheduler closes the connection, and cancels all futures.
        except (_dask().comm.CommClosedError, CancelledError):
            raise ConnectionError("the scheduler was lost") from None


def _run_all(client: "Client", work: Callable[[Task], None], tasks: Iterator[Task]) -> Iterator[Task]:
    """Submit tasks as threads become free, and yield each task when it is complete."""
    from distributed import as_completed

    running: dict[Future, Task] = {}
    finished = as_completed(loop=client.loop)

    def fill() -> None:
        # Without workers, the tasks of one thread are submitted, and wait for a worker to join.
        most = _TASKS_PER_THREAD * max(sum(client.nthreads().values()), 1)
        next_tasks = list(itertools.islice(tasks, max(most - len(running), 0)))
        # pure=False: Dask must not reuse the result of an equal earlier task, because the files that it wrote may be
        # gone.
        futures = client.map(work, next_tasks, pure=False)
        running.update(zip(futures, next_tasks, strict=True))
        finished.update(futures)

    fill()
    # New tasks are submitted before completed ones are yielded: workers stay busy while the caller handles them.
    for batch in finished.batches():
        ended = []
        for future in batch:
            _check_ended(future)
            ended.append(running.pop(future))
        fill()
        yield from ended


def _check_ended(future: "Future") -> None:
    """Raise the error that ended a task, if it did not complete."""
    from distributed.scheduler import KilledWorker

    try:
        future.result()
    except KilledWorker as error:
        # Dask gives up a task once it has lost this many workers.
        lost = error.allowed_failures + 1
        raise ChildProcessError(
            see("studies", f"{lost} workers were lost, one after another, at the same tile")
        ) from None


def _dask() -> ModuleType:
    """Return the module `distributed`; raise ModuleNotFoundError with the remedy if it is not installed."""
    try:
        import distributed
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            see("studies", "workers must have Dask as their scheduler; got none; install vijax[cluster]")
        ) from None
    return distributed


def _credentials() -> Any:
    """Return a key and a certificate that exist in memory alone: without them no other process can connect.

    Raises:
        ModuleNotFoundError: If the package that makes them is not installed.
    """
    try:
        return _dask().security.Security.temporary()
    except ImportError:
        raise ModuleNotFoundError(
            see("studies", "workers must have cryptography, for their credentials; got none; install vijax[cluster]")
        ) from None


@contextmanager
def _connected(address: str, timeout: float = CONNECT_TIMEOUT) -> "Iterator[Client]":
    """Connect to the scheduler at an address, for the duration of the context."""
    dask = _dask()
    try:
        dask.comm.get_address_host_port(address)
    except ValueError:
        raise ValueError(
            see(
                "studies",
                f"workers or scheduler must be an address such as tcp://10.0.0.1:8786; "
                f"got {validation.value_text(address)}",
            )
        ) from None
    try:
        # Not the default client: Dask computations of the calling program must not move to this scheduler.
        client = dask.Client(address, timeout=timeout, set_as_default=False)
    except TypeError as error:  # raised for TLS without certificates
        raise ValueError(
            see(
                "studies",
                f"workers or scheduler must be an address that Dask is configured to connect to; got {address} "
                f"({error})",
            )
        ) from None
    except OSError:
        raise ConnectionError(
            see(
                "studies",
                f"workers or scheduler must answer within {timeout} s; got {address}, where none did; start it, or "
                "give its address",
            )
        ) from None
    with _lost_connections_unlogged(), client:
        yield client


@contextmanager
def _lost_connections_unlogged() -> Iterator[None]:
    """Suppress logged tracebacks of lost connections; the errors raised here describe the loss in one line."""

    def is_other_record(record: logging.LogRecord) -> bool:
        return not (record.exc_info and isinstance(record.exc_info[1], OSError | asyncio.CancelledError))

    loggers = [logging.getLogger(name) for name in _NOISY_LOGGERS]
    for logger in loggers:
        logger.addFilter(is_other_record)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeFilter(is_other_record)


@contextmanager
def _local_cluster(number: int) -> "Iterator[Client]":
    """Start `number` processes that share the cores and end with this process, however it ends.

    All connections are encrypted and need a certificate of this run, because a client of a scheduler can run code
    through it.
    """
    import dask

    # The settings stay for the whole context, because a worker that replaces a lost one reads them too.
    with dask.config.set(_NO_PAGES):
        with _without_interrupts():
            cluster = _dask().LocalCluster(
                n_workers=number,
                # the cores are divided among the processes; every thread runs one tile at a time
                threads_per_worker=max((os.cpu_count() or 1) // number, 1),
                memory_limit=None,  # the tile sets the memory; a worker holds no results that it could spill
                security=_credentials(),
                dashboard_address=None,
                # any free port, as another run may use a fixed one
                scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
            )
        with cluster, _dask().Client(cluster, set_as_default=False) as client:
            settings = {name: getattr(jax.config, name) for name in _CACHE_SETTINGS}
            client.register_worker_callbacks(partial(_apply_settings, settings))
            yield client


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Deliver Ctrl-C, which a terminal sends to all its processes, to this process alone.

    The context blocks the signal SIGINT. Threads and processes inherit the set of blocked signals, so threads and
    processes started in the context, and their children, never receive it. A signal that reaches this process in the
    context is handled when the context ends.
    """
    resource_tracker.ensure_running()  # started first, as its start unblocks the signal in this thread
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _apply_settings(settings: dict[str, Any]) -> None:
    """Set the compilation cache of a new process as in its driver."""
    for name, value in settings.items():
        jax.config.update(name, value)
