"""Choice of a method: the names and options of the methods, their validation, and their record in datasets."""

import math
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from vijax.impact.method import Method
from vijax.model.choices import MethodName, SolverName
from vijax.model.forcing.excitation import Excitation
from vijax.model.walls.membrane import Linear, check_laws, describe_law, representative_law
from vijax.runtime import validation
from vijax.runtime.doc_pages import see

SOLVERS: tuple[SolverName, ...] = get_args(SolverName)
METHOD_OPTIONS: dict[MethodName, tuple[str, ...]] = {
    "exact": (),
    "ode": ("solver", "rtol", "atol", "membrane", "friction"),
    "rk4": ("steps", "membrane"),
}
_DEFAULTS = {"float64": (1e-8, 1e-10), "float32": (1e-4, 1e-6)}  # Default rtol and atol.
# Steps of rk4 per forcing period: default, smallest and largest number. Fewer than 8 do not resolve the forcing. Above
# a million, rounding errors exceed the gain of a smaller step.
_STEPS, _FEWEST_STEPS, _MOST_STEPS = 1000, 8, 10**6
_FINEST = 8  # Smallest rtol, in machine epsilons; below it rounding hides the estimated error.


def choose_method(
    method: str,
    options: Mapping[str, Any],
    *,
    wall: str = "soft",
    dtype: str = "float64",
    excitation: Excitation | None = None,
) -> Method | None:
    """Return the method with a given name and options; None stands for the exact engine under a sine forcing.

    With method="exact", an excitation other than the sine returns `Driven`, which is as accurate as the exact engine.
    The method "ode" accepts the sine and harmonics, "rk4" only the sine.

    Args:
        method: "exact", "ode" or "rk4".
        options: Values of solver, rtol, atol, membrane, friction and steps; None counts as not specified.
        wall: "soft" or "rigid".
        dtype: "float64" or "float32"; it sets the defaults of rtol and atol, and the smallest rtol.
        excitation: The sine by default. It must not contain a `Record`; `Record.waveform` converts a record into
            nondimensional samples.

    Raises:
        ValueError: An argument is invalid; the message has the argument, the requirement and the value.
    """
    validation.validate_choice("method", method, METHOD_OPTIONS)
    specified = {name: value for name, value in options.items() if value is not None}
    law = check_laws(specified.get("membrane", Linear()))
    if method == "exact" and not isinstance(representative_law(law), Linear):
        raise ValueError(
            see("methods", f'membrane must be linear for method="exact"; got {describe_law(law)}; use method="ode"')
        )
    for name in specified:
        methods = [candidate for candidate, names in METHOD_OPTIONS.items() if name in names]
        if method not in methods and name != "membrane":
            theirs, got = " or ".join(map(_quoted, methods)), validation.value_text(specified[name])
            raise ValueError(see("methods", f"{name} must be left out unless method is {theirs}; got {got}"))
    driving = _supported_excitation(method, excitation)
    if method == "exact":
        return None if driving is None else _driven(driving)
    if wall != "soft":
        raise ValueError(
            see("methods", f'wall must be "soft" for method={_quoted(method)}; got {wall!r}; use method="exact"')
        )
    # An engine is imported only if it is needed: diffrax takes a second to import.
    if method == "rk4":
        from vijax.impact.rk4 import Rk4

        steps = validation.validate_integer("steps", specified.get("steps", _STEPS), _FEWEST_STEPS, _MOST_STEPS)
        return Rk4(steps, law=law)
    solver = validation.validate_choice("solver", specified.get("solver", "Tsit5"), SOLVERS)
    rtol, atol = _DEFAULTS[dtype]
    least = _FINEST * float(np.finfo(dtype).eps)
    must = f"a finite number of at least {least:.1e}"
    rtol = validation.validate_real("rtol", specified.get("rtol", rtol), must, lambda x: least <= x < math.inf)
    atol = validation.validate_real(
        "atol", specified.get("atol", atol), "a finite number above 0", lambda x: 0 < x < math.inf
    )
    must = "a finite number of at least 0"
    friction = validation.validate_real("friction", specified.get("friction", 0.0), must, lambda x: 0 <= x < math.inf)
    if friction and driving is not None:
        raise ValueError(see("excitation", f"friction must be left out with an excitation; got {friction}"))
    from vijax.impact.forcing import harmonics_of
    from vijax.impact.ode.ode import Ode

    waves = None if driving is None else harmonics_of(driving)
    return Ode(solver, rtol, atol, friction=friction or None, harmonics=waves, law=law)


def _supported_excitation(method: str, excitation: Excitation | None) -> Excitation | None:
    """Return an excitation other than the sine if the method supports it; None for the sine."""
    if excitation is None or excitation.is_sine:
        return None
    if method == "rk4" or (method == "ode" and not excitation.is_periodic):
        also = ', or "ode" with harmonics,' if excitation.is_periodic else ""
        must = f'method must be "exact"{also} with {excitation}'
        raise ValueError(see("excitation", f"{must}; got {validation.value_text(method)}"))
    return excitation


def _driven(excitation: Excitation) -> Method:
    """Return the method of an excitation other than the sine."""
    from vijax.impact.forcing import forcing_of
    from vijax.impact.taylor.driven import Driven

    return Driven(forcing_of(excitation))


def method_attributes(method: Method | None, excitation: Excitation | None = None) -> dict[str, Any]:
    """Return the options of a method and its excitation as dataset attributes."""
    driving = {} if excitation is None or excitation.is_sine else {"excitation": str(excitation)}
    options = dict.fromkeys(name for names in METHOD_OPTIONS.values() for name in names)
    values = {name: getattr(method, name) for name in options if hasattr(method, name)}
    # The exact methods have no options. They support the linear membrane only, so no membrane is recorded for them.
    membrane = {"membrane": describe_law(method.law)} if method is not None and values else {}
    numbers = {name: np.asarray(value).item() for name, value in values.items() if value is not None}
    return membrane | numbers | driving


def _quoted(name: str) -> str:
    return f'"{name}"'
