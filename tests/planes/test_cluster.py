"""Planes on the workers of a cluster: what a task is, lost workers and drivers, what is refused at the door."""

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
from vijax.batch import simulate
from vijax.planes import cluster, store_filling, tiled_store
from vijax.planes import sweep as sweeps
from vijax.planes.sweep import load, sweep

AXES = {"d": np.linspace(0.1, 0.3, 5), "kappa": np.geomspace(3, 400, 4)}
MOST = 6  # cells of a tile, here


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(simulate, "summarise", stand_in)
    monkeypatch.setenv("VIJAX_TILE", str(MOST))
    return tmp_path


@pytest.fixture
def scheduler():
    """One that leads two threads of this process, which know the stand-in."""
    options = {"processes": False, "dashboard_address": None, "protocol": "tcp"}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, **options) as made:
        yield made.scheduler_address


def nobody() -> str:
    """An address of this machine where nobody answers."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{free.getsockname()[1]}"


# --- in a scheduler's workers ----------------------------------------------------------------------------------------


def test_workers_write_what_the_sweep_in_memory_returns_and_go_on_where_it_stopped(folder, scheduler):
    steps = []

    def stop(done, total):
        if done >= 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped:
        sweep(**AXES, out="map.zarr", workers=scheduler, progress=stop)
    assert "of 20 cells are in map.zarr; the same command goes on" in stopped.value.__notes__[0]
    found = sweep(**AXES, out="map.zarr", workers=scheduler, progress=lambda *step: steps.append(step))
    xr.testing.assert_identical(found.load(), sweep(**AXES))
    assert 8 <= steps[0][0] <= 20  # the workers may have finished what they were at
    assert steps[-1] == (20, 20)
    assert sweep(**AXES, out="map.zarr", workers=scheduler, overwrite=True).identical(found)


def test_what_a_worker_raises_is_raised_here(folder, scheduler, monkeypatch):
    def full(tile, found, seconds):
        raise OSError(28, "No space left on device", "somewhere")

    monkeypatch.setattr(tiled_store, "write", full)
    with pytest.raises(OSError, match="No space left") as error:
        sweep(**AXES, out="map.zarr", workers=scheduler)
    assert error.value.filename == "somewhere"
    assert error.value.__notes__[0].startswith("0 of 20 cells are in map.zarr")


def test_tasks_are_taken_as_they_are_needed(scheduler):
    done = cluster.done(abs, itertools.count(), scheduler)
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
def test_a_scheduler_that_is_lost_is_one_line(capfd, seconds):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen([sys.executable, "-c", SCHEDULER], **pipes) as process:
        try:
            done = cluster.done(abs, itertools.count(), process.stdout.readline().strip())
            assert next(done) >= 0
            process.kill()
            time.sleep(seconds)  # in which the client may give up by itself
            with pytest.raises(ConnectionError, match="the scheduler was lost"):
                list(done)
        finally:
            process.kill()
    assert capfd.readouterr().err == ""
    assert not any(logging.getLogger(name).filters for name in ("distributed.client", "distributed.batched"))


# --- a tile that outlives its driver ---------------------------------------------------------------------------------


def test_a_tile_is_as_light_as_its_cells(folder, monkeypatch):
    monkeypatch.setenv("VIJAX_TILE", "1024")
    side = 10_000
    planned = sweeps.plan({"d": np.linspace(0.1, 0.3, side), "kappa": np.geomspace(3, 400, side)})
    with tiled_store.opened(planned, "map.zarr") as plane:
        sent = pickle.dumps(plane.tile(7))
    assert len(sent) < 20_000
    again = pickle.loads(sent)
    assert again.path.is_absolute()
    assert (again.place, again.shapes["P"]) == (plane.place(7), tuple(plane.extents.values()))
    xr.testing.assert_identical(again.planned.cells.quantities["d"], plane.tile(7).planned.cells.quantities["d"])


def test_a_tile_that_is_written_late_does_not_spoil_another_plane(folder):
    with tiled_store.opened(sweeps.plan(AXES), "map.zarr") as plane:
        late = plane.tile(0)
    whole = sweep(**AXES, r=0.4, out="map.zarr", overwrite=True).load()
    with pytest.raises(FileExistsError, match="no longer the store that tile 0"):
        store_filling.fill_tile(1024, late)
    xr.testing.assert_identical(load("map.zarr"), whole)


def test_a_record_that_came_too_late_counts_for_nothing(folder, caplog):
    sweep(**AXES, out="map.zarr")
    record = Path("map.zarr/status/tiles/2.json")
    late = record.read_text()
    whole = sweep(**AXES, out="map.zarr", overwrite=True).load()
    record.write_text(late)
    xr.testing.assert_identical(sweep(**AXES, out="map.zarr").load(), whole)
    assert [said.getMessage() for said in caplog.records] == [
        "tile 2 of map.zarr is run again: its record is of another store"
    ]


# --- processes of this machine ---------------------------------------------------------------------------------------


def fragile(folder: Path, lives: int, task: int) -> None:
    """A task that, the first times it is done, kills who does it."""
    (folder / f"{task}.{os.getpid()}").touch()
    if task == 1 and len(list(folder.glob("1.*"))) <= lives:
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="no such signal there")
def test_a_lost_worker_is_replaced(tmp_path):
    assert sorted(cluster.done(partial(fragile, tmp_path, 1), range(6), 2)) == list(range(6))
    assert len(list(tmp_path.glob("1.*"))) == 2
    assert str(os.getpid()) not in {path.suffix[1:] for path in tmp_path.iterdir()}


@pytest.mark.skipif(sys.platform == "win32", reason="no such signal there")
def test_a_task_that_nobody_survives_is_given_up(tmp_path):
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        pytest.raises(ChildProcessError, match="1 workers were lost, one after another, at the same tile"),
    ):
        list(cluster.done(partial(fragile, tmp_path, 9), range(6), 1))


def answers_without_credentials(port: int) -> bytes:
    """What a port of this machine answers to a request of a page."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(b"GET /info/main/workers.html HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        try:
            return b"".join(iter(partial(connection.recv, 4096), b""))
        except ConnectionError:
            return b""


