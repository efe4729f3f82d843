"""Access to the server, its errors, and the page in a notebook."""

import gc
import os
import time

import nbformat
import numpy as np
import pytest
import xarray as xr
from bokeh.util.token import generate_jwt_token
from nbclient import NotebookClient
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

import vijax
from tests.helpers import no_cell_runs
from vijax.cli.main import main
from vijax.explorer import explore
from vijax.explorer.server import request_filter, server, worker
from vijax.explorer.source import Source


@pytest.fixture(scope="module", autouse=True)
def _without_cell_runs():
    """Make maps without cell runs; servers do not depend on cell results."""
    with no_cell_runs():
        yield


@pytest.fixture(scope="module")
def dataset():
    return vijax.sweep(d=np.linspace(0.1, 0.3, 4), kappa=np.geomspace(3, 400, 4))


@pytest.fixture
def serving(dataset, monkeypatch):
    """Start servers without compilation in advance; return the server, its page, and a function for requests."""
    monkeypatch.setattr(server, "precompile", lambda *_: None)
    made = []

    def serve(address, origins=()):
        bokeh_server, threads, page = server.serve(Source(dataset), address, 0, origins)
        made.append((bokeh_server, threads))

        def fetch(url, **further):
            return bokeh_server.io_loop.run_sync(
                lambda: AsyncHTTPClient().fetch(HTTPRequest(url, **further)), timeout=30
            )

        return bokeh_server, page, fetch

    yield serve
    for bokeh_server, threads in made:
        bokeh_server.stop()
        threads.close()


def test_this_machine_alone_is_served_without_a_token(serving):
    bokeh_server, page, fetch = serving("127.0.0.1")
    assert page == f"http://127.0.0.1:{bokeh_server.port}/"
    body = fetch(page).body.decode()
    assert 'id="map"' in body
    assert "https://" not in body.partition("<body>")[0].replace("https://github.com", "")


def test_other_machines_need_the_token_of_the_address(serving):
    bokeh_server, page, fetch = serving("0.0.0.0", ("127.0.0.1:1",))
    base, token = f"http://127.0.0.1:{bokeh_server.port}/", page.partition("token=")[2]
    assert len(token) > 20
    for wrong in ("", "?token=", "?token=guess"):
        with pytest.raises(HTTPClientError, match="403"):
            fetch(base + wrong)
    answer = fetch(f"{base}?token={token}")
    assert 'id="map"' in answer.body.decode()
    assert "HttpOnly" in answer.headers["Set-Cookie"]


def test_connection_from_another_origin_is_refused(serving):
    bokeh_server, _, _ = serving("127.0.0.1")
    request = HTTPRequest(f"ws://127.0.0.1:{bokeh_server.port}/ws", headers={"Origin": "http://elsewhere.example"})
    with pytest.raises(HTTPClientError, match="403"):
        bokeh_server.io_loop.run_sync(lambda: websocket_connect(request, subprotocols=["bokeh", "none"]), timeout=30)


def sessions(server):
    return {session.id for session in server.get_sessions("/")}


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example:{port}", "[::2]:{port}"]
)
@pytest.mark.parametrize("path", ["", "ws", "autoload.js?bokeh-autoload-element=1", "static/js/bokeh.min.js"])
def test_a_request_for_another_host_is_refused(serving, host, path):
    """A foreign host name may resolve to this machine; its pages could read the answers."""
    bokeh_server, page, fetch = serving("127.0.0.1")
    with pytest.raises(HTTPClientError, match="403") as refused:
        fetch(page + path, headers={"Host": host.format(port=bokeh_server.port)})
    assert b"--allow-origin" in refused.value.response.body
    assert not sessions(bokeh_server)


@pytest.mark.parametrize("host", ["localhost:{port}", "LOCALHOST", "[::1]:{port}", "127.0.0.1:8000"])
def test_names_of_this_machine_are_accepted(serving, host):
    """All ports are accepted, since a tunnel has another port."""
    bokeh_server, page, fetch = serving("127.0.0.1")
    assert fetch(page + "static/js/bokeh.min.js", headers={"Host": host.format(port=bokeh_server.port)}).code == 200


