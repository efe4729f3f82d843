"""Functions as compiled programs: with vijax's compiler options, traced once for all processes."""

from collections.abc import Callable
from functools import cache, lru_cache, partial, wraps
from types import FunctionType
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from vijax.runtime import public_api
from vijax.runtime.compilation import cache_folder, xla
from vijax.runtime.compilation.export_cache import TracedProgram

P = ParamSpec("P")
T = TypeVar("T")

_FEW = 64  # up to this many rows a program counts as brief: its cost is its compilation


def jitted(
    work: Callable[P, T], *, often: bool = False, name: str | None = None, static: tuple[str, ...] = ()
) -> Callable[P, T]:
    """Compile a function like `jax.jit`, with vijax's compiler options if it is a program of its own.

    If it is called while another program is traced, the function becomes a part of the other program, with the options
    of that program. Otherwise its traced form is kept between processes if the function has a name and its arguments
    are arrays.

    Args:
        work: The function.
        often: True if the function is called so often that its program must be optimised even for few rows.
        name: Everything that the function depends on besides its arguments, as text that is the same in every process.
            A module-level function needs no name: it is identified by its module and qualified name.
        static: Names of arguments that are no arrays but select programs; passed by keyword.
    """
    identity = name or _place(work)
    part = jax.jit(work, static_argnames=static)

    @cache  # JAX must not search for its backend before a program is called
    def program(brief: bool, platform: str) -> Callable[P, T]:
        return jax.jit(work, compiler_options=xla.compiler_options(brief=brief), static_argnames=static)

    @lru_cache(maxsize=32)
    def traced(options: tuple[tuple[str, Any], ...]) -> TracedProgram:
        return TracedProgram(partial(work, **dict(options)), f"{identity} {options}")

    @wraps(work)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        leaves = jax.tree.leaves((args, kwargs))
        if is_tracing() or any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            # Inside another trace the options of the outer program apply.
            return part(*args, **kwargs)
        brief = not often and max(map(_rows, leaves), default=0) <= _FEW
        arrays = all(map(_is_array, jax.tree.leaves(args))) and set(kwargs) <= set(static)
        if identity and arrays and cache_folder.program_folder():
            # Kept on disk: identified by the function's location and the static arguments.
            return traced(tuple(kwargs.items()))(*args, brief=brief)
        return program(brief, xla.platform())(*args, **kwargs)

    return call


def is_tracing() -> bool:
    """Return True if JAX is tracing a program, because a new constant array is then a tracer."""
    return isinstance(jnp.zeros(()), jax.core.Tracer)


_started: set[Any] = set()


def start_compilation(work: Callable[..., Any], *args: Any, **static: Any) -> None:
    """Call a function in another thread, to compile the programs that will be needed next.

    XLA compiles on one core for most of the time, so on two cores two programs take the time of one. The function is
    called once per shape of its arguments; its result or exception is dropped.

    Args:
        work: A module-level function. It must be fast apart from its compilation, because it is really called.
        args: Pytrees of arrays; if any is traced, nothing is started.
        static: Arguments that are no arrays.
    """
    leaves, tree = jax.tree.flatten(args)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return
    shapes = tuple((np.shape(x), getattr(x, "dtype", type(x))) for x in leaves)
    key = work, tree, shapes, tuple(static.items())
    # Once per function, shapes and static arguments: later calls would compile nothing new.
    if key not in _started:
        _started.add(key)
        public_api.start_in_thread(work, *args, **static)


def _place(work: Callable[..., Any]) -> str | None:
    """Return the location of a module-level function of vijax; None if the name does not determine its behaviour."""
    is_plain = isinstance(work, FunctionType) and not hasattr(work, "__wrapped__") and "<" not in work.__qualname__
    return f"{work.__module__}.{work.__qualname__}" if is_plain and work.__module__.startswith("vijax.") else None


def _rows(leaf: Any) -> int:
    return max(np.shape(leaf)[:1], default=0)


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, np.ndarray | np.generic | jax.Array)
