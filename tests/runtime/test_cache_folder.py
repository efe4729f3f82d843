"""Programs are kept for the next process, in a folder of the user's that stays small and that nobody else can write."""

import os
import subprocess
import sys
import time

import jax
import pytest

from vijax.runtime import cache_folder

FLIES = """
import sys, pathlib, vijax, jax
folder = pathlib.Path(sys.argv[1])
assert folder.exists() == (sys.argv[2] == "again"), "importing writes nothing"
counts = {"cache_hits": 0, "cache_misses": 0}
def count(name, **_):
    if (kind := name.split("/")[-1]) in counts:
        counts[kind] += 1
jax.monitoring.register_event_listener(count)
jax.jit(lambda x: x + 1)(1.0)  # compiled before vijax is: JAX has looked for its folder
vijax.trajectory(vijax.impact_pair(0.3, None, 0.5), 0.0, 0.3, periods=1)
print(counts["cache_hits"], counts["cache_misses"])
"""


def flown(folder, when="first", **environment):
    """How many programs a new process found, and how many it compiled, with the user's caches in a folder."""
    told = {name: value for name, value in os.environ.items() if "JAX_" not in name} | {"XDG_CACHE_HOME": str(folder)}
    command = [sys.executable, "-c", FLIES, str(folder / "vijax"), when]
    done = subprocess.run(command, env=told | environment, capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr
    return tuple(map(int, done.stdout.split()))


def test_a_process_finds_what_the_one_before_has_compiled(tmp_path):
    hits, misses = flown(tmp_path)
    assert (hits, misses > 0) == (0, True)
    assert (tmp_path / "vijax").stat().st_mode & 0o777 == 0o700
    again, more = flown(tmp_path, "again")
    assert again > 0
    assert more < misses


@pytest.mark.parametrize("environment", [{"JAX_ENABLE_COMPILATION_CACHE": "0"}, {"JAX_COMPILATION_CACHE_DIR": "own"}])
def test_what_jax_is_told_stands(tmp_path, environment):
    folder = tmp_path / "cache"
    told = {name: str(tmp_path / value) if value == "own" else value for name, value in environment.items()}
    flown(folder, **told)
    assert not folder.exists()


def test_the_oldest_files_go(tmp_path):
    now = time.time()
    for name, age in (("old", 300), ("read", 200), ("new", 100)):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (now - age, now - age))
    os.utime(tmp_path / "read", (now, now - 200))
    cache_folder.trim(tmp_path, 300)
    assert len(list(tmp_path.iterdir())) == 3
    cache_folder.trim(tmp_path, 250)
    assert {path.name for path in tmp_path.iterdir()} == {"read", "new"}
    cache_folder.trim(tmp_path, 100)
    assert [path.name for path in tmp_path.iterdir()] == ["read"]


@pytest.fixture
def untold():
    """JAX as a program has it that names no folder."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.parametrize("spoil", ["file", "open"])
def test_a_folder_that_cannot_be_trusted_is_not_used(tmp_path, monkeypatch, untold, spoil):
    folder = tmp_path / "vijax"
    if spoil == "file":
        folder.write_text("")
    else:
        folder.mkdir()
        folder.chmod(0o777)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache_folder.keep_programs.__wrapped__()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_a_user_without_a_home_keeps_nothing(monkeypatch, untold):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(cache_folder.Path, "home", homeless)
    cache_folder.keep_programs.__wrapped__()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_the_folder_is_that_of_compiled_programs(tmp_path):
    before = {name: jax.config.values[name] for name in ("jax_compilation_cache_dir", "jax_enable_compilation_cache")}
    try:
        for asked, kept, expected in ((str(tmp_path), True, tmp_path), (str(tmp_path), False, None)):
            jax.config.update("jax_compilation_cache_dir", asked)
            jax.config.update("jax_enable_compilation_cache", kept)
            assert cache_folder.kept() == expected
        jax.config.update("jax_enable_compilation_cache", True)
        for asked in (None, "gs://bucket/compiled"):
            jax.config.update("jax_compilation_cache_dir", asked)
            assert cache_folder.kept() is None
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
