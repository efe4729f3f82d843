"""Programs are kept for the next process, in a folder of the user's that stays small and that nobody else can write."""

import os
import stat
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


def program(name):
    """The name of a file as JAX gives it to a compiled program."""
    return f"jit_{name}-{name[0] * 64}-cache"


# Digits of a digest in hexadecimal.
AGES = {"a": 300, "b": 200, "c": 100}


def filled(folder):
    """Make a folder of three programs, of which the second was read last."""
    now = time.time()
    folder.mkdir(exist_ok=True)
    for name, age in AGES.items():
        (folder / program(name)).write_bytes(bytes(100))
        os.utime(folder / program(name), (now - age, now - age))
    os.utime(folder / program("b"), (now, now - 200))


def names(folder):
    return {path.name for path in folder.iterdir()}


def test_the_oldest_programs_go(tmp_path):
    filled(tmp_path)
    cache_folder.trim(tmp_path, 300)
    assert names(tmp_path) == {program(name) for name in "abc"}
    cache_folder.trim(tmp_path, 250)
    assert names(tmp_path) == {program(name) for name in "bc"}
    cache_folder.trim(tmp_path, 100)
    assert names(tmp_path) == {program("b")}


def test_traced_programs_and_those_half_written_go_too(tmp_path):
    digest = 64 * "d"
    for name in (f"traced-{digest}", f".traced-{digest}.123.part", f"jit_d-{digest}-atime"):
        (tmp_path / name).write_bytes(bytes(100))
    cache_folder.trim(tmp_path, 0)
    assert not names(tmp_path)


def test_no_other_file_is_deleted(tmp_path):
    others = (
        "thesis.tex",
        "paces.json",
        ".lockfile",
        "traced-",
        "model-cache",
        f"traced-{63 * 'a'}",
        f"x-{64 * 'g'}-cache",
    )
    for name in others:
        (tmp_path / name).write_bytes(bytes(1000))
    target = tmp_path / "target"
    target.write_bytes(bytes(1000))
    (tmp_path / program("e")).symlink_to(target)
    (tmp_path / program("f")).mkdir()
    filled(tmp_path)
    cache_folder.trim(tmp_path, 0)
    assert names(tmp_path) == {*others, "target", program("e"), program("f")}


def test_nothing_is_deleted_through_a_link(tmp_path):
    filled(tmp_path / "of the user")
    (tmp_path / "vijax").symlink_to(tmp_path / "of the user")
    cache_folder.trim(tmp_path / "vijax", 0)
    assert len(names(tmp_path / "of the user")) == 3


@pytest.fixture
def untold():
    """JAX as a program has it that names no folder."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", before)


def belongs_to_nobody(path):
    """Give a file to another user, where this process has the right to do so."""
    try:
        os.chown(path, 65534, -1, follow_symlinks=False)
    except PermissionError:
        pytest.skip("only root can give files away")


def spoiled_file(folder):
    folder.write_text("")


def spoiled_mode(folder):
    folder.mkdir()
    folder.chmod(0o777)


def spoiled_owner(folder):
    folder.mkdir()
    belongs_to_nobody(folder)


def spoiled_link(folder):
    (folder.parent / "target").mkdir()
    folder.symlink_to(folder.parent / "target")
    belongs_to_nobody(folder)


SPOILED = [spoiled_file, spoiled_mode, spoiled_owner, spoiled_link]


@pytest.mark.parametrize("spoil", SPOILED)
def test_a_folder_that_cannot_be_trusted_is_not_used(tmp_path, monkeypatch, untold, spoil):
    spoil(tmp_path / "vijax")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache_folder.keep_programs.__wrapped__()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def spoiled_pipe(path):
    os.mkfifo(path)


def spoiled_program_link(path):
    path.symlink_to(path.parent / "elsewhere")


def spoiled_program_owner(path):
    path.write_bytes(b"")
    belongs_to_nobody(path)


def spoiled_program_mode(path):
    path.parent.chmod(0o755)
    path.write_bytes(b"")
    path.chmod(0o666)


SPOILED_PROGRAMS = [spoiled_pipe, spoiled_program_link, spoiled_program_owner, spoiled_program_mode]


@pytest.mark.parametrize("spoil", SPOILED_PROGRAMS)
def test_a_folder_with_a_program_that_cannot_be_trusted_is_not_used(tmp_path, monkeypatch, untold, caplog, spoil):
    """JAX reads whatever file there is."""
    folder = tmp_path / "vijax"
    folder.mkdir(mode=0o700)
    spoil(folder / program("a"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache_folder.keep_programs.__wrapped__()
    assert jax.config.values["jax_compilation_cache_dir"] is None
    assert f"got {program('a')}" in caplog.text


@pytest.mark.parametrize("spoil", SPOILED_PROGRAMS)
def test_a_file_that_cannot_be_trusted_is_not_read(tmp_path, spoil):
    (tmp_path / "elsewhere").write_bytes(b"")
    spoil(tmp_path / program("a"))
    assert cache_folder.read(tmp_path / program("a")) is None


def test_a_file_of_a_closed_folder_is_read_whatever_its_mode(tmp_path):
    """JAX makes files by the user's mask, which may let the group write."""
    folder = tmp_path / "vijax"
    folder.mkdir(mode=0o700)
    (folder / program("a")).write_bytes(b"content")
    (folder / program("a")).chmod(0o664)
    assert cache_folder.read(folder / program("a")) == b"content"


def test_a_folder_given_to_jax_that_others_can_write_is_neither_read_nor_written(tmp_path, untold, caplog):
    tmp_path.chmod(0o777)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    assert cache_folder.kept() is None
    assert cache_folder.kept() is None
    assert caplog.text.count("nobody else can write") == 1


def test_a_folder_given_to_jax_that_is_missing_is_made_for_this_user_alone(tmp_path, untold):
    folder = tmp_path / "above" / "programs"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    assert cache_folder.kept() == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


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
