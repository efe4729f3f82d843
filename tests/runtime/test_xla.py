"""Kernels and stored values change how a program is compiled, never what it computes."""

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
from vijax.runtime import xla
from vijax.runtime.xla import each, first, in_blocks, kernel, put, search, share, whole_blocks

X = jnp.linspace(0.1, 2.0, 192)
MARK = "xla_cpu_small_call"
ON_CPU = pytest.mark.skipif(jax.default_backend() != "cpu", reason="accelerators are given no kernels")


def compiled(work, *args):
    """The optimised program."""
    return jax.jit(work, compiler_options=xla.compiler_options()).lower(*args).compile()


def several(x, share=share):
    """Several results of one value."""
    dear = share(jnp.tan(x) * x)
    return dear + 1, dear * 2, dear - x


def falls(state):
    """Each lane falls to zero by itself; the loop ends with the last one, and says after how many trips."""

    def step(state):
        left, trips = state
        return jnp.maximum(left - 1, 0), trips + 1

    return lax.while_loop(lambda state: (state[0] > 0).any(), step, state)


def test_a_kernel_computes_what_the_function_does():
    factor, unread = jnp.asarray(3.0), jnp.asarray(7.0)

    def work(x, unused, *, rows):
        sums = lax.while_loop(lambda s: s[0].sum() < 1e6, lambda s: (factor * s[0], s[1] + x[rows]), (x, 0 * x))
        # XLA sees that these are not read, JAX does not: an input that nothing reads once ended the process.
        untouched = jnp.where(jnp.full(x.shape, True), x, unread * unused)
        return {"sum": sums[0], "taken": sums[1], "untouched": untouched}

    rows = jnp.flip(jnp.arange(X.size))
    plain = jax.jit(lambda x, unused: work(x, unused, rows=rows))(X, X)
    made = compiled(lambda x, unused: kernel(work)(x, unused, rows=rows), X, X)(X, X)
    jax.tree.map(np.testing.assert_array_equal, made, plain)


@ON_CPU
def test_a_kernel_is_one_call_also_of_a_program_that_was_kept():
    made = jax.jit(lambda x: kernel(several)(x))
    assert compiled(made, X).as_text().count(MARK) == 1
    kept = export.deserialize(export.export(made)(X).serialize()).call
    text = compiled(kept, X).as_text()
    assert text.count(MARK) == 1
    entry = text[text.index("ENTRY") :]
    assert "fusion(" not in entry


@ON_CPU
def test_a_shared_value_is_computed_once():
    shared, again = (compiled(lambda x, s=s: several(x, s), X).as_text() for s in (share, lambda value: value))
    assert shared.count(" multiply(") < again.count(" multiply(")


def test_a_shared_value_has_its_derivatives():
    def cube(x):
        return share((x * x, x))[0] * x

    assert jax.jvp(jax.grad(cube), (2.0,), (1.0,)) == (12.0, 12.0)
    np.testing.assert_array_equal(jax.vmap(cube)(X), X * X * X)


def test_blocks_do_not_wait_for_each_other():
    left = jnp.zeros(192, jnp.int32).at[70].set(9).at[130].set(4)
    trips = jnp.zeros_like(left)
    down, count = in_blocks(falls, (left, trips))
    assert not down.any()
    each = np.repeat([0, 9, 4], 64) if jax.default_backend() == "cpu" else 9
    np.testing.assert_array_equal(count, each)


