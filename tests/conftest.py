"""Settings of all tests: strict dtype promotion, and property tests that CI draws the same way each time."""

import ctypes
import gc
import math
import os
from pathlib import Path

import jax
import pytest
from hypothesis import settings

import vijax  # noqa: F401  switches x64 on before a test makes its first array
from tests import seconds
from tests.xla_flags import supported_flags
from vijax.runtime.garbage_collection import RELAXED_THRESHOLDS

# XLA reads its flags when JAX first computes, here and in the scripts that tests start. Tests mostly compile, and with
# these flags a program compiles in a third of the time. Flags that XLA_FLAGS holds already come last and win.
_FLAGS = (
    "--xla_backend_optimization_level=0",
    "--xla_cpu_use_fusion_emitters=false",
    # Workers keep the cores busy already; cutting a program into parts to compile them side by side costs a tenth.
    "--xla_cpu_parallel_codegen_split_count=1",
    # The first as always (`runtime.compilation.xla`). The others traverse a program many times, to verify it or to
    # search for patterns that programs of vijax do not contain. reshape-mover is not skipped: without it and algsimp, a
    # loop that draws by `jax.random` writes to wrong addresses.
    "--xla_disable_hlo_passes=cpu-parallel-task-assigner,hlo-verifier,algsimp,simplify-while-loops,"
    "while-loop-invariant-code-motion,while-loop-constant-sinking,simplify-conditional,"
    "tree_reduction_rewriter,zero_sized_hlo_elimination",
)
# "quick" in processes that inherit the flags, as the workers of pytest-xdist do; "shipped" where the tests are to
# compile as users do (scripts/check.sh --shipped).
if "VIJAX_TEST_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = " ".join((*supported_flags(_FLAGS), os.environ.get("XLA_FLAGS", "")))
    os.environ["VIJAX_TEST_FLAGS"] = "quick"

jax.config.update("jax_numpy_dtype_promotion", "strict")
gc.set_threshold(*RELAXED_THRESHOLDS)  # tests trace outside of public functions, too
# Workers, and the scripts that tests start, compile many of the same programs: one of them does it for all.
CACHE = str(Path(__file__).parent.parent / ".pytest_cache" / "jax")
os.environ["JAX_COMPILATION_CACHE_DIR"] = CACHE
jax.config.update("jax_compilation_cache_dir", CACHE)
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

# No deadline: the first example of a property pays for the compilation.
settings.register_profile("vijax", deadline=None, max_examples=50)
settings.register_profile("vijax-ci", settings.get_profile("vijax"), derandomize=True, database=None, print_blob=True)
settings.load_profile("vijax-ci" if os.environ.get("CI") else "vijax")


# A worker with more bytes than this drops its programs and reads them from the folder again. Two workers and their
# child processes share the memory of a small machine; machine code of thousands of programs is most of it.
MAX_MEMORY = 5e9


def pytest_runtest_teardown(item, nextitem):
    """Drop compiled programs between two files if the process has too much memory."""
    if nextitem is not None and nextitem.path != item.path and resident() > MAX_MEMORY:
        jax.clear_caches()
        gc.collect()
        # glibc returns freed memory to the system only on request; other C libraries have no such function.
        getattr(ctypes.CDLL(None), "malloc_trim", int)(0)


def resident() -> float:
    """Return the resident memory of this process in bytes; 0 if the system does not report it."""
    status = Path("/proc/self/statm")
    return float(status.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if status.exists() else 0.0


def pytest_addoption(parser):
    """Add the options of this suite."""
    parser.addoption("--long", action="store_true", help="run the tests marked long, too")
    parser.addoption("--record-seconds", action="store_true", help="write the processor time of each test file")


def pytest_collection_modifyitems(config, items):
    """Order the files, and deselect tests marked `long` unless the option or the name of a test selects them.

    Several workers run the dearest files first, by their recorded seconds, so that all end together; new ones first.
    """
    if hasattr(config, "workerinput"):
        seconds_of = seconds.recorded()
        items.sort(key=lambda item: -seconds_of.get(_file(item.nodeid), math.inf))
    if config.getoption("--long") or any("::" in argument for argument in config.args):
        return
    deselected = [item for item in items if "long" in item.keywords]
    items[:] = [item for item in items if "long" not in item.keywords]
    config.hook.pytest_deselected(items=deselected)


def pytest_collection_finish():
    """Start to count processor time; earlier time belongs to no file."""
    _last_report[0] = sum(os.times()[:4])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Attach to the report of each phase the processor time that this process and its children took since the last."""
    report = yield
    now = sum(os.times()[:4])
    report.user_properties = [*report.user_properties, (_SECONDS, now - _last_report[0])]
    _last_report[0] = now
    return report


def pytest_runtest_logreport(report):
    """Add up the processor time of each file; with several workers this runs in the process that collects reports."""
    file = _file(report.nodeid)
    duration = sum(value for name, value in report.user_properties if name == _SECONDS)
    _seconds_of[file] = _seconds_of.get(file, 0.0) + duration


def pytest_sessionfinish(session):
    """Write the processor time of each file if the option is set."""
    if session.config.getoption("--record-seconds") and not hasattr(session.config, "workerinput"):
        seconds.record(seconds.recorded() | _seconds_of)


_SECONDS = "processor seconds"
_last_report = [0.0]
_seconds_of: dict[str, float] = {}


def _file(nodeid: str) -> str:
    """Return the path of a test's file, relative to the root of the repository."""
    return nodeid.partition("::")[0]


@pytest.fixture
def on_gpu(monkeypatch):
    """Return a function that makes JAX trace for a GPU; traces for the CPU are dropped before and after."""

    def begin():
        jax.clear_caches()
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")

    yield begin
    jax.clear_caches()
