"""Who may ask the server, what it says where it cannot serve, and the page in a notebook."""

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
from vijax.explorer import door, request_filter, server, worker
from vijax.explorer.source import Source


@pytest.fixture(scope="module", autouse=True)
def _at_once():
    """Servers show a map whatever its cells do, so that no cell has to run."""
    with no_cell_runs():
        yield


@pytest.fixture(scope="module")
def dataset():
    return vijax.sweep(d=np.linspace(0.1, 0.3, 4), kappa=np.geomspace(3, 400, 4))


@pytest.fixture
def serving(dataset, monkeypatch):
    """Make servers of the map, none of which compiles ahead; give each, a page of it, and how to ask it."""
    monkeypatch.setattr(server, "warm", lambda *_: None)
    made = []

    def serve(address, origins=()):
        one, crew, page = server.serve(Source(dataset), address, 0, origins)
        made.append((one, crew))

        def ask(url, **further):
            return one.io_loop.run_sync(lambda: AsyncHTTPClient().fetch(HTTPRequest(url, **further)), timeout=30)

        return one, page, ask

    yield serve
    for one, crew in made:
        one.stop()
        crew.close()


def test_this_machine_alone_is_served_without_a_token(serving):
    one, page, ask = serving("127.0.0.1")
    assert page == f"http://127.0.0.1:{one.port}/"
    body = ask(page).body.decode()
    assert 'id="map"' in body
    assert "https://" not in body.partition("<body>")[0].replace("https://github.com", "")


def test_others_need_the_token_of_the_address(serving):
    one, page, ask = serving("0.0.0.0", ("127.0.0.1:1",))
    base, token = f"http://127.0.0.1:{one.port}/", page.partition("token=")[2]
    assert len(token) > 20
    for wrong in ("", "?token=", "?token=guess"):
        with pytest.raises(HTTPClientError, match="403"):
            ask(base + wrong)
    answer = ask(f"{base}?token={token}")
    assert 'id="map"' in answer.body.decode()
    assert "HttpOnly" in answer.headers["Set-Cookie"]


def test_a_page_from_elsewhere_may_not_ask(serving):
    one, _, _ = serving("127.0.0.1")
    asked = HTTPRequest(f"ws://127.0.0.1:{one.port}/ws", headers={"Origin": "http://elsewhere.example"})
    with pytest.raises(HTTPClientError, match="403"):
        one.io_loop.run_sync(lambda: websocket_connect(asked, subprotocols=["bokeh", "none"]), timeout=30)


def sessions(server):
    return {session.id for session in server.get_sessions("/")}


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example:{port}", "[::2]:{port}"]
)
@pytest.mark.parametrize("path", ["", "ws", "autoload.js?bokeh-autoload-element=1", "static/js/bokeh.min.js"])
def test_a_request_for_another_host_is_refused(serving, host, path):
    """A foreign name that points to this machine: its pages could read what is answered."""
    one, page, ask = serving("127.0.0.1")
    with pytest.raises(HTTPClientError, match="403") as refused:
        ask(page + path, headers={"Host": host.format(port=one.port)})
    assert b"--allow-origin" in refused.value.response.body
    assert not sessions(one)


@pytest.mark.parametrize("host", ["localhost:{port}", "LOCALHOST", "[::1]:{port}", "127.0.0.1:8000"])
def test_this_machine_is_known_by_its_names(serving, host):
    """By any port: a tunnel has another."""
    one, page, ask = serving("127.0.0.1")
    assert ask(page + "static/js/bokeh.min.js", headers={"Host": host.format(port=one.port)}).code == 200


def test_a_host_that_is_allowed_is_answered(serving):
    one, _, ask = serving("127.0.0.1", ("Lab.example.org:5006",))
    assert ask(f"http://127.0.0.1:{one.port}/", headers={"Host": "lab.example.org"}).code == 200


def connect(one, page, token):
    """Connect to a session as the script of a page does."""
    asked = HTTPRequest(page.replace("http:", "ws:") + "ws", headers={"Origin": page.rstrip("/")})
    return one.io_loop.run_sync(lambda: websocket_connect(asked, subprotocols=["bokeh", token]), timeout=30)


@pytest.mark.parametrize("bound", ["MOST_SESSIONS", "MOST_WAITING"])
def test_there_are_so_many_pages_at_most(serving, monkeypatch, bound):
    monkeypatch.setattr(request_filter, bound, 3)
    one, page, ask = serving("127.0.0.1")
    for _ in range(3):
        ask(page)
    for path in ("", "autoload.js?bokeh-autoload-element=1"):
        with pytest.raises(HTTPClientError, match="503") as refused:
            ask(page + path)
        assert b"load this page again in 12 seconds" in refused.value.response.body
    assert len(sessions(one)) == 3
    for token in ("none", generate_jwt_token("another")):
        with pytest.raises(HTTPClientError, match="503"):
            connect(one, page, token)
    connection = connect(one, page, generate_jwt_token(min(sessions(one)), expiration=60))
    one.io_loop.run_sync(connection.read_message)  # what a page is sent when it is connected
    if bound == "MOST_WAITING":
        ask(page)
        assert len(sessions(one)) == 4
    connection.close()