@ON_CPU
@pytest.mark.parametrize(("version", "known"), [((0, 10, 2), True), ((0, 11, 0), False), ((0, 12, 1), False)])
def test_xla_is_asked_for_no_option_that_it_does_not_know(version, known, monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(jax, "__version_info__", version)
    assert ("xla_cpu_use_fusion_emitters" in xla.compiler_options()) == known
    assert "xla_cpu_prefer_vector_width" in xla.compiler_options()


@ON_CPU
@pytest.mark.parametrize(("lanes", "whole"), [(1, 1), (32, 32), (64, 64), (65, 128), (512, 512)])
def test_lanes_come_in_whole_blocks(lanes, whole):
    assert whole_blocks(lanes) == whole


@pytest.fixture(params=["cpu", "gpu"])
def either(request, monkeypatch):
    """What is traced for a CPU and what for an accelerator: both run here."""
    monkeypatch.setattr(jax, "default_backend", lambda: request.param)
    return request.param


@pytest.mark.parametrize("count", [0, 2, 3])
def test_rows_are_replaced_and_no_other(either, count):
    lanes = {"x": jnp.arange(5.0), "yes": jnp.zeros((5, 2), bool)}
    part = {"x": jnp.asarray([10.0, 20.0, 30.0]), "yes": jnp.ones((3, 2), bool)}
    rows = np.asarray([4, 0, 2])
    after = kernel(put)(lanes, part, jnp.asarray(rows, jnp.int32), jnp.asarray(count, jnp.int32))
    expected = jax.tree.map(np.array, lanes)
    for i, row in enumerate(rows[:count]):
        expected["x"][row], expected["yes"][row] = part["x"][i], True
    jax.tree.map(np.testing.assert_array_equal, after, expected)


@pytest.mark.parametrize("width", [1, 4, 40])
def test_the_first_lanes_of_a_mask_are_found_in_order(either, width):
    mask = np.random.default_rng(3).random(40) < 0.3
    members, chosen = first(jnp.asarray(mask), width)
    there = np.flatnonzero(mask)[:width]
    np.testing.assert_array_equal(members[: there.size], there)
    np.testing.assert_array_equal(np.flatnonzero(chosen), there)
    assert members.shape == (width,)
    assert ((np.asarray(members) >= 0) & (np.asarray(members) < 40)).all()


def test_a_search_ends_where_its_loop_does(either):
    """Each of several searches by itself, also where they are of different lengths."""
    ends = jnp.asarray([0, 1, 4, 5, 11])
    halved = jax.vmap(lambda end: search(lambda s: s[0] < end, lambda s: (s[0] + 1, s[1] / 2), (0 * end, 1.0)))(ends)
    np.testing.assert_array_equal(halved[0], ends)
    np.testing.assert_array_equal(halved[1], 0.5 ** np.asarray(ends))


@ON_CPU
def test_what_the_user_says_in_xla_flags_comes_first(monkeypatch):
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
from vijax.runtime import xla
x = jnp.linspace(0.1, 2.0, 192)
rows, count = jnp.arange(3), jnp.asarray(2)
work = lambda x: xla.put(x, xla.in_blocks(xla.kernel(lambda x: xla.share(jnp.tan(x))), x)[:3], rows, count)
text = jax.jit(work).lower(x).as_text()
assert "xla_cpu_small_call" not in text and "inlineable" not in text and "while" not in text, text
assert xla.whole_blocks(65) == 65
found = vijax.sweep({PLANE})
np.savez(sys.argv[1], P=found.P, period=found.period, speed=found.max_impact_speed)
"""


def without_kernels(code: str, *arguments: str, switch: str = "0") -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"VIJAX_KERNELS": switch}
    return subprocess.run([sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True)


@ON_CPU
def test_without_kernels_the_same_comes_out(tmp_path):
    done = without_kernels(WITHOUT_KERNELS, str(tmp_path / "plain.npz"))
    assert done.returncode == 0, done.stderr
    plain, found = np.load(tmp_path / "plain.npz"), eval(f"vijax.sweep({PLANE})", {"vijax": vijax, "np": np})
    settled = found.period.values > 0
    assert settled.mean() > 0.6
    np.testing.assert_array_equal(plain["period"][settled], found.period.values[settled])
    for name, variable in (("P", "P"), ("speed", "max_impact_speed")):
        np.testing.assert_allclose(plain[name][settled], found[variable].values[settled], rtol=1e-12)


@pytest.fixture
def measured_anew():
    """Return what forgets whether XLA makes kernels, and what was traced by it; called before a test and after it."""

    def forget():
        xla.kernel_failure.cache_clear()
        jax.clear_caches()

    forget()
    yield forget
    forget()


@pytest.fixture
def everything_is_kept():
    """Keep compiled programs however briefly they compile."""
    before = jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    yield
    jax.config.update("jax_persistent_cache_min_compile_time_secs", before)


@ON_CPU
def test_kernels_are_used_where_xla_makes_them(measured_anew, everything_is_kept):
    for _ in ("compiled", "read from the kept programs"):
        measured_anew()
        assert xla.kernel_failure() == ""
        assert xla.uses_kernels()


@ON_CPU
def test_without_a_known_mark_the_plain_form_is_traced(measured_anew, everything_is_kept, monkeypatch):
    """A mark that XLA does not know stands for an XLA that no longer knows ours."""
    monkeypatch.setattr(xla, "_ONE_KERNEL", {"no_such_mark": "true"} | xla._STAYS)
    for _ in ("compiled", "read from the kept programs"):
        measured_anew()
        assert xla.kernel_failure() == "XLA ignores the mark of kernels"
    text = jax.jit(lambda x: kernel(several)(x)).lower(X).as_text()
    assert "no_such_mark" not in text
    assert "inlineable" not in text
    assert whole_blocks(65) == 65


@ON_CPU
def test_a_mark_that_the_compiler_rejects_is_not_used(measured_anew, monkeypatch):
    """XLA cannot compile a kernel that sorts."""
    monkeypatch.setattr(xla, "_kept", lambda value: jnp.sort(value))
    assert xla.kernel_failure().startswith("XLA rejects the mark of kernels: ")
    assert not xla.uses_kernels()


@ON_CPU
def test_kernels_are_measured_while_a_program_is_traced(measured_anew):
    traced = []
    jax.vmap(lambda x: traced.append(xla.uses_kernels()) or x)(X)
    assert traced == [True]


def test_a_misspelt_switch_is_named():
    done = without_kernels("import vijax.public", switch="off")
    assert done.returncode == 1
    assert (
        done.stderr.splitlines()[-1]
        == "ValueError: VIJAX_KERNELS must be 0 (no kernels) or 1; got 'off'; see docs: limits"
    )


def loops(work, *balls):
    """Whether a program of the work has a loop over balls."""
    return any(eqn.primitive.name == "scan" for eqn in jax.make_jaxpr(work)(*balls).eqns)


def test_few_balls_are_taken_one_after_another_and_many_abreast(monkeypatch):
    def work(x, row, *, factor):
        return {"one": factor * jnp.sin(x), "row": x + row.sum()}

    few, many = (jnp.linspace(0.1, 1.0, count) for count in (64, 65))
    some = partial(each(work), factor=2.0)
    for x in (few, many):
        rows = jnp.stack([x, x * x], axis=1)
        near = partial(np.testing.assert_allclose, rtol=1e-15)
        jax.tree.map(near, some(x, rows), jax.vmap(partial(work, factor=2.0))(x, rows))
        assert loops(some, x, rows) == (xla.on_cpu() and x.size == 64)
    monkeypatch.setattr(xla, "on_cpu", lambda: False)
    # Another function: JAX remembers what it traced.
    assert not loops(partial(each(work), factor=2.0), few, jnp.stack([few, few], axis=1))
