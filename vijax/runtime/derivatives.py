"""Derivatives of a compiled function at numbers: one program, with our options of the compiler, of all slopes at once.

What JAX differentiates it compiles anew, with its own options, as a part of whatever `jax.grad` makes of the program
around it: of a steady state that takes three times as long as the program here, and happens for every kind of
derivative that is asked for. Where the arguments are traced themselves, under `jit`, `vmap` or a second derivative, JAX
compiles the derivative: of a function of rows a forward one, of any other as JAX differentiates it.
"""

import math
from collections.abc import Callable, Hashable
from functools import cache, partial, wraps
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree

from vijax.runtime import context, tiles
from vijax.runtime.programs import begin, jitted, tracing
from vijax.runtime.xla import share

T = TypeVar("T")

_LEAST = 8  # elements of a batch: compiling one element less takes longer than running eight


def differentiable(work: Callable[..., T], first: Callable[..., Any], like: Callable[[Any], Any]) -> Callable[..., T]:
    """Compile a function, and its derivatives where its arguments are numbers.

    It comes in two parts, programs of their own that are compiled at the same time: what is found first, of which no
    derivative is taken, and what is made of that.

    Args:
        work: Function of a module, of variables, of what is not varied, and of what was found first (pytrees of
            arrays), and of a `kind` that can be hashed, to a pytree of arrays. Its derivatives in all but the variables
            must be zero.
        first: Function of a module, of the variables, of what is not varied, and of the `kind`, to what is found first.
        like: Makes arrays of the shapes of what is found first, out of what is not varied.
    """
    finding, program = jitted(first, static=("kind",)), jitted(work, static=("kind",))

    @partial(jitted, static=("kind",), name=f"slopes of {work.__module__}.{work.__qualname__}")
    def slopes(variables: Any, fixed: Any, found: Any, *, kind: Hashable) -> tuple[list[jax.Array], T]:
        # As one vector: what XLA cuts up in a program it computes once for every piece.
        vector, tree = ravel_pytree(variables)

        def numbers(vector):
            result = work(tree(vector), fixed, found, kind=kind)
            return [leaf for leaf in jax.tree.leaves(result) if _varies(leaf)], result

        return jax.jacfwd(numbers, has_aux=True)(vector)

    def both(then: Callable[..., Any], variables: Any, fixed: Any, kind: Hashable) -> Any:
        numbers = tiles.library((variables, fixed)) is np
        if numbers:
            begin(then, variables, fixed, like(fixed), kind=kind)
        found = finding(jax.tree.map(lax.stop_gradient, variables), fixed, kind=kind)
        # As `like` makes them: of JAX's arrays it would be another program.
        found = jax.tree.map(np.asarray, found) if numbers else found
        return then(variables, fixed, found, kind=kind)

    @partial(jax.custom_jvp, nondiff_argnums=(2,))
    def call(variables: Any, fixed: Any, kind: Hashable) -> T:
        return of_few_lengths(lambda variables, fixed: both(program, variables, fixed, kind))(variables, fixed)

    @partial(call.defjvp, symbolic_zeros=True)
    def derivative(kind: Hashable, primals: Any, tangents: Any) -> tuple[T, T]:
        variables, fixed = primals
        if not _numbers(primals):
            moved = jax.tree.map(_dense, tangents[0], is_leaf=_is_zero)
            return jax.jvp(lambda variables: both(program, variables, fixed, kind), (variables,), (moved,))
        if tiles.library(primals) is np:
            # Within a derivative JAX takes a program apart before it compiles it, and what is to be shared is shared
            # no longer: twice the operations. No other thread is within one.
            with context.pool(1) as elsewhere:
                columns, result = elsewhere.submit(both, slopes, variables, fixed, kind).result()
            columns = list(map(np.asarray, columns))
        else:
            batched = of_few_lengths(lambda variables, fixed: both(slopes, variables, fixed, kind))
            columns, result = batched(variables, fixed)
        moved = jax.tree.leaves(tangents[0], is_leaf=_is_zero)
        rows = iter([_by_variable(column, variables) for column in columns])
        return result, jax.tree.map(lambda leaf: _along(leaf, rows, moved, _contracted), result)

    return wraps(work)(lambda variables, fixed, *, kind: call(variables, fixed, kind))


