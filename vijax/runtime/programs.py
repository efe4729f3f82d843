"""Functions as programs of their own: compiled with our options, traced once for all processes, begun ahead of need."""

from collections.abc import Callable
from functools import cache, lru_cache, partial, wraps
from types import FunctionType
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from vijax.runtime import cache_folder, context, xla
from vijax.runtime.export_cache import TracedProgram

P = ParamSpec("P")
T = TypeVar("T")

_FEW = 64  # A program for so many rows at most is one that runs briefly.


def jitted(
    work: Callable[P, T], *, often: bool = False, name: str | None = None, static: tuple[str, ...] = ()
) -> Callable[P, T]:
    """Compile a function as `jax.jit` does, with our options of the compiler where it is a program of its own.

    Within a program that JAX traces it is a part of that, to which the options of that one apply. Its traced form is
    kept between processes where the function is known by a name and is called with arrays.

    Args:
        work: The function.
        often: Whether it is called so often that it must run fast on few rows, too.
        name: What it depends on besides its arguments, as text that is the same in every process; a function of a
            module is known by where it stands.
        static: Names of arguments that are no arrays, but make programs of their own; given by name.
    """
    known = name or _place(work)
    part = jax.jit(work, static_argnames=static)

    @cache  # JAX must not look for its backend before a program is called
    def program(brief: bool, platform: str) -> Callable[P, T]:
        return jax.jit(work, compiler_options=xla.compiler_options(brief=brief), static_argnames=static)

    @lru_cache(maxsize=32)
    def traced(said: tuple[tuple[str, Any], ...]) -> TracedProgram:
        return TracedProgram(partial(work, **dict(said)), f"{known} {said}")

    @wraps(work)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        given = jax.tree.leaves((args, kwargs))
        if tracing() or any(isinstance(leaf, jax.core.Tracer) for leaf in given):
            return part(*args, **kwargs)
        brief = not often and max(map(_rows, given), default=0) <= _FEW
        arrays = all(map(_is_array, jax.tree.leaves(args))) and set(kwargs) <= set(static)
        if known and arrays and cache_folder.kept():
            return traced(tuple(kwargs.items()))(*args, brief=brief)
        return program(brief, xla.platform())(*args, **kwargs)

    return call


def tracing() -> bool:
    """Say whether JAX traces a program here: it does where what it makes of a constant is no number."""
    return isinstance(jnp.zeros(()), jax.core.Tracer)


_begun: set[Any] = set()


def begin(work: Callable[..., Any], *args: Any, **static: Any) -> None:
    """Call a function in another thread, for the programs that it compiles, which will be needed next.

    XLA compiles on one core for most of its time, so that on two cores two programs take the time of one. The function
    is called once for every shape of its arguments; what it returns, or raises, is dropped.

    Args:
        work: A function of a module; it must be quick but for what it compiles.
        args: Pytrees of arrays; where they are traced nothing is begun.
        static: Arguments that are no arrays.
    """
    leaves, tree = jax.tree.flatten(args)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return
    shapes = tuple((np.shape(x), getattr(x, "dtype", type(x))) for x in leaves)
    key = work, tree, shapes, tuple(static.items())
    if key not in _begun:
        _begun.add(key)
        context.beside(work, *args, **static)


def _place(work: Callable[..., Any]) -> str | None:
    """Name a function of one of our modules; None where the name does not tell all that it does."""
    whole = isinstance(work, FunctionType) and not hasattr(work, "__wrapped__") and "<" not in work.__qualname__
    return f"{work.__module__}.{work.__qualname__}" if whole and work.__module__.startswith("vijax.") else None


def _rows(leaf: Any) -> int:
    return max(np.shape(leaf)[:1], default=0)


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, np.ndarray | np.generic | jax.Array)
