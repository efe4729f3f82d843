"""Programs are stored for later processes, in a small folder of the user that no other user can write."""

import os
import stat
import subprocess
import sys
import time

import jax
import pytest

from vijax.runtime.compilation import cache_folder

SIMULATES = """
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


def cache_counts(folder, when="first", **environment):
    """Return how many programs a new process reads and how many it compiles, with the user's caches in a folder."""
    variables = {name: value for name, value in os.environ.items() if "JAX_" not in name} | {
        "XDG_CACHE_HOME": str(folder)
    }
    command = [sys.executable, "-c", SIMULATES, str(folder / "vijax"), when]
    result = subprocess.run(command, env=variables | environment, capture_output=True, text=True, check=False)
    assert not result.returncode, result.stderr
    return tuple(map(int, result.stdout.split()))


def test_a_process_reads_programs_compiled_by_an_earlier_process(tmp_path):
    hits, misses = cache_counts(tmp_path)
    assert (hits, misses > 0) == (0, True)
    assert (tmp_path / "vijax").stat().st_mode & 0o777 == 0o700
    again, more = cache_counts(tmp_path, "again")
    assert again > 0
    assert more < misses


@pytest.mark.parametrize("environment", [{"JAX_ENABLE_COMPILATION_CACHE": "0"}, {"JAX_COMPILATION_CACHE_DIR": "own"}])
def test_settings_of_the_jax_cache_are_respected(tmp_path, environment):
    folder = tmp_path / "cache"
    variables = {name: str(tmp_path / value) if value == "own" else value for name, value in environment.items()}
    cache_counts(folder, **variables)
    assert not folder.exists()


def program(name):
    """Return the file name that JAX gives to a compiled program."""
    return f"jit_{name}-{name[0] * 64}-cache"


# Digits of a digest in hexadecimal.
AGES = {"a": 300, "b": 200, "c": 100}


def fill(folder):
    """Make a folder of three programs; the second was read last."""
    now = time.time()
    folder.mkdir(exist_ok=True)
    for name, age in AGES.items():
        (folder / program(name)).write_bytes(bytes(100))
        os.utime(folder / program(name), (now - age, now - age))
    os.utime(folder / program("b"), (now, now - 200))


def names(folder):
    return {path.name for path in folder.iterdir()}


def test_trimming_deletes_the_oldest_programs(tmp_path):
    fill(tmp_path)
    cache_folder.trim(tmp_path, 300)
    assert names(tmp_path) == {program(name) for name in "abc"}
    cache_folder.trim(tmp_path, 250)
    assert names(tmp_path) == {program(name) for name in "bc"}
    cache_folder.trim(tmp_path, 100)
    assert names(tmp_path) == {program("b")}


def test_trimming_deletes_traced_and_partial_programs(tmp_path):
    digest = 64 * "d"
    for name in (f"traced-{digest}", f".traced-{digest}.123.part", f"jit_d-{digest}-atime"):
        (tmp_path / name).write_bytes(bytes(100))
    cache_folder.trim(tmp_path, 0)
    assert not names(tmp_path)