def differentiable_rows(work: Callable[..., T], sizes: tuple[int, ...]) -> Callable[..., T]:
    """Return a function of independent rows that computes derivatives of every order forward.

    A row has few variables and many results. Forward, all derivatives of a row take one pass; in reverse, JAX stores
    the whole run. The function that returns result and slopes is differentiable in the same way, so that second
    derivatives take one pass, too. At numbers, the slopes by all variables are one program, compiled with the options
    of vijax. If there are more rows than the largest size, JAX differentiates the function.

    Args:
        work: Function of a module, of what is not varied (hashable), of variables (pytrees of arrays [row]), and of
            `room` (static, by name), to a pytree of arrays [row, ...].
        sizes: Rows of a compiled call.
    """
    part = jax.jit(work, static_argnames="room")

    @cache
    def rows_with_slopes(which: tuple[int, ...]) -> Callable[..., tuple[T, list[jax.Array]]]:
        return differentiable_rows(_with_slopes(work, which), sizes)

    @partial(jitted, static=("room",), name=f"slopes by row of {work.__module__}.{work.__qualname__}")
    def slopes(fixed: Any, variables: Any, *, room: Hashable) -> tuple[T, list[jax.Array]]:
        every = tuple(range(len(jax.tree.leaves(variables))))
        return _with_slopes(work, every)(fixed, *variables, room=room)

    @partial(jax.custom_jvp, nondiff_argnums=(0, 2))
    def call(fixed: Any, variables: Any, room: Hashable) -> T:
        return of_few_lengths(partial(part, fixed, room=room))(*variables)

    @partial(call.defjvp, symbolic_zeros=True)
    def derivative(fixed: Any, room: Hashable, primals: Any, tangents: Any) -> tuple[T, T]:
        (variables,), (moved,) = primals, tangents
        rows, steps = jax.tree.leaves(variables), jax.tree.leaves(moved, is_leaf=_is_zero)
        own = tiles.library(rows)
        if len(rows[0]) > sizes[-1]:
            dense = jax.tree.map(_dense, moved, is_leaf=_is_zero)
            return jax.jvp(lambda *variables: part(fixed, *variables, room=room), variables, dense)
        if not _numbers(rows):
            # At least one: `jax.vmap` takes no empty axis.
            which = tuple(k for k, step in enumerate(steps) if not _is_zero(step)) or (0,)
            result, columns = rows_with_slopes(which)(fixed, *variables, room=room)
            steps = [steps[k] for k in which]
        elif own is np:
            # In a thread of its own, as above.
            with context.pool(1) as elsewhere:
                told = partial(slopes, fixed, room=room)
                result, columns = elsewhere.submit(tiles.map_tiles, told, variables, sizes).result()
            result = tiles.arrays(result)
        else:
            result, columns = of_few_lengths(partial(slopes, fixed, room=room))(variables)
        each = (own.moveaxis(column, -1, 0) for column in columns)
        return result, jax.tree.map(lambda leaf: _along(leaf, each, steps, _row_by_row), result)

    @wraps(work)
    def run(fixed: Any, *variables: Any, room: Hashable) -> T:
        return call(fixed, variables, room)

    return run


def _with_slopes(work: Callable[..., T], which: tuple[int, ...]) -> Callable[..., tuple[T, list[jax.Array]]]:
    """Return a function of rows that returns the result and its derivatives, along a new last axis.

    Args:
        work: As in `differentiable_rows`.
        which: Leaves of the variables by which the result is differentiated.
    """

    def both(fixed: Any, *variables: Any, room: Hashable) -> tuple[T, list[jax.Array]]:
        leaves, tree = jax.tree.flatten(variables)

        def of_rows(*rows: Any) -> T:
            return work(fixed, *jax.tree.unflatten(tree, rows), room=room)

        def along(direction: Any) -> tuple[T, list[jax.Array]]:
            moved = [jnp.zeros_like(leaf) for leaf in leaves]
            for k, step in zip(which, direction, strict=True):
                moved[k] = jnp.broadcast_to(step, leaves[k].shape)
            result, moves = jax.jvp(of_rows, leaves, moved)
            pairs = zip(*map(jax.tree.leaves, (result, moves)), strict=True)
            return result, [move for leaf, move in pairs if _varies(leaf)]

        return jax.vmap(along, out_axes=(None, -1))(jnp.eye(len(which), dtype=leaves[0].dtype))

    # A compiled program is kept by its name.
    both.__module__, both.__qualname__ = work.__module__, f"{work.__qualname__} with slopes by {which}"
    return both


