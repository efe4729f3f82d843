"""Maps on the workers of a cluster: tasks, lost workers and drivers, validation of the arguments."""

import itertools
import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import dask
import distributed
import numpy as np
import psutil
import pytest
import xarray as xr

from tests.helpers import stand_in
from vijax.maps import sweep as sweeps
from vijax.maps.execution import cluster, tile_execution
from vijax.maps.storage import tiled_store
from vijax.maps.sweep import load, sweep
from vijax.simulation import simulate

AXES = {"d": np.linspace(0.1, 0.3, 5), "kappa": np.geomspace(3, 400, 4)}
MAX_TILE_CELLS = 6


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(simulate, "summarise", stand_in)
    monkeypatch.setenv("VIJAX_TILE", str(MAX_TILE_CELLS))
    return tmp_path


@pytest.fixture
def scheduler():
    """Yield the address of a scheduler with two worker threads in this process, where the stand-in is installed."""
    options = {"processes": False, "dashboard_address": None, "protocol": "tcp"}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, **options) as local_cluster:
        yield local_cluster.scheduler_address


def unused_address() -> str:
    """Return a local address without a server."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{free.getsockname()[1]}"


# --- in a scheduler's workers ----------------------------------------------------------------------------------------


def test_workers_write_the_sweep_and_resume_it_after_an_interrupt(folder, scheduler):
    steps = []

    def stop(done, total):
        if done >= 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped:
        sweep(**AXES, out="map.zarr", workers=scheduler, progress=stop)
    assert "of 20 cells are in map.zarr; the same command continues" in stopped.value.__notes__[0]
    result = sweep(**AXES, out="map.zarr", workers=scheduler, progress=lambda *step: steps.append(step))
    xr.testing.assert_identical(result.load(), sweep(**AXES))
    assert 8 <= steps[0][0] <= 20  # the workers may have finished tiles that were in progress
    assert steps[-1] == (20, 20)
    assert sweep(**AXES, out="map.zarr", workers=scheduler, overwrite=True).identical(result)


def test_exception_of_a_worker_is_raised_in_the_driver(folder, scheduler, monkeypatch):
    def full(tile, fields, seconds):
        raise OSError(28, "No space left on device", "somewhere")

    monkeypatch.setattr(tiled_store, "write_tile", full)
    with pytest.raises(OSError, match="No space left") as error:
        sweep(**AXES, out="map.zarr", workers=scheduler)
    assert error.value.filename == "somewhere"
    assert error.value.__notes__[0].startswith("0 of 20 cells are in map.zarr")


def test_tasks_are_consumed_lazily(scheduler):
    done = cluster.run_tasks(abs, itertools.count(), scheduler)
    assert len(set(itertools.islice(done, 20))) == 20
    done.close()


SCHEDULER = """
import sys
import distributed
options = {"processes": False, "dashboard_address": None, "protocol": "tcp"}
with distributed.LocalCluster(n_workers=1, threads_per_worker=1, **options) as made:
    print(made.scheduler_address, flush=True)
    input()
"""


@pytest.mark.parametrize("seconds", [pytest.param(0, marks=pytest.mark.long), 1])
def test_lost_scheduler_raises_a_single_line_error(capfd, seconds):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen([sys.executable, "-c", SCHEDULER], **pipes) as process:
        try:
            done = cluster.run_tasks(abs, itertools.count(), process.stdout.readline().strip())
            assert next(done) >= 0
            process.kill()
            time.sleep(seconds)  # in this time the client may stop its attempts to reconnect
            with pytest.raises(ConnectionError, match="the scheduler was lost"):
                list(done)
        finally:
            process.kill()
    assert capfd.readouterr().err == ""
    assert not any(logging.getLogger(name).filters for name in ("distributed.client", "distributed.batched"))


# --- tiles after the end of their driver -----------------------------------------------------------------------------


def test_pickled_tile_holds_only_its_cells(folder, monkeypatch):
    monkeypatch.setenv("VIJAX_TILE", "1024")
    side = 10_000
    planned = sweeps.plan({"d": np.linspace(0.1, 0.3, side), "kappa": np.geomspace(3, 400, side)})
    with tiled_store.open_study(planned, "map.zarr") as plane:
        sent = pickle.dumps(plane.tile(7))
    assert len(sent) < 20_000
    again = pickle.loads(sent)
    assert again.path.is_absolute()
    assert (again.index, again.shapes["P"]) == (plane.index(7), tuple(plane.tile_lengths.values()))
    xr.testing.assert_identical(again.plan.cells.quantities["d"], plane.tile(7).plan.cells.quantities["d"])


def test_late_tile_does_not_change_a_store_that_was_overwritten(folder):
    with tiled_store.open_study(sweeps.plan(AXES), "map.zarr") as plane:
        late = plane.tile(0)
    expected = sweep(**AXES, r=0.4, out="map.zarr", overwrite=True).load()
    with pytest.raises(FileExistsError, match="no longer the store that tile 0"):
        tile_execution.fill_tile(1024, late)
    xr.testing.assert_identical(load("map.zarr"), expected)


def test_record_of_an_earlier_store_is_rejected(folder, caplog):
    sweep(**AXES, out="map.zarr")
    record = Path("map.zarr/status/tiles/2.json")
    late = record.read_text()
    expected = sweep(**AXES, out="map.zarr", overwrite=True).load()
    record.write_text(late)
    xr.testing.assert_identical(sweep(**AXES, out="map.zarr").load(), expected)
    assert [entry.getMessage() for entry in caplog.records] == [
        "tile 2 of map.zarr is run again: its record is of another store"
    ]


# --- processes of this machine ---------------------------------------------------------------------------------------


def fragile(folder: Path, lives: int, task: int) -> None:
    """Kill the worker process the first `lives` times that task 1 runs."""
    (folder / f"{task}.{os.getpid()}").touch()
    if task == 1 and len(list(folder.glob("1.*"))) <= lives:
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="no such signal there")
def test_a_lost_worker_is_replaced(tmp_path):
    assert sorted(cluster.run_tasks(partial(fragile, tmp_path, 1), range(6), 2)) == list(range(6))
    assert len(list(tmp_path.glob("1.*"))) == 2
    assert str(os.getpid()) not in {path.suffix[1:] for path in tmp_path.iterdir()}


@pytest.mark.skipif(sys.platform == "win32", reason="no such signal there")
def test_task_that_kills_all_its_workers_is_abandoned(tmp_path):
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        pytest.raises(ChildProcessError, match="1 workers were lost, one after another, at the same tile"),
    ):
        list(cluster.run_tasks(partial(fragile, tmp_path, 9), range(6), 1))


def answers_without_credentials(port: int) -> bytes:
    """Return the response of a local port to an HTTP request without credentials."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(b"GET /info/main/workers.html HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        try:
            return b"".join(iter(partial(connection.recv, 4096), b""))
        except ConnectionError:
            return b""


