"""What `vijax` offers: it is there whatever was imported before, it says what it takes, and a type checker sees it."""

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
from vijax.design import objective
from vijax.engine import method_choice
from vijax.model import choices
from vijax.orbits import continuation
from vijax.planes import axes, orbit_diagram

OFFERED = {name: getattr(vijax, name) for name in vijax.__all__}
OFFERED |= {f"plots.{name}": getattr(vijax.plots, name) for name in vijax.plots.__all__}
FUNCTIONS = {name: found for name, found in OFFERED.items() if isinstance(found, FunctionType)}
ROOMS = [room.name for room in pkgutil.walk_packages(vijax.__path__, "vijax.")]
# Arguments of a few closed choices, each a `Literal` wherever it stands.
CHOICES = {
    "direction": {continuation.Direction, choices.Direction},
    "dtype": {choices.Precision},
    "method": {choices.MethodName},
    "motion": {choices.Motion},
    "objective": {objective.Objective},
    "solver": {choices.SolverName},
    "until": {choices.Until},
    "wall": {choices.Walls},
}

# Whatever room is asked for first, `vijax/__init__` runs before it: what matters is in which order the others follow.
ANY_ORDER = """
import importlib, inspect, sys
for rooms in (sys.argv[1:], sys.argv[:0:-1]):
    for name in [name for name in sys.modules if name.partition(".")[0] == "vijax"]:
        del sys.modules[name]
    for room in rooms:
        importlib.import_module(room)
        import vijax
        for name in ("compare", "steady", "trajectory", "sweep", "basins", "orbit_diagram", "optimise", "surroundings"):
            assert inspect.isfunction(getattr(vijax, name)), f"vijax.{name} is no function once {room} is imported"
        assert inspect.ismodule(vijax.plots)
print("both orders")
"""


def test_functions_are_functions_whatever_is_imported_first():
    done = subprocess.run([sys.executable, "-c", ANY_ORDER, *ROOMS], capture_output=True, text=True)
    assert done.stdout == "both orders\n", done.stderr
    assert len(ROOMS) > 60


@pytest.mark.parametrize("folder", ["vijax", "vijax.plots"])
def test_no_module_has_the_name_of_what_stands_beside_it(folder):
    package = import_module(folder)
    modules = {room.name for room in pkgutil.iter_modules(package.__path__)}
    offered = {name for name in package.__all__ if not isinstance(getattr(package, name), ModuleType)}
    assert offered
    assert not modules & offered


def test_the_front_page_names_all_that_there_is():
    assert vijax.__all__ == sorted(vijax.__all__)
    assert set(vijax.__all__) <= set(re.findall(r"`(\w+)`", vijax.__doc__))
    with pytest.raises(AttributeError, match="module 'vijax' has no attribute 'swep'"):
        _ = vijax.swep  # type: ignore[attr-defined]


def test_plots_offer_to_a_type_checker_what_they_offer():
    tree = ast.parse(Path(vijax.plots.__file__).read_text())
    (choice,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {(name.name, node.module) for node in choice.body if isinstance(node, ast.ImportFrom) for name in node.names}
    assert seen == {(name, getattr(vijax.plots, name).__module__) for name in vijax.plots.__all__}
    with pytest.raises(AttributeError, match=r"module 'vijax.plots' has no attribute 'powermap'"):
        _ = vijax.plots.powermap  # type: ignore[attr-defined]


def refused(function: FunctionType) -> list[str]:
    """What of a signature does not say what it takes or gives."""
    signature = inspect.signature(function)
    odd = [] if signature.return_annotation not in (inspect.Signature.empty, Any) else ["return"]
    for name, parameter in signature.parameters.items():
        kind = parameter.annotation
        if kind in (inspect.Parameter.empty, Any):
            odd.append(name)
        elif parameter.kind is parameter.VAR_KEYWORD:
            odd += [] if get_origin(kind) is Unpack and all(map(is_typeddict, get_args(kind))) else [name]
    return odd


def test_what_hides_its_arguments_is_refused():
    def hiding(bare, known: int, loose: Any, **settings: Any): ...

    def showing(known: int, **axes: Unpack[axes.Axes]) -> int: ...

    assert refused(hiding) == ["return", "bare", "loose", "settings"]
    assert refused(showing) == []


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_argument_shows_and_has_a_type(name):
    assert not refused(FUNCTIONS[name])
    for argument, parameter in inspect.signature(FUNCTIONS[name]).parameters.items():
        if argument in CHOICES:
            allowed = {parameter.annotation, *get_args(parameter.annotation)}
            assert allowed & CHOICES[argument], f"{argument} must be one of a few words; got {parameter.annotation}"


def test_choices_are_those_that_the_doors_allow():
    assert get_args(objective.Objective) == tuple(objective.OBJECTIVES)
    assert get_args(choices.MethodName) == tuple(method_choice.OPTIONS)
    assert get_args(continuation.Direction) == tuple(continuation._WAYS)
    assert get_args(choices.Direction) == tuple(orbit_diagram._WAYS)
    assert {get_origin(one) for several in CHOICES.values() for one in several} == {Literal}