def test_allowed_host_is_answered(serving):
    bokeh_server, _, fetch = serving("127.0.0.1", ("Lab.example.org:5006",))
    assert fetch(f"http://127.0.0.1:{bokeh_server.port}/", headers={"Host": "lab.example.org"}).code == 200


def connect(bokeh_server, page, token):
    """Connect to a session like the script of a page."""
    request = HTTPRequest(page.replace("http:", "ws:") + "ws", headers={"Origin": page.rstrip("/")})
    return bokeh_server.io_loop.run_sync(lambda: websocket_connect(request, subprotocols=["bokeh", token]), timeout=30)


@pytest.mark.parametrize("bound", ["MOST_SESSIONS", "MOST_WAITING"])
def test_number_of_pages_is_limited(serving, monkeypatch, bound):
    monkeypatch.setattr(request_filter, bound, 3)
    bokeh_server, page, fetch = serving("127.0.0.1")
    for _ in range(3):
        fetch(page)
    for path in ("", "autoload.js?bokeh-autoload-element=1"):
        with pytest.raises(HTTPClientError, match="503") as refused:
            fetch(page + path)
        assert b"load this page again in 12 seconds" in refused.value.response.body
    assert len(sessions(bokeh_server)) == 3
    for token in ("none", generate_jwt_token("another")):
        with pytest.raises(HTTPClientError, match="503"):
            connect(bokeh_server, page, token)
    connection = connect(bokeh_server, page, generate_jwt_token(min(sessions(bokeh_server)), expiration=60))
    bokeh_server.io_loop.run_sync(connection.read_message)  # first message to a connected page
    if bound == "MOST_WAITING":
        fetch(page)
        assert len(sessions(bokeh_server)) == 4
    connection.close()


def test_garbage_collection_runs_after_several_closed_pages(serving, monkeypatch):
    """The collector runs once for several closed pages, since it scans all objects of the process."""
    monkeypatch.setattr(server, "PAGES_PER_COLLECTION", 3)
    collected = []
    monkeypatch.setattr(gc, "collect", lambda *_: collected.append(1))
    bokeh_server, page, fetch = serving("127.0.0.1")
    for _ in range(4):
        fetch(page)
    monkeypatch.setattr(bokeh_server._tornado, "_unused_session_lifetime_milliseconds", -1)
    bokeh_server.io_loop.run_sync(bokeh_server._tornado._cleanup_sessions)
    assert not sessions(bokeh_server)
    assert len(collected) == 1


def test_an_open_address_needs_an_origin(dataset):
    with pytest.raises(ValueError, match="address must come with allow_origin"):
        server.serve(Source(dataset), "0.0.0.0", 0, ())


@pytest.mark.parametrize(
    ("port", "address", "must"),
    [
        (1, "127.0.0.1", "port must be free at 127.0.0.1; got {port}: .*; 0 is any that is free"),
        (0, "203.0.113.1", "address must be one that this machine has; got 203.0.113.1"),
        (0, "nowhere.invalid", "address must be one that this machine has; got nowhere.invalid"),
    ],
)
def test_unusable_address_or_port_raises(serving, dataset, port, address, must):
    bokeh_server, _, _ = serving("127.0.0.1")
    port = port and bokeh_server.port
    with pytest.raises(OSError, match=must.format(port=port)):
        server.serve(Source(dataset), address, port, ("lab:1",))


@pytest.mark.parametrize("origin", ["*", "*:5006", "http://lab", "lab/", "lab:99999", ""])
def test_invalid_origin_raises(dataset, origin):
    with pytest.raises(ValueError, match="allow_origin must be HOST or HOST:PORT"):
        server.serve(Source(dataset), "0.0.0.0", 0, (origin,))