def of_few_lengths(work: Callable[..., T]) -> Callable[..., T]:
    """Return a function of which `jax.vmap` compiles few lengths of a batch, outside of a compiled program.

    A batch is padded by its last element to the next power of two, and to `_LEAST` at least. No derivative is taken of
    the function itself.

    Args:
        work: Function of pytrees of arrays to a pytree of arrays.
    """

    @jax.custom_batching.custom_vmap
    def call(*given: Any) -> T:
        return work(*given)

    @call.def_vmap
    def batch(count: int, batched: Any, *given: Any) -> tuple[Any, Any]:
        several = jax.vmap(work, in_axes=tuple(jax.tree.map(lambda yes: 0 if yes else None, batched)))
        if tracing():
            result = several(*given)
        elif tiles.library(given) is jnp:  # one batch within another
            result = of_few_lengths(several)(*given)
        else:
            rows = np.minimum(np.arange(max(_LEAST, tiles.padded(count))), count - 1)
            wide = jax.tree.map(lambda leaf, yes: np.asarray(leaf)[rows] if yes else leaf, given, tuple(batched))
            result = tiles.arrays(jax.tree.map(lambda leaf: np.asarray(leaf)[:count], several(*wide)))
        return result, jax.tree.map(lambda _: True, result)

    # JAX traces a function with a rule for batches whenever it is called, so that only batches take that way.
    return lambda *given: call(*given) if tiles.library(given) is jnp and not tracing() else work(*given)


@jax.custom_jvp
def shared_slopes(value: Any) -> Any:
    """Keep a value that several results need, as `xla.share` does, and its derivative, which that would not."""
    return share(value)


@shared_slopes.defjvp
def _shared_slopes_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    return shared_slopes(primals[0]), share(tangents[0])


def _numbers(tree: Any) -> bool:
    """Return whether all leaves are numbers, or batches of numbers that `jax.vmap` makes outside of a program."""
    return not tracing() and not any(isinstance(_unbatched(leaf), jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def _unbatched(leaf: Any) -> Any:
    # The class has no public name. By another name its batches would be differentiated as JAX does, for every length.
    while type(leaf).__name__ == "BatchTracer":
        leaf = leaf.val
    return leaf


def _by_variable(column: Any, variables: Any) -> list[Any]:
    """Cut the derivatives of a result, by all numbers of the variables, into those by each of them."""
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(variables)]
    parts = tiles.library(column).split(column, np.cumsum([math.prod(shape) for shape in shapes])[:-1], axis=-1)
    return [part.reshape((*column.shape[:-1], *shape)) for part, shape in zip(parts, shapes, strict=True)]


def _varies(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.inexact)


def _is_zero(leaf: Any) -> bool:
    return isinstance(leaf, SymbolicZero)


def _dense(moved: Any) -> Any:
    return jnp.zeros(moved.shape, moved.dtype) if _is_zero(moved) else moved


def _contracted(slope: Any, step: Any) -> jax.Array:
    return jnp.tensordot(slope, step, jnp.ndim(step))


def _row_by_row(slope: Any, step: Any) -> jax.Array:
    return slope * step.reshape(-1, *(1,) * (np.ndim(slope) - 1))


def _along(leaf: jax.Array, rows: Any, moved: list[Any], times: Callable[[Any, Any], jax.Array]) -> Any:
    """Compute the tangent of a result; of what holds no real numbers, JAX's word for none."""
    if not _varies(leaf):
        return np.zeros(leaf.shape, jax.dtypes.float0)
    # What nobody varies costs nothing.
    pairs = [(row, step) for row, step in zip(next(rows), moved, strict=True) if not _is_zero(step)]
    parts = [times(row, step) for row, step in pairs]
    return sum(parts[1:], start=parts[0]) if parts else jnp.zeros_like(leaf)
