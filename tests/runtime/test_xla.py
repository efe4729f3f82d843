"""Kernels and stored values change the compilation of a program, never its results."""

import os
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export, lax

import vijax
from vijax.runtime.compilation import xla
from vijax.runtime.compilation.xla import (
    first_true_indices,
    in_blocks,
    kernel,
    map_lanes,
    materialise,
    replace_rows,
    round_up_to_blocks,
    short_while_loop,
)

X = jnp.linspace(0.1, 2.0, 192)
MARK = "xla_cpu_small_call"
ON_CPU = pytest.mark.skipif(jax.default_backend() != "cpu", reason="accelerators are given no kernels")


def compiled(work, *args):
    """Return the optimised program."""
    return jax.jit(work, compiler_options=xla.compiler_options()).lower(*args).compile()


def several(x, store=materialise):
    """Return several results of a shared value."""
    costly = store(jnp.tan(x) * x)
    return costly + 1, costly * 2, costly - x


def falls(state):
    """Count each lane down to zero; the loop ends with the last lane, and its trips are counted."""

    def step(state):
        remaining, trips = state
        return jnp.maximum(remaining - 1, 0), trips + 1

    return lax.while_loop(lambda state: (state[0] > 0).any(), step, state)


def test_a_kernel_has_the_results_of_its_function():
    factor, unread = jnp.asarray(3.0), jnp.asarray(7.0)

    def work(x, unused, *, rows):
        sums = lax.while_loop(lambda s: s[0].sum() < 1e6, lambda s: (factor * s[0], s[1] + x[rows]), (x, 0 * x))
        # XLA detects that these are not read, JAX does not; an unread input once crashed the process.
        untouched = jnp.where(jnp.full(x.shape, True), x, unread * unused)
        return {"sum": sums[0], "taken": sums[1], "untouched": untouched}

    rows = jnp.flip(jnp.arange(X.size))
    expected = jax.jit(lambda x, unused: work(x, unused, rows=rows))(X, X)
    actual = compiled(lambda x, unused: kernel(work)(x, unused, rows=rows), X, X)(X, X)
    jax.tree.map(np.testing.assert_array_equal, actual, expected)


@ON_CPU
def test_a_kernel_is_a_single_call_also_in_a_stored_program():
    jitted = jax.jit(lambda x: kernel(several)(x))
    assert compiled(jitted, X).as_text().count(MARK) == 1
    restored = export.deserialize(export.export(jitted)(X).serialize()).call
    text = compiled(restored, X).as_text()
    assert text.count(MARK) == 1
    entry = text[text.index("ENTRY") :]
    assert "fusion(" not in entry


@ON_CPU
def test_a_materialised_value_is_computed_once():
    stored, again = (compiled(lambda x, s=s: several(x, s), X).as_text() for s in (materialise, lambda value: value))
    assert stored.count(" multiply(") < again.count(" multiply(")


def test_a_materialised_value_has_derivatives():
    def cube(x):
        return materialise((x * x, x))[0] * x

    assert jax.jvp(jax.grad(cube), (2.0,), (1.0,)) == (12.0, 12.0)
    np.testing.assert_array_equal(jax.vmap(cube)(X), X * X * X)


def test_blocks_end_independently():
    remaining = jnp.zeros(192, jnp.int32).at[70].set(9).at[130].set(4)
    trips = jnp.zeros_like(remaining)
    down, count = in_blocks(falls, (remaining, trips))
    assert not down.any()
    expected = np.repeat([0, 9, 4], 64) if jax.default_backend() == "cpu" else 9
    np.testing.assert_array_equal(count, expected)