def blocks_ctrl_c() -> bool:
    """Return True if the thread of a task, and so its process, blocks the signal of Ctrl-C."""
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.long
def test_only_this_run_can_connect_to_its_scheduler_and_workers():
    """Any user of the machine can reach the ports, and a connected client can execute code."""
    with cluster._local_cluster(1) as client:
        address = client.scheduler_info()["address"]
        assert client.submit(os.getpid).result() != os.getpid()
        assert client.submit(blocks_ctrl_c).result()
        assert not blocks_ctrl_c()
        processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening = [
            connection
            for process in processes
            for connection in process.net_connections()
            if connection.status == "LISTEN"
        ]
        ports = {connection.laddr.port for connection in listening}
        attempts = [(address.replace("tls:", "tcp:"), None), (address, distributed.Security.temporary())]
        for target, credentials in attempts:
            with pytest.raises(OSError, match=r"Timed out|TLS certificate does not match|reset by peer"):
                distributed.Client(target, security=credentials, timeout=1, set_as_default=False)
        answers = {port: answers_without_credentials(port) for port in ports}
    assert {connection.laddr.ip for connection in listening} == {"127.0.0.1"}
    assert len(answers) >= 4  # scheduler, nanny, worker and the ports of the disabled pages
    assert {answer.partition(b"\r\n")[0] for answer in answers.values()} <= {b"", b"HTTP/1.1 404 Not Found"}


# --- validation -----------------------------------------------------------------------------------------------------

BAD = [
    (0, "workers must be a whole number of at least 1; got 0"),
    (2.5, "workers must be a whole number of at least 1; got 2.5"),
    ("somewhere", "scheduler must be an address such as tcp://10.0.0.1:8786; got 'somewhere'"),
    ("http:/x:1", "scheduler must be an address"),
]


@pytest.mark.parametrize(("workers", "message"), BAD, ids=[str(workers) for workers, _ in BAD])
def test_invalid_workers_are_rejected(folder, workers, message):
    with pytest.raises(ValueError, match=message) as error:
        sweep(**AXES, out="map.zarr", workers=workers)
    assert "\n" not in str(error.value)
    assert not list(folder.iterdir())


def test_workers_without_a_store_are_rejected():
    with pytest.raises(ValueError, match="workers requires out, the store that they write; got 2 alone"):
        sweep(**AXES, workers=2)


def test_unreachable_scheduler_is_named_in_the_error():
    started = time.perf_counter()
    with pytest.raises(ConnectionError, match=r"scheduler must answer within 0.5 s; got tcp://127.*, where none did"):
        cluster.check_available(unused_address(), timeout=0.5)
    assert time.perf_counter() - started < cluster.CONNECT_TIMEOUT / 2


@pytest.mark.parametrize("workers", [2, "tcp://10.0.0.1:8786"])
def test_missing_dask_is_named_in_the_error(folder, monkeypatch, workers):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ModuleNotFoundError, match=r"workers must have Dask.*got none; install vijax\[cluster\]"):
        sweep(**AXES, out="map.zarr", workers=workers)


def test_missing_cryptography_is_named_in_the_error(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(ModuleNotFoundError, match=r"workers must have cryptography.*; install vijax\[cluster\]"):
        sweep(**AXES, out="map.zarr", workers=2)
    assert not list(folder.iterdir())
