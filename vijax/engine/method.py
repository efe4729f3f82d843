"""The methods that integrate a cell: the numbers each one is told, and the door that checks them."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from vijax.model.membrane import HuntCrossley, Law, Linear
from vijax.model.pair import Real
from vijax.model.records import Impact, State
from vijax.runtime import checks

MethodName = Literal["exact", "ode", "rk4"]
SolverName = Literal["Bosh3", "Tsit5", "Dopri5", "Dopri8", "Kvaerno3", "Kvaerno4", "Kvaerno5"]
SOLVERS: tuple[SolverName, ...] = get_args(SolverName)
OPTIONS: dict[MethodName, tuple[str, ...]] = {
    "exact": (),
    "ode": ("solver", "rtol", "atol", "membrane"),
    "rk4": ("steps", "membrane"),
}
_DEFAULTS = {"float64": (1e-8, 1e-10), "float32": (1e-4, 1e-6)}  # rtol, atol
_STEPS = 1000
_FEWEST_STEPS, _MOST_STEPS = 8, 10**6
_FINEST = 8  # roundings: no error estimate is worth anything below


_DECISION = "decision"


def decided(choice: Any) -> Any:
    """Marks what a step decides (which branch it takes, how long the next one is) to be taken once; see `repeated`."""
    return jax.tree.map(partial(checkpoint_name, name=_DECISION), choice)


def repeated(run: Callable[..., Any]) -> Callable[..., Any]:
    """A run of steps that a derivative in reverse does again, with the decisions of the first time.

    The compiler may round the repetition in another way. To the motion that is rounding, but the error estimate of a
    step is itself close to it: lengths came out different in the sixth digit, steps were refused that had been
    accepted, and the derivatives that arrived were those of another place of the motion.
    """
    return jax.checkpoint(run, policy=_is_decision)


def _is_decision(primitive: Any, /, *_: Any, **params: Any) -> bool:
    # Not jax.checkpoint_policies.save_only_these_names: a primitive of equinox has a parameter of the name "prim" too.
    return primitive.name == "name" and params["name"] == _DECISION


class Passage(eqx.Module):
    """A finished impact of a stepping engine: from the exit of the last contact to the exit of this one.

    Attributes:
        impact: The impact.
        flight: Time from the last exit (or the start) to the onset.
        after: The ball as it leaves.
        tangent: Tangent map of the whole, row by row, saltations included; None where nobody asked for it.
    """

    impact: Impact
    flight: Float[Array, "..."]
    after: State
    tangent: tuple[Any, ...] | None


class Ode(eqx.Module):
    """An adaptive Runge-Kutta method of diffrax with located events.

    Attributes:
        solver: One of `SOLVERS`.
        rtol, atol: Tolerances of position and velocity, step by step.
        law: The membrane.
        dt: A constant step instead, for measuring orders of convergence.
    """

    solver: str = eqx.field(static=True)
    rtol: Real
    atol: Real
    law: Law
    dt: Real | None = None

    @property
    def arithmetic(self) -> bool:
        """Whether a step calls no library: the implicit solvers leave their linear systems to LAPACK."""
        return not self.solver.startswith("Kvaerno")


class Rk4(eqx.Module):
    """The paper's method: classical Runge-Kutta steps of constant length, no event located.

    Attributes:
        steps: Steps per forcing period.
        law: The membrane.
    """

    steps: Real
    law: Law

    @property
    def arithmetic(self) -> bool:
        """Whether a step calls no library."""
        return True


Method = Ode | Rk4


def choose(method: str, options: Mapping[str, Any], *, wall: str = "soft", dtype: str = "float64") -> Method | None:
    """The method of a name, with what it is told; None for the exact one, which is told nothing.

    Args:
        method: "exact", "ode" or "rk4".
        options: Of solver, rtol, atol, membrane and steps those given; None counts as not given.
        wall: "soft" or "rigid".
        dtype: "float64" or "float32": the defaults of the tolerances, and the least that they may be.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    checks.choice("method", method, OPTIONS)
    given = {name: value for name, value in options.items() if value is not None}
    law = given.get("membrane", Linear())
    if not isinstance(law, Linear | HuntCrossley):
        raise ValueError(
            f"membrane must be a vijax.HuntCrossley, or left out for the linear one; got {checks.shown(law)}"
        )
    if method == "exact" and not isinstance(law, Linear):
        raise ValueError(f'membrane must be linear for method="exact"; got {describe(law)}; use method="ode"')
    for name in given:
        takers = [taker for taker, taken in OPTIONS.items() if name in taken]
        if method not in takers and name != "membrane":
            theirs, got = " or ".join(map(_quoted, takers)), checks.shown(given[name])
            raise ValueError(f"{name} must be left out unless method is {theirs}; got {got}")
    if method == "exact":
        return None
    if wall != "soft":
        raise ValueError(f'wall must be "soft" for method={_quoted(method)}; got {wall!r}; use method="exact"')
    if method == "rk4":
        return Rk4(checks.whole("steps", given.get("steps", _STEPS), _FEWEST_STEPS, _MOST_STEPS), law)
    solver = checks.choice("solver", given.get("solver", "Tsit5"), SOLVERS)
    rtol, atol = _DEFAULTS[dtype]
    least = _FINEST * float(np.finfo(dtype).eps)
    must = f"a finite number of at least {least:.1e}"
    rtol = checks.real("rtol", given.get("rtol", rtol), must, lambda x: least <= x < math.inf)
    atol = checks.real("atol", given.get("atol", atol), "a finite number above 0", lambda x: 0 < x < math.inf)
    return Ode(solver, rtol, atol, law)


def describe(law: Law) -> str:
    """A membrane law in words: its name, as `--membrane` takes it, and its numbers."""
    if isinstance(law, Linear):
        return "linear"
    return f"hunt-crossley with chi {float(law.chi):g}, exponent {float(law.exponent):g}"


def record(method: Method | None) -> dict[str, Any]:
    """What a method was told, by name, for the attributes of a map."""
    if method is None:
        return {}
    told = {"membrane": describe(method.law)}
    if isinstance(method, Rk4):
        return told | {"steps": int(method.steps)}
    return told | {"solver": method.solver, "rtol": float(method.rtol), "atol": float(method.atol)}


def _quoted(name: str) -> str:
    return f'"{name}"'
