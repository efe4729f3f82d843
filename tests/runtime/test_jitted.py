"""A function is a separate program, or part of one; its traced form is stored if its name identifies it."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

from vijax.runtime.compilation import cache_folder, programs, xla

X = np.linspace(0.1, 2.0, 7)


class Wave(NamedTuple):
    """A result of several arrays."""

    height: jax.Array
    above: jax.Array


traced: list[str] = []


def wave(x, *, factor=1.0):
    """Return a wave, and record each trace."""
    traced.append("wave")
    return Wave(factor * jnp.sin(x), x > 1)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(cache_folder, "program_folder", lambda: tmp_path)
    for item in (wave, Wave):  # as if the package defined both: no other programs are stored
        monkeypatch.setattr(item, "__module__", "vijax.runtime.compilation.programs")
        monkeypatch.setattr(programs, item.__qualname__, item, raising=False)
    traced.clear()
    return tmp_path


def count_traces_in_a_new_process(x=X, **arguments):
    """Check the result of a process without compiled programs, and return the number of its traces."""
    before = len(traced)
    result = programs.jitted(wave, static=("factor",))(x, **arguments)
    assert type(result) is Wave
    np.testing.assert_allclose(result.height, arguments.get("factor", 1.0) * np.sin(np.asarray(x)), rtol=1e-15)
    np.testing.assert_array_equal(result.above, np.asarray(x) > 1)
    return len(traced) - before


def test_a_function_of_a_module_is_traced_once_for_all_processes(folder):
    assert [count_traces_in_a_new_process() for _ in range(3)] == [1, 0, 0]
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("other", [{"factor": 2.0}, {"x": X[:5]}])
def test_another_static_argument_or_shape_is_another_program(folder, other):
    assert [
        count_traces_in_a_new_process(),
        count_traces_in_a_new_process(**other),
        count_traces_in_a_new_process(),
        count_traces_in_a_new_process(**other),
    ] == [
        1,
        1,
        0,
        0,
    ]


@pytest.mark.parametrize("make", [lambda: lambda x: wave(x), lambda: jax.vmap(wave), lambda: jax.jit(wave)])
def test_a_function_that_its_name_does_not_identify_is_not_stored(folder, make):
    function = make()
    function.__module__ = wave.__module__  # a module of the package, as stored programs require
    np.testing.assert_allclose(programs.jitted(function)(X).height, np.sin(X), rtol=1e-15)
    assert not list(folder.iterdir())
    np.testing.assert_allclose(programs.jitted(function, name="far")(X).height, np.sin(X), rtol=1e-15)
    assert len(list(folder.iterdir())) == 1


def test_python_numbers_are_traced_and_not_stored(folder):
    assert count_traces_in_a_new_process(0.5) == 1
    assert not list(folder.iterdir())


@pytest.mark.parametrize(("rows", "often", "brief"), [(64, False, True), (65, False, False), (64, True, False)])
def test_a_program_of_few_rows_is_compiled_briefly(monkeypatch, rows, often, brief):
    requested = []
    monkeypatch.setattr(xla, "compiler_options", lambda *, brief: requested.append(brief) or {})
    double = programs.jitted(lambda x, *, factor: x * factor, often=often, static=("factor",))
    for factor in (2, 2, 3):
        np.testing.assert_array_equal(double(np.ones(rows), factor=factor), np.full(rows, 1.0 * factor))
    assert requested == [brief]


def test_within_another_program_a_function_is_a_part_of_it():
    square = programs.jitted(lambda x: x * x)
    np.testing.assert_array_equal(jax.jit(square)(np.arange(3.0)), [0, 1, 4])
    # Also if its arguments are constants: within a program JAX traces everything.
    np.testing.assert_array_equal(jax.jit(lambda x: x + square(np.arange(3.0)))(1.0), [1, 2, 5])
    assert jax.grad(square)(3.0) == 6
    np.testing.assert_array_equal(jax.vmap(jax.grad(square))(np.arange(3.0)), [0, 2, 4])


@pytest.fixture
def compiled():
    """The names of the programs that are compiled during a test."""
    names: list[str] = []

    def count(event, *_, fun_name="", **__):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(fun_name)

    monitoring.register_event_duration_secs_listener(count)
    yield names
    monitoring.unregister_event_duration_listener(count)


def test_start_compilation_compiles_once_in_the_background(compiled):
    def ripple(x):
        return jnp.sin(jnp.cos(x))

    program = programs.jitted(ripple)
    programs.start_compilation(program, X)
    deadline = time.monotonic() + 30
    while "jit(ripple)" not in compiled and time.monotonic() < deadline:
        time.sleep(0.01)
    np.testing.assert_allclose(program(X), np.sin(np.cos(X)), rtol=1e-15)
    programs.start_compilation(program, X + 1)
    assert compiled.count("jit(ripple)") == 1


def test_start_compilation_calls_once_per_shape_and_drops_errors():
    called = []

    def fails(x):
        called.append(x.size)
        raise ValueError

    for size in (3, 3, 4):
        programs.start_compilation(fails, np.zeros(size))
    deadline = time.monotonic() + 30
    while len(called) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert sorted(called) == [3, 4]


def test_start_compilation_ignores_traced_arguments():
    called = []
    jax.jit(lambda x: programs.start_compilation(called.append, x) or x)(X)
    time.sleep(0.05)
    assert not called