def test_error_of_a_damaged_store_is_escaped(serving, monkeypatch):
    _, page, fetch = serving("127.0.0.1")

    def broken(self):
        raise ValueError("<script>alert(1)</script>")

    monkeypatch.setattr(Source, "plane", broken)
    body = fetch(page).body.decode()
    assert "&lt;script&gt;alert(1)" in body
    assert "<script>alert(1)" not in body


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError("no\n7 TiB"), "the map must fit in memory; got plane.zarr (no 7 TiB)"),
        (KeyError("d"), "the map must be one that vijax.sweep made; got plane.zarr (KeyError: 'd')"),
        (AttributeError("dims"), "the map must be one that vijax.sweep made; got plane.zarr (AttributeError: dims)"),
        (OSError("gone"), "gone"),
    ],
)
def test_unreadable_store_prints_a_line(monkeypatch, capsys, error, line):
    def fail(path):
        raise error

    monkeypatch.setattr("vijax.explorer.source.load", fail)
    assert main(["explore", "plane.zarr", "--no-browser"]) == 2
    assert capsys.readouterr().err == f"error: source: {line}\n"


@pytest.mark.parametrize("sizes", [(1, 1), (0, 0), (0, 4), (1, 4), (60_000, 60_000)])
def test_unsuitable_map_raises_before_values_are_read(sizes):
    """The check uses the sizes of the map and reads no value."""
    axes = {name: (name, np.zeros(1).repeat(size)) for name, size in zip(("d", "kappa"), sizes, strict=True)}
    values = np.broadcast_to(np.int8(0), sizes)
    with pytest.raises(ValueError, match=r"^source: dataset must have (two axes of|at most 67,108,864 cells)"):
        Source(xr.Dataset({"status": (("d", "kappa"), values)}, axes)).check()


def test_without_bokeh_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(explore, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'vijax\[explore\]'"):
        vijax.explore(browser=False)


def test_a_store_is_read_again_when_a_tile_is_done(tmp_path):
    store = tmp_path / "plane.zarr"
    expected = vijax.sweep(d=np.linspace(0.1, 0.3, 4), kappa=np.geomspace(3, 400, 4), out=store)
    source = Source(store)
    first = source.plane()
    assert source.plane() is first
    record = next((store / "status/tiles").glob("[0-9]*.json"))
    later = time.time_ns() + 10**9
    os.utime(record, ns=(later, later))
    assert source.plane() is not first
    assert (source.plane().dataset["P"].values == expected["P"].values).all()


def test_cancelled_process_ends_and_the_next_job_has_a_new_process():
    process_worker, ticks = worker.Worker(), []

    def until_third(done, total):
        ticks.append(done)
        if len(ticks) == 3:
            raise KeyError("cancelled")

    with pytest.raises(KeyError):
        process_worker.run(time.sleep, (60,), until_third)
    assert process_worker._process is None
    assert process_worker.run(divmod, (7, 2), lambda done, total: None) == (3, 1)
    # Ctrl-C reaches all processes of a group, and the server ends this one.
    assert process_worker.run(os.getpgrp, (), lambda done, total: None) != os.getpgrp()
    with pytest.raises(worker.WorkerError, match="division"):
        process_worker.run(divmod, (7, 0), lambda done, total: None)
    process_worker.close()


@pytest.mark.long
def test_a_notebook_shows_the_page_in_a_frame(dataset, tmp_path):
    vijax.save(dataset, tmp_path / "plane.zarr")
    code = f"import vijax\nds = vijax.load({str(tmp_path / 'plane.zarr')!r})\nvijax.explore(ds, port=0)"
    request_code = (
        "from tornado.httpclient import AsyncHTTPClient\n"
        "from vijax.explorer import notebook\n"
        "address = f'http://127.0.0.1:{notebook._SERVERS[0][0].port}/'\n"
        "b'id=\"map\"' in (await AsyncHTTPClient().fetch(address)).body"
    )
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(item) for item in (code, request_code)])
    NotebookClient(book, timeout=120, kernel_name="python3").execute()
    (frame,) = (item for item in book.cells[0].outputs if "text/html" in item.get("data", {}))
    assert "<iframe" in frame["data"]["text/html"]
    assert book.cells[1].outputs[0]["data"]["text/plain"] == "True"
