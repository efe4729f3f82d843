"""A function is a program of its own, or a part of one; its traced form is kept where its name tells what it does."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

from vijax.runtime import cache_folder, programs, xla

X = np.linspace(0.1, 2.0, 7)


class Wave(NamedTuple):
    """A result of several arrays."""

    height: jax.Array
    above: jax.Array


traced: list[str] = []


def wave(x, *, factor=1.0):
    """A function of a module, which notes that it is traced."""
    traced.append("wave")
    return Wave(factor * jnp.sin(x), x > 1)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(cache_folder, "kept", lambda: tmp_path)
    for one in (wave, Wave):  # as if both were of the package: programs of no others are kept
        monkeypatch.setattr(one, "__module__", "vijax.runtime.programs")
        monkeypatch.setattr(programs, one.__qualname__, one, raising=False)
    traced.clear()
    return tmp_path


def in_a_new_process(x=X, **said):
    """What a process makes of it that knows of no earlier one; how often it traces."""
    before = len(traced)
    found = programs.jitted(wave, static=("factor",))(x, **said)
    assert type(found) is Wave
    np.testing.assert_allclose(found.height, said.get("factor", 1.0) * np.sin(np.asarray(x)), rtol=1e-15)
    np.testing.assert_array_equal(found.above, np.asarray(x) > 1)
    return len(traced) - before


def test_a_function_of_a_module_is_traced_once_for_all_processes(folder):
    assert [in_a_new_process() for _ in range(3)] == [1, 0, 0]
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("other", [{"factor": 2.0}, {"x": X[:5]}])
def test_another_argument_that_is_no_array_or_another_shape_is_another_program(folder, other):
    assert [in_a_new_process(), in_a_new_process(**other), in_a_new_process(), in_a_new_process(**other)] == [
        1,
        1,
        0,
        0,
    ]


@pytest.mark.parametrize("made", [lambda: lambda x: wave(x), lambda: jax.vmap(wave), lambda: jax.jit(wave)])
def test_what_a_name_does_not_tell_is_traced_by_every_process(folder, made):
    far = made()
    far.__module__ = wave.__module__  # of a module of ours, like all that may be kept
    np.testing.assert_allclose(programs.jitted(far)(X).height, np.sin(X), rtol=1e-15)
    assert not list(folder.iterdir())
    np.testing.assert_allclose(programs.jitted(far, name="far")(X).height, np.sin(X), rtol=1e-15)
    assert len(list(folder.iterdir())) == 1


def test_numbers_that_are_no_arrays_are_traced_as_jax_does(folder):
    assert in_a_new_process(0.5) == 1
    assert not list(folder.iterdir())


@pytest.mark.parametrize(("rows", "often", "brief"), [(64, False, True), (65, False, False), (64, True, False)])
def test_a_program_of_few_rows_is_compiled_briefly(monkeypatch, rows, often, brief):
    asked = []
    monkeypatch.setattr(xla, "compiler_options", lambda *, brief: asked.append(brief) or {})
    double = programs.jitted(lambda x, *, factor: x * factor, often=often, static=("factor",))
    for factor in (2, 2, 3):
        np.testing.assert_array_equal(double(np.ones(rows), factor=factor), np.full(rows, 1.0 * factor))
    assert asked == [brief]


def test_within_another_program_it_is_a_part_of_that():
    square = programs.jitted(lambda x: x * x)
    np.testing.assert_array_equal(jax.jit(square)(np.arange(3.0)), [0, 1, 4])
    # Of constants, too: within a program JAX traces everything.
    np.testing.assert_array_equal(jax.jit(lambda x: x + square(np.arange(3.0)))(1.0), [1, 2, 5])
    assert jax.grad(square)(3.0) == 6
    np.testing.assert_array_equal(jax.vmap(jax.grad(square))(np.arange(3.0)), [0, 2, 4])


@pytest.fixture
def compiled():
    """The names of what is compiled meanwhile."""
    names: list[str] = []

    def count(event, *_, fun_name="", **__):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(fun_name)

    monitoring.register_event_duration_secs_listener(count)
    yield names
    monitoring.unregister_event_duration_listener(count)


def test_what_is_begun_compiles_in_the_background_and_once(compiled):
    def ripple(x):
        return jnp.sin(jnp.cos(x))

    program = programs.jitted(ripple)
    programs.begin(program, X)
    deadline = time.monotonic() + 30
    while "jit(ripple)" not in compiled and time.monotonic() < deadline:
        time.sleep(0.01)
    np.testing.assert_allclose(program(X), np.sin(np.cos(X)), rtol=1e-15)
    programs.begin(program, X + 1)
    assert compiled.count("jit(ripple)") == 1


def test_what_is_begun_is_called_once_for_a_shape_and_its_errors_are_dropped():
    called = []

    def fails(x):
        called.append(x.size)
        raise ValueError

    for size in (3, 3, 4):
        programs.begin(fails, np.zeros(size))
    deadline = time.monotonic() + 30
    while len(called) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert sorted(called) == [3, 4]


def test_nothing_is_begun_where_arguments_are_traced():
    called = []
    jax.jit(lambda x: programs.begin(called.append, x) or x)(X)
    time.sleep(0.05)
    assert not called