def blocks_ctrl_c() -> bool:
    """Whether the thread of a task, and so its process, blocks the signal that Ctrl-C sends to all of a terminal."""
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.long
def test_only_this_run_can_connect_to_its_scheduler_and_workers():
    """Any user of this machine reaches the ports, and whoever connects runs code."""
    with cluster._local(1) as client:
        address = client.scheduler_info()["address"]
        assert client.submit(os.getpid).result() != os.getpid()
        assert client.submit(blocks_ctrl_c).result()
        assert not blocks_ctrl_c()
        processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening = [one for process in processes for one in process.net_connections() if one.status == "LISTEN"]
        ports = {one.laddr.port for one in listening}
        strangers = [(address.replace("tls:", "tcp:"), None), (address, distributed.Security.temporary())]
        for place, credentials in strangers:
            with pytest.raises(OSError, match=r"Timed out|TLS certificate does not match|reset by peer"):
                distributed.Client(place, security=credentials, timeout=1, set_as_default=False)
        found = {port: answers_without_credentials(port) for port in ports}
    assert {one.laddr.ip for one in listening} == {"127.0.0.1"}
    assert len(found) >= 4  # a scheduler, a nanny, a worker, and pages that are not there
    assert {answer.partition(b"\r\n")[0] for answer in found.values()} <= {b"", b"HTTP/1.1 404 Not Found"}


# --- at the door -----------------------------------------------------------------------------------------------------

BAD = [
    (0, "workers must be a whole number of at least 1; got 0"),
    (2.5, "workers must be a whole number of at least 1; got 2.5"),
    ("somewhere", "scheduler must be an address such as tcp://10.0.0.1:8786; got 'somewhere'"),
    ("http:/x:1", "scheduler must be an address"),
]


@pytest.mark.parametrize(("workers", "say"), BAD, ids=[str(workers) for workers, _ in BAD])
def test_bad_workers_are_refused(folder, workers, say):
    with pytest.raises(ValueError, match=say) as error:
        sweep(**AXES, out="map.zarr", workers=workers)
    assert "\n" not in str(error.value)
    assert not list(folder.iterdir())


def test_workers_without_a_store_are_refused():
    with pytest.raises(ValueError, match="workers must come with out, the store that they write; got 2 alone"):
        sweep(**AXES, workers=2)


def test_a_scheduler_that_does_not_answer_is_named():
    began = time.perf_counter()
    with pytest.raises(ConnectionError, match=r"scheduler must answer within 0.5 s; got tcp://127.*, where none did"):
        cluster.check(nobody(), answer=0.5)
    assert time.perf_counter() - began < cluster.ANSWER / 2


@pytest.mark.parametrize("workers", [2, "tcp://10.0.0.1:8786"])
def test_what_must_be_installed_is_said(folder, monkeypatch, workers):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ModuleNotFoundError, match=r"workers must have Dask.*got none; install vijax\[cluster\]"):
        sweep(**AXES, out="map.zarr", workers=workers)


def test_what_makes_credentials_must_be_installed(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(ModuleNotFoundError, match=r"workers must have cryptography.*; install vijax\[cluster\]"):
        sweep(**AXES, out="map.zarr", workers=2)
    assert not list(folder.iterdir())