@ON_CPU
@pytest.mark.parametrize(("version", "supported"), [((0, 10, 2), True), ((0, 11, 0), False), ((0, 12, 1), False)])
def test_options_that_xla_does_not_support_are_omitted(version, supported, monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(jax, "__version_info__", version)
    assert ("xla_cpu_use_fusion_emitters" in xla.compiler_options()) == supported
    assert "xla_cpu_prefer_vector_width" in xla.compiler_options()


@ON_CPU
@pytest.mark.parametrize(("lanes", "rounded"), [(1, 1), (32, 32), (64, 64), (65, 128), (512, 512)])
def test_lanes_are_rounded_up_to_full_blocks(lanes, rounded):
    assert round_up_to_blocks(lanes) == rounded


@pytest.fixture(params=["cpu", "gpu"])
def platform(request, monkeypatch):
    """The platform that programs are traced for, a CPU or an accelerator; both programs run on the CPU."""
    monkeypatch.setattr(jax, "default_backend", lambda: request.param)
    return request.param


@pytest.mark.parametrize("count", [0, 2, 3])
def test_only_the_specified_rows_are_replaced(platform, count):
    lanes = {"x": jnp.arange(5.0), "yes": jnp.zeros((5, 2), bool)}
    part = {"x": jnp.asarray([10.0, 20.0, 30.0]), "yes": jnp.ones((3, 2), bool)}
    rows = np.asarray([4, 0, 2])
    after = kernel(replace_rows)(lanes, part, jnp.asarray(rows, jnp.int32), jnp.asarray(count, jnp.int32))
    expected = jax.tree.map(np.array, lanes)
    for i, row in enumerate(rows[:count]):
        expected["x"][row], expected["yes"][row] = part["x"][i], True
    jax.tree.map(np.testing.assert_array_equal, after, expected)


@pytest.mark.parametrize("width", [1, 4, 40])
def test_first_true_indices_are_in_order(platform, width):
    mask = np.random.default_rng(3).random(40) < 0.3
    members, chosen = first_true_indices(jnp.asarray(mask), width)
    expected = np.flatnonzero(mask)[:width]
    np.testing.assert_array_equal(members[: expected.size], expected)
    np.testing.assert_array_equal(np.flatnonzero(chosen), expected)
    assert members.shape == (width,)
    assert ((np.asarray(members) >= 0) & (np.asarray(members) < 40)).all()


def test_a_short_while_loop_ends_at_its_condition(platform):
    """Batched loops of different lengths end separately."""
    ends = jnp.asarray([0, 1, 4, 5, 11])
    halved = jax.vmap(
        lambda end: short_while_loop(lambda s: s[0] < end, lambda s: (s[0] + 1, s[1] / 2), (0 * end, 1.0))
    )(ends)
    np.testing.assert_array_equal(halved[0], ends)
    np.testing.assert_array_equal(halved[1], 0.5 ** np.asarray(ends))


@ON_CPU
def test_options_in_xla_flags_take_precedence(monkeypatch):
    name = "xla_backend_optimization_level"
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    assert name in xla.compiler_options()
    monkeypatch.setenv("XLA_FLAGS", f"--{name}=3")
    assert name not in xla.compiler_options()
    assert xla.compiler_options()


PLANE = "d=np.linspace(0.12, 0.3, 7), kappa=np.geomspace(10, 400, 5), r=0.5, periods=200"
WITHOUT_KERNELS = f"""
import sys
import jax
import jax.numpy as jnp
import numpy as np
import vijax
from vijax.runtime.compilation import xla
x = jnp.linspace(0.1, 2.0, 192)
rows, count = jnp.arange(3), jnp.asarray(2)
work = lambda x: xla.replace_rows(
    x, xla.in_blocks(xla.kernel(lambda x: xla.materialise(jnp.tan(x))), x)[:3], rows, count
)
text = jax.jit(work).lower(x).as_text()
assert "xla_cpu_small_call" not in text and "inlineable" not in text and "while" not in text, text
assert xla.round_up_to_blocks(65) == 65
found = vijax.sweep({PLANE})
np.savez(sys.argv[1], P=found.P, period=found.period, speed=found.max_impact_speed)
"""


def without_kernels(code: str, *arguments: str, switch: str = "0") -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"VIJAX_KERNELS": switch}
    return subprocess.run([sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True)


@ON_CPU
def test_results_are_the_same_without_kernels(tmp_path):
    result = without_kernels(WITHOUT_KERNELS, str(tmp_path / "plain.npz"))
    assert result.returncode == 0, result.stderr
    plain, with_kernels = np.load(tmp_path / "plain.npz"), eval(f"vijax.sweep({PLANE})", {"vijax": vijax, "np": np})
    settled = with_kernels.period.values > 0
    assert settled.mean() > 0.6
    np.testing.assert_array_equal(plain["period"][settled], with_kernels.period.values[settled])
    for name, variable in (("P", "P"), ("speed", "max_impact_speed")):
        np.testing.assert_allclose(plain[name][settled], with_kernels[variable].values[settled], rtol=1e-12)


@pytest.fixture
def reset_kernel_check():
    """Return a function that resets the check of kernels and all traces; it runs before and after a test, too."""

    def forget():
        xla.kernel_failure.cache_clear()
        jax.clear_caches()

    forget()
    yield forget
    forget()


@pytest.fixture
def store_all_programs():
    """Store compiled programs of any compile time."""
    before = jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    yield
    jax.config.update("jax_persistent_cache_min_compile_time_secs", before)


@ON_CPU
def test_kernels_are_used_where_xla_makes_them(reset_kernel_check, store_all_programs):
    for _ in ("compiled", "read from the kept programs"):
        reset_kernel_check()
        assert xla.kernel_failure() == ""
        assert xla.uses_kernels()


@ON_CPU
def test_the_plain_function_is_traced_if_xla_ignores_the_mark(reset_kernel_check, store_all_programs, monkeypatch):
    """An unknown mark stands for a version of XLA without the mark of kernels."""
    monkeypatch.setattr(xla, "_KERNEL_MARK", {"no_such_mark": "true"} | xla._NOT_INLINED)
    for _ in ("compiled", "read from the kept programs"):
        reset_kernel_check()
        assert xla.kernel_failure() == "XLA ignores the mark of kernels"
    text = jax.jit(lambda x: kernel(several)(x)).lower(X).as_text()
    assert "no_such_mark" not in text
    assert "inlineable" not in text
    assert round_up_to_blocks(65) == 65


@ON_CPU
def test_a_mark_that_the_compiler_rejects_is_not_used(reset_kernel_check, monkeypatch):
    """XLA cannot compile a kernel that sorts."""
    monkeypatch.setattr(xla, "_stored", lambda value: jnp.sort(value))
    assert xla.kernel_failure().startswith("XLA rejects the mark of kernels: ")
    assert not xla.uses_kernels()


@ON_CPU
def test_kernels_are_checked_while_a_program_is_traced(reset_kernel_check):
    traced = []
    jax.vmap(lambda x: traced.append(xla.uses_kernels()) or x)(X)
    assert traced == [True]


def test_an_invalid_value_of_the_switch_is_named():
    result = without_kernels("import vijax.public", switch="off")
    assert result.returncode == 1
    assert (
        result.stderr.splitlines()[-1]
        == "ValueError: VIJAX_KERNELS must be 0 (no kernels) or 1; got 'off'; see docs: limits"
    )


def loops(work, *lanes):
    """Return True if a program of the work has a loop over lanes."""
    return any(eqn.primitive.name == "scan" for eqn in jax.make_jaxpr(work)(*lanes).eqns)


def test_map_lanes_loops_over_few_lanes_and_vectorises_many(monkeypatch):
    def work(x, row, *, factor):
        return {"one": factor * jnp.sin(x), "row": x + row.sum()}

    few, many = (jnp.linspace(0.1, 1.0, count) for count in (64, 65))
    mapped = partial(map_lanes(work), factor=2.0)
    for x in (few, many):
        rows = jnp.stack([x, x * x], axis=1)
        near = partial(np.testing.assert_allclose, rtol=1e-15)
        jax.tree.map(near, mapped(x, rows), jax.vmap(partial(work, factor=2.0))(x, rows))
        assert loops(mapped, x, rows) == (xla.on_cpu() and x.size == 64)
    monkeypatch.setattr(xla, "on_cpu", lambda: False)
    # A new function, as JAX stores its traces.
    assert not loops(partial(map_lanes(work), factor=2.0), few, jnp.stack([few, few], axis=1))