def test_no_other_file_is_deleted(tmp_path):
    others = (
        "thesis.tex",
        "costs.json",
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
    fill(tmp_path)
    cache_folder.trim(tmp_path, 0)
    assert names(tmp_path) == {*others, "target", program("e"), program("f")}


def test_nothing_is_deleted_through_a_link(tmp_path):
    fill(tmp_path / "of the user")
    (tmp_path / "vijax").symlink_to(tmp_path / "of the user")
    cache_folder.trim(tmp_path / "vijax", 0)
    assert len(names(tmp_path / "of the user")) == 3


@pytest.fixture
def no_cache_folder():
    """JAX without a cache folder, as in a program that sets none."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", before)


def change_user(path):
    """Give a file to another user; skip the test if this process must not."""
    try:
        os.chown(path, 65534, -1, follow_symlinks=False)
    except PermissionError:
        pytest.skip("only root can give files away")


def unsafe_file(folder):
    folder.write_text("")


def unsafe_mode(folder):
    folder.mkdir()
    folder.chmod(0o777)


def unsafe_user(folder):
    folder.mkdir()
    change_user(folder)


def unsafe_link(folder):
    (folder.parent / "target").mkdir()
    folder.symlink_to(folder.parent / "target")
    change_user(folder)


UNSAFE_FOLDERS = [unsafe_file, unsafe_mode, unsafe_user, unsafe_link]


@pytest.mark.parametrize("make_unsafe", UNSAFE_FOLDERS)
def test_an_unsafe_folder_is_not_used(tmp_path, monkeypatch, no_cache_folder, make_unsafe):
    make_unsafe(tmp_path / "vijax")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache_folder.keep_programs.__wrapped__()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def unsafe_pipe(path):
    os.mkfifo(path)


def unsafe_program_link(path):
    path.symlink_to(path.parent / "elsewhere")


def unsafe_program_user(path):
    path.write_bytes(b"")
    change_user(path)


def unsafe_program_mode(path):
    path.parent.chmod(0o755)
    path.write_bytes(b"")
    path.chmod(0o666)


UNSAFE_PROGRAMS = [unsafe_pipe, unsafe_program_link, unsafe_program_user, unsafe_program_mode]


@pytest.mark.parametrize("make_unsafe", UNSAFE_PROGRAMS)
def test_a_folder_with_an_unsafe_program_is_not_used(tmp_path, monkeypatch, no_cache_folder, caplog, make_unsafe):
    """JAX reads every file in its folder."""
    folder = tmp_path / "vijax"
    folder.mkdir(mode=0o700)
    make_unsafe(folder / program("a"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache_folder.keep_programs.__wrapped__()
    assert jax.config.values["jax_compilation_cache_dir"] is None
    assert f"got {program('a')}" in caplog.text


@pytest.mark.parametrize("make_unsafe", UNSAFE_PROGRAMS)
def test_an_unsafe_file_is_not_read(tmp_path, make_unsafe):
    (tmp_path / "elsewhere").write_bytes(b"")
    make_unsafe(tmp_path / program("a"))
    assert cache_folder.read(tmp_path / program("a")) is None


def test_a_file_of_any_mode_is_read_from_a_private_folder(tmp_path):
    """JAX creates files with the user's mask, which may let the group write."""
    folder = tmp_path / "vijax"
    folder.mkdir(mode=0o700)
    (folder / program("a")).write_bytes(b"content")
    (folder / program("a")).chmod(0o664)
    assert cache_folder.read(folder / program("a")) == b"content"


def test_a_jax_folder_that_others_can_write_is_neither_read_nor_written(tmp_path, no_cache_folder, caplog):
    tmp_path.chmod(0o777)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    assert cache_folder.program_folder() is None
    assert cache_folder.program_folder() is None
    assert caplog.text.count("nobody else can write") == 1


def test_a_missing_jax_folder_is_made_for_this_user_alone(tmp_path, no_cache_folder):
    folder = tmp_path / "above" / "programs"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    assert cache_folder.program_folder() == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_no_programs_are_stored_without_a_home_directory(monkeypatch, no_cache_folder):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(cache_folder.Path, "home", homeless)
    cache_folder.keep_programs.__wrapped__()
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_traced_programs_are_stored_with_compiled_programs(tmp_path):
    before = {name: jax.config.values[name] for name in ("jax_compilation_cache_dir", "jax_enable_compilation_cache")}
    try:
        for setting, enabled, expected in ((str(tmp_path), True, tmp_path), (str(tmp_path), False, None)):
            jax.config.update("jax_compilation_cache_dir", setting)
            jax.config.update("jax_enable_compilation_cache", enabled)
            assert cache_folder.program_folder() == expected
        jax.config.update("jax_enable_compilation_cache", True)
        for setting in (None, "gs://bucket/compiled"):
            jax.config.update("jax_compilation_cache_dir", setting)
            assert cache_folder.program_folder() is None
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
