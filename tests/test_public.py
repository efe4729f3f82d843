"""Public names of `vijax` exist after imports in any order, have typed arguments, and are visible to a type checker."""

import ast
import inspect
import pkgutil
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Literal, Unpack, get_args, get_origin, is_typeddict

import pytest

import vijax
from vijax.continuation import branch_continuation
from vijax.design import objective
from vijax.impact import method_choice
from vijax.maps import axes, orbit_diagram
from vijax.model import choices

PUBLIC = {name: getattr(vijax, name) for name in vijax.__all__}
PUBLIC |= {f"plots.{name}": getattr(vijax.plots, name) for name in vijax.plots.__all__}
FUNCTIONS = {name: value for name, value in PUBLIC.items() if isinstance(value, FunctionType)}
MODULES = [module.name for module in pkgutil.walk_packages(vijax.__path__, "vijax.")]
# Arguments with a closed set of choices; all their annotations are `Literal` types.
CHOICES = {
    "direction": {branch_continuation.Direction, choices.Direction},
    "dtype": {choices.Precision},
    "method": {choices.MethodName},
    "motion": {choices.Motion},
    "objective": {objective.Objective},
    "solver": {choices.SolverName},
    "until": {choices.Until},
    "wall": {choices.Walls},
}

# `vijax/__init__` runs before any other module; this code imports the other modules in two orders.
ANY_ORDER = """
import importlib, inspect, sys
for modules in (sys.argv[1:], sys.argv[:0:-1]):
    for name in [name for name in sys.modules if name.partition(".")[0] == "vijax"]:
        del sys.modules[name]
    for module in modules:
        importlib.import_module(module)
        import vijax
        for name in ("compare", "steady", "trajectory", "sweep", "basins", "orbit_diagram", "optimise", "surroundings"):
            assert inspect.isfunction(getattr(vijax, name)), f"vijax.{name} is no function once {module} is imported"
        assert inspect.ismodule(vijax.plots)
print("both orders")
"""


def test_functions_are_functions_after_imports_in_any_order():
    result = subprocess.run([sys.executable, "-c", ANY_ORDER, *MODULES], capture_output=True, text=True)
    assert result.stdout == "both orders\n", result.stderr
    assert len(MODULES) > 60


@pytest.mark.parametrize("folder", ["vijax", "vijax.plots"])
def test_no_module_has_the_name_of_a_public_object_of_its_package(folder):
    package = import_module(folder)
    modules = {module.name for module in pkgutil.iter_modules(package.__path__)}
    objects = {name for name in package.__all__ if not isinstance(getattr(package, name), ModuleType)}
    assert objects
    assert not modules & objects


def test_the_docstring_of_the_package_lists_all_public_names():
    assert vijax.__all__ == sorted(vijax.__all__)
    assert set(vijax.__all__) <= set(re.findall(r"`(\w+)`", vijax.__doc__))
    with pytest.raises(AttributeError, match="module 'vijax' has no attribute 'swep'"):
        _ = vijax.swep  # type: ignore[attr-defined]


def test_plots_declare_all_public_names_for_a_type_checker():
    tree = ast.parse(Path(vijax.plots.__file__).read_text())
    (choice,) = [node for node in tree.body if isinstance(node, ast.If)]
    declared = {
        (name.name, node.module) for node in choice.body if isinstance(node, ast.ImportFrom) for name in node.names
    }
    assert declared == {(name, getattr(vijax.plots, name).__module__) for name in vijax.plots.__all__}
    with pytest.raises(AttributeError, match=r"module 'vijax.plots' has no attribute 'powermap'"):
        _ = vijax.plots.powermap  # type: ignore[attr-defined]


def untyped_parts(function: FunctionType) -> list[str]:
    """Return the arguments of a signature, and its return, that have no type."""
    signature = inspect.signature(function)
    untyped = [] if signature.return_annotation not in (inspect.Signature.empty, Any) else ["return"]
    for name, parameter in signature.parameters.items():
        kind = parameter.annotation
        if kind in (inspect.Parameter.empty, Any):
            untyped.append(name)
        elif parameter.kind is parameter.VAR_KEYWORD:
            untyped += [] if get_origin(kind) is Unpack and all(map(is_typeddict, get_args(kind))) else [name]
    return untyped


def test_arguments_without_a_type_are_detected():
    def incomplete(bare, number: int, loose: Any, **settings: Any): ...

    def complete(number: int, **axes: Unpack[axes.Axes]) -> int: ...

    assert untyped_parts(incomplete) == ["return", "bare", "loose", "settings"]
    assert untyped_parts(complete) == []


@pytest.mark.parametrize("name", FUNCTIONS)
def test_all_arguments_of_public_functions_have_a_type(name):
    assert not untyped_parts(FUNCTIONS[name])
    for argument, parameter in inspect.signature(FUNCTIONS[name]).parameters.items():
        if argument in CHOICES:
            allowed = {parameter.annotation, *get_args(parameter.annotation)}
            assert allowed & CHOICES[argument], f"{argument} must be one of a few words; got {parameter.annotation}"


def test_choices_equal_the_choices_that_public_functions_accept():
    assert get_args(objective.Objective) == tuple(objective.OBJECTIVES)
    assert get_args(choices.MethodName) == tuple(method_choice.METHOD_OPTIONS)
    assert get_args(branch_continuation.Direction) == tuple(branch_continuation._SIGNS)
    assert get_args(choices.Direction) == tuple(orbit_diagram._DIRECTIONS)
    assert {get_origin(literal) for literals in CHOICES.values() for literal in literals} == {Literal}
