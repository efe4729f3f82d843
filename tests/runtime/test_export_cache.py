"""A program is traced once, stored with its dependencies, read back bit for bit, and traced anew if that fails."""

import ast
import hashlib
import os
import pickle
import re
import shutil
import stat
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import requires
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

import vijax
from vijax.model.records import State
from vijax.runtime.compilation import cache_folder, export_cache, xla
from vijax.simulation.cell.cell import Plan

PACKAGE = Path(vijax.__file__).parent
X = jnp.linspace(0.1, 2.0, 7)


class Work:
    """A function of a dictionary that counts how often it is traced."""

    def __init__(self):
        self.traced = 0

    def __call__(self, inputs):
        """A wave."""
        self.traced += 1
        return jnp.sin(inputs["x"]) / inputs["y"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    place = tmp_path / "compiled"
    monkeypatch.setattr(cache_folder, "program_folder", lambda: place)
    return place


def called(name="wave", x=X):
    """Return the result of a fresh program, as in a new process, and the number of its traces."""
    work = Work()
    program = export_cache.TracedProgram(work, name)
    inputs = {"x": x, "y": jnp.asarray(3.0, x.dtype)}
    first = np.asarray(program(inputs))
    np.testing.assert_array_equal(program(inputs), first)
    np.testing.assert_allclose(first, np.sin(np.asarray(x)) / 3.0, rtol=1e-6 if x.dtype == "float32" else 1e-15)
    return first, work.traced


def test_a_pickled_plan_names_the_same_program():
    plan = Plan(until="window", deep=True)
    assert str(pickle.loads(pickle.dumps(plan))) == str(plan) != str(Plan(deep=True))
    assert str(pickle.loads(pickle.dumps(Plan()))) == str(Plan())


def test_the_second_process_does_not_trace(folder):
    first, times = called()
    again, none = called()
    assert (times, none) == (1, 0)
    np.testing.assert_array_equal(again, first)
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("changed", [{"name": "tide"}, {"x": X[:5]}, {"x": X.astype("float32")}])
def test_another_name_or_shape_is_another_program(folder, changed):
    called()
    assert called(**changed)[1] == 1
    assert called(**changed)[1] == 0
    assert len(list(folder.iterdir())) == 2


class Theirs(eqx.Module):
    """A record of a user; its source is not part of the digest."""

    y: jax.Array


def test_programs_of_foreign_records_are_not_stored(folder):
    """The methods of the record may have changed since."""
    for _ in range(2):
        work = Work()
        export_cache.TracedProgram(lambda x, theirs, work=work: work({"x": x, "y": theirs.y}), "wave")(X, Theirs(X))
        assert work.traced == 1
    assert not folder.exists()
    export_cache.TracedProgram(lambda x, ours: ours.u * x, "wave")(X, State(X, X, X, X, X))
    assert len(list(folder.iterdir())) == 1


def test_a_program_without_kernels_is_another_program(folder, monkeypatch):
    called()
    monkeypatch.setattr(xla, "KERNELS", not xla.KERNELS)
    assert called()[1] == 1
    assert len(list(folder.iterdir())) == 2


def test_a_program_for_a_gpu_is_stored_by_the_name_of_its_platform(monkeypatch):
    """JAX names the platform of an array gpu, and the platform of an export cuda."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(export_cache.export, "default_export_platform", lambda: "cuda")
    assert export_cache._platform([np.zeros(3)]) == "cuda"
    assert export_cache._platform([X]) == "cpu"


def test_a_program_for_another_platform_is_another_program(folder, monkeypatch):
    """This holds on the CPU of a machine with a GPU, too."""
    called()
    monkeypatch.setattr(xla, "platform", lambda: "gpu")
    assert called()[1] == 1
    assert len(list(folder.iterdir())) == 2


@pytest.mark.parametrize("stored", [True, False])
def test_threads_that_call_a_program_at_once_compile_it_once(tmp_path, monkeypatch, stored):
    monkeypatch.setattr(cache_folder, "program_folder", lambda: tmp_path if stored else None)
    program = export_cache.TracedProgram(
        lambda x: jax.lax.fori_loop(0, 3, lambda _, y: jnp.sin(y) + jnp.cos(y), x), "loop"
    )
    compiled, ready = [], threading.Barrier(4)

    def count(event, *_, fun_name="", **__):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(fun_name)

    def call(_):
        ready.wait()
        return np.asarray(program(X))

    monitoring.register_event_duration_secs_listener(count)
    try:
        with ThreadPoolExecutor(4) as pool:
            results = list(pool.map(call, range(4)))
    finally:
        monitoring.unregister_event_duration_listener(count)
    assert len(compiled) == 1
    for result in results:
        np.testing.assert_array_equal(result, results[0])


def test_a_change_in_any_folder_changes_the_digest(tmp_path):
    package = tmp_path / "vijax"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    digest = export_cache.source_digest.__wrapped__
    digests = {digest(), digest(package)}
    assert len(digests) == 1  # the same sources in another folder
    folders = [package, *sorted(path.parent for path in package.glob("*/__init__.py"))]
    assert len(folders) > 5
    for folder in folders:
        with (folder / "__init__.py").open("a", encoding="utf-8") as file:
            file.write("# changed\n")
        digests.add(digest(package))
    assert len(digests) == len(folders) + 1


def test_all_packages_that_a_trace_uses_are_in_the_digest(monkeypatch):
    versioned = []
    monkeypatch.setattr(export_cache, "version", lambda name: versioned.append(name) or "1")
    export_cache.source_digest.__wrapped__()
    sources = {path for folder in ("simulation", "impact") for path in (PACKAGE / folder).rglob("*.py")}
    sources |= {path for path in PACKAGE.rglob("*.py") if "jitted" in path.read_text()}
    nodes = [node for path in sources for node in ast.walk(ast.parse(path.read_text()))]
    tops = {alias.name.split(".")[0] for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    tops |= {node.module.split(".")[0] for node in nodes if isinstance(node, ast.ImportFrom)}
    # Packages that modules with programs import, and the requirements of these packages.
    waiting, required = [top for top in tops - sys.stdlib_module_names - {"vijax"}], set()
    assert {"jax", "diffrax"} <= set(waiting)
    while waiting:
        name = waiting.pop()
        required.add(name)
        needed = [
            re.split(r"[^\w.-]", line)[0].replace("-", "_") for line in requires(name) or [] if "extra ==" not in line
        ]
        waiting += [package for package in needed if package not in required]
    assert required - {"scipy", "typing_extensions", "wadler_lindig"} == set(
        versioned
    )  # special functions, types and print


def test_other_sources_are_other_programs(folder, monkeypatch):
    called()
    monkeypatch.setattr(export_cache, "source_digest", lambda: "other")
    assert called()[1] == 1


@pytest.mark.parametrize("damage", [lambda content: content[:-9], lambda content: content[:-1] + b"?", lambda _: b""])
def test_a_damaged_file_is_written_anew(folder, damage):
    called()
    (path,) = folder.iterdir()
    content = path.read_bytes()
    path.write_bytes(damage(content))
    assert called()[1] == 1
    assert called()[1] == 0
    assert [file.name for file in folder.iterdir()] == [path.name]


class Payload:
    """An object that notes that it was unpickled."""

    def __reduce__(self):
        return RAN.append, (1,)


RAN: list[int] = []


def sign(path, body):
    """Return the digest that a reader expects before the content of a file."""
    return export_cache._signed(path, body)


def pickled(path, _):
    content = pickle.dumps(Payload())
    return [hashlib.sha256(content).digest() + content, sign(path, content) + content]


def malformed(path, content):
    """Return files with the right digest, and a program or structure that cannot be rebuilt."""
    body, size = content[32:], export_cache._LENGTH
    program = body[size + int.from_bytes(body[:size], "little") :]
    structures = (
        b'["os:system"]',
        b'["vijax.runtime.files:os"]',
        b'["vijax.nowhere:State"]',
        b'"leaf',
        b"[[]]",
        b"\xff",
    )
    bodies = [len(text).to_bytes(size, "little") + text + program for text in structures]
    return [sign(path, part) + part for part in (*bodies, body[:99], bytes(99), b"")]


@pytest.mark.parametrize("contents", [pickled, malformed])
def test_a_file_that_is_no_program_is_written_anew_and_runs_nothing(folder, contents):
    called()
    (path,) = folder.iterdir()
    original = path.read_bytes()
    for content in contents(path, original):
        path.write_bytes(content)
        assert called()[1] == 1
        assert called()[1] == 0
    assert not RAN


def test_the_file_of_another_program_is_written_anew(folder):
    called()
    (wave,) = folder.iterdir()
    export_cache.TracedProgram(lambda x: (x, x + 1), "pair")(X)
    (pair,) = set(folder.iterdir()) - {wave}
    pair.write_bytes(wave.read_bytes())
    same, after = export_cache.TracedProgram(lambda x: (x, x + 1), "pair")(X)
    np.testing.assert_array_equal(after, X + 1)
    np.testing.assert_array_equal(same, X)


def test_a_pipe_in_place_of_a_file_does_not_block(folder):
    called()
    (path,) = folder.iterdir()
    path.unlink()
    os.mkfifo(path)
    assert called()[1] == 1
    assert called()[1] == 0


def test_a_file_is_for_this_user_alone(folder):
    called()
    (path,) = folder.iterdir()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_without_a_folder_a_program_is_traced_in_all_processes(tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.touch()
    for place in (file, None):
        monkeypatch.setattr(cache_folder, "program_folder", lambda place=place: place)
        assert called()[1] == called()[1] == 1
    assert file.read_bytes() == b""
