"""The door of the methods: which there are by name, what each is told, and how a map says so."""

import math
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from vijax.engine.method import Method
from vijax.model.choices import MethodName, SolverName
from vijax.model.excitation import Excitation
from vijax.model.membrane import Linear, check_laws, one_of, said
from vijax.runtime import checks
from vijax.runtime.pages import see

SOLVERS: tuple[SolverName, ...] = get_args(SolverName)
OPTIONS: dict[MethodName, tuple[str, ...]] = {
    "exact": (),
    "ode": ("solver", "rtol", "atol", "membrane", "friction"),
    "rk4": ("steps", "membrane"),
}
_DEFAULTS = {"float64": (1e-8, 1e-10), "float32": (1e-4, 1e-6)}  # rtol, atol
# Steps of rk4 per forcing period, unless said; how few and how many may be said. Fewer than 8 do not see the forcing,
# and beyond a million rounding is all that more would bring.
_STEPS, _FEWEST_STEPS, _MOST_STEPS = 1000, 8, 10**6
_FINEST = 8  # roundings: no error estimate is worth anything below


def choose(
    method: str,
    options: Mapping[str, Any],
    *,
    wall: str = "soft",
    dtype: str = "float64",
    excitation: Excitation | None = None,
) -> Method | None:
    """Make the method of a name, with what it is told; None for the exact one, which is told nothing.

    Any excitation but the sine has a method of its own, as exact as that of the sine; "ode" takes harmonics, too.

    Args:
        method: "exact", "ode" or "rk4".
        options: Of solver, rtol, atol, membrane, friction and steps those given; None counts as not given.
        wall: "soft" or "rigid".
        dtype: "float64" or "float32": the defaults of the tolerances, and the least that they may be.
        excitation: The sine unless given; no `Record`, which knows no units of a pair.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    checks.choice("method", method, OPTIONS)
    given = {name: value for name, value in options.items() if value is not None}
    law = check_laws(given.get("membrane", Linear()))
    if method == "exact" and not isinstance(one_of(law), Linear):
        raise ValueError(
            see("methods", f'membrane must be linear for method="exact"; got {said(law)}; use method="ode"')
        )
    for name in given:
        takers = [taker for taker, taken in OPTIONS.items() if name in taken]
        if method not in takers and name != "membrane":
            theirs, got = " or ".join(map(_quoted, takers)), checks.shown(given[name])
            raise ValueError(see("methods", f"{name} must be left out unless method is {theirs}; got {got}"))
    shaken = _shaken(method, excitation)
    if method == "exact":
        return None if shaken is None else _driven(shaken)
    if wall != "soft":
        raise ValueError(
            see("methods", f'wall must be "soft" for method={_quoted(method)}; got {wall!r}; use method="exact"')
        )
    # An engine is loaded when it is first asked for: diffrax takes a second.
    if method == "rk4":
        from vijax.engine.rk4 import Rk4

        return Rk4(checks.whole("steps", given.get("steps", _STEPS), _FEWEST_STEPS, _MOST_STEPS), law=law)
    solver = checks.choice("solver", given.get("solver", "Tsit5"), SOLVERS)
    rtol, atol = _DEFAULTS[dtype]
    least = _FINEST * float(np.finfo(dtype).eps)
    must = f"a finite number of at least {least:.1e}"
    rtol = checks.real("rtol", given.get("rtol", rtol), must, lambda x: least <= x < math.inf)
    atol = checks.real("atol", given.get("atol", atol), "a finite number above 0", lambda x: 0 < x < math.inf)
    must = "a finite number of at least 0"
    friction = checks.real("friction", given.get("friction", 0.0), must, lambda x: 0 <= x < math.inf)
    if friction and shaken is not None:
        raise ValueError(see("excitation", f"friction must be left out with an excitation; got {friction}"))
    from vijax.engine.forcing import harmonics_of
    from vijax.engine.ode import Ode

    waves = None if shaken is None else harmonics_of(shaken)
    return Ode(solver, rtol, atol, friction=friction or None, harmonics=waves, law=law)


def _shaken(method: str, excitation: Excitation | None) -> Excitation | None:
    """Pass an excitation that is not the sine, if a method knows it; None for the sine."""
    if excitation is None or excitation.sine:
        return None
    if method == "rk4" or (method == "ode" and not excitation.periodic):
        also = ', or "ode" with harmonics,' if excitation.periodic else ""
        must = f'method must be "exact"{also} with {excitation}'
        raise ValueError(see("excitation", f"{must}; got {checks.shown(method)}"))
    return excitation


def _driven(excitation: Excitation) -> Method:
    """Make the method of an excitation that is not the sine."""
    from vijax.engine.driven import Driven
    from vijax.engine.forcing import forcing

    return Driven(forcing(excitation))


def record(method: Method | None, excitation: Excitation | None = None) -> dict[str, Any]:
    """Name what a method was told, for the attributes of a map."""
    shaken = {} if excitation is None or excitation.sine else {"excitation": str(excitation)}
    options = dict.fromkeys(name for names in OPTIONS.values() for name in names)
    told = {name: getattr(method, name) for name in options if hasattr(method, name)}
    # The exact methods are told nothing, and know the linear membrane alone.
    membrane = {"membrane": said(method.law)} if method is not None and told else {}
    numbers = {name: np.asarray(value).item() for name, value in told.items() if value is not None}
    return membrane | numbers | shaken


def _quoted(name: str) -> str:
    return f'"{name}"'