def test_the_end_of_a_page_collects_no_garbage(serving, monkeypatch):
    """Only that of every so-many-th does: the collector looks at all objects of the process."""
    monkeypatch.setattr(server, "COLLECTED", 3)
    collected = []
    monkeypatch.setattr(gc, "collect", lambda *_: collected.append(1))
    one, page, ask = serving("127.0.0.1")
    for _ in range(4):
        ask(page)
    monkeypatch.setattr(one._tornado, "_unused_session_lifetime_milliseconds", -1)
    one.io_loop.run_sync(one._tornado._cleanup_sessions)
    assert not sessions(one)
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
def test_where_no_server_can_listen_is_said_in_a_line(serving, dataset, port, address, must):
    one, _, _ = serving("127.0.0.1")
    port = port and one.port
    with pytest.raises(OSError, match=must.format(port=port)):
        server.serve(Source(dataset), address, port, ("lab:1",))


@pytest.mark.parametrize("origin", ["*", "*:5006", "http://lab", "lab/", "lab:99999", ""])
def test_an_origin_is_one_machine(dataset, origin):
    with pytest.raises(ValueError, match="allow_origin must be HOST or HOST:PORT"):
        server.serve(Source(dataset), "0.0.0.0", 0, (origin,))


def test_what_a_damaged_store_says_is_text(serving, monkeypatch):
    _, page, ask = serving("127.0.0.1")

    def broken(self):
        raise ValueError("<script>alert(1)</script>")

    monkeypatch.setattr(Source, "plane", broken)
    body = ask(page).body.decode()
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
def test_a_store_that_cannot_be_read_is_one_line(monkeypatch, capsys, error, line):
    def fail(path):
        raise error

    monkeypatch.setattr("vijax.explorer.source.load", fail)
    assert main(["explore", "plane.zarr", "--no-browser"]) == 2
    assert capsys.readouterr().err == f"error: source: {line}\n"


@pytest.mark.parametrize("sizes", [(1, 1), (0, 0), (0, 4), (1, 4), (60_000, 60_000)])
def test_a_map_that_cannot_be_shown_is_one_line(sizes):
    """Of which no value is read."""
    axes = {name: (name, np.zeros(1).repeat(size)) for name, size in zip(("d", "kappa"), sizes, strict=True)}
    values = np.broadcast_to(np.int8(0), sizes)
    with pytest.raises(ValueError, match=r"^source: dataset must have (two axes of|at most 67,108,864 cells)"):
        Source(xr.Dataset({"status": (("d", "kappa"), values)}, axes)).check()


def test_without_bokeh_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(door, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'vijax\[explore\]'"):
        vijax.explore(browser=False)


def test_a_store_is_read_again_when_a_tile_is_done(tmp_path):
    store = tmp_path / "plane.zarr"
    whole = vijax.sweep(d=np.linspace(0.1, 0.3, 4), kappa=np.geomspace(3, 400, 4), out=store)
    source = Source(store)
    first = source.plane()
    assert source.plane() is first
    record = next((store / "status/tiles").glob("[0-9]*.json"))
    later = time.time_ns() + 10**9
    os.utime(record, ns=(later, later))
    assert source.plane() is not first
    assert (source.plane().dataset["P"].values == whole["P"].values).all()


def test_a_process_that_is_cancelled_ends_and_the_next_work_has_another():
    one, ticks = worker.Worker(), []

    def until_third(done, total):
        ticks.append(done)
        if len(ticks) == 3:
            raise KeyError("cancelled")

    with pytest.raises(KeyError):
        one.run(time.sleep, (60,), until_third)
    assert one._process is None
    assert one.run(divmod, (7, 2), lambda done, total: None) == (3, 1)
    # Ctrl-C reaches all processes of a group, and the server ends this one.
    assert one.run(os.getpgrp, (), lambda done, total: None) != os.getpgrp()
    with pytest.raises(worker.WorkerError, match="division"):
        one.run(divmod, (7, 0), lambda done, total: None)
    one.close()


@pytest.mark.long
def test_a_notebook_shows_the_page_in_a_frame(dataset, tmp_path):
    vijax.save(dataset, tmp_path / "plane.zarr")
    code = f"import vijax\nds = vijax.load({str(tmp_path / 'plane.zarr')!r})\nvijax.explore(ds, port=0)"
    ask = (
        "from tornado.httpclient import AsyncHTTPClient\n"
        "from vijax.explorer import notebook\n"
        "address = f'http://127.0.0.1:{notebook._KEPT[0][0].port}/'\n"
        "b'id=\"map\"' in (await AsyncHTTPClient().fetch(address)).body"
    )
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(one) for one in (code, ask)])
    NotebookClient(book, timeout=120, kernel_name="python3").execute()
    (frame,) = (one for one in book.cells[0].outputs if "text/html" in one.get("data", {}))
    assert "<iframe" in frame["data"]["text/html"]
    assert book.cells[1].outputs[0]["data"]["text/plain"] == "True"
