"""Derivatives of compiled functions at concrete numbers: one program with vijax's compiler options computes all slopes.

JAX by itself compiles every kind of derivative anew, with its own options, as a part of the program that `jax.grad`
makes. For a steady state this takes three times as long as the compilation of the program here. If the arguments are
traced, under `jit`, `vmap` or a second derivative, JAX still compiles the derivative: functions of rows are then
differentiated in forward mode, others in the mode of JAX's transformation.
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

from vijax.runtime import public_api, tiles
from vijax.runtime.compilation.programs import is_tracing, jitted, start_compilation
from vijax.runtime.compilation.xla import materialise

T = TypeVar("T")

_LEAST = 8  # smallest batch: to compile a smaller one takes longer than to run eight elements


def differentiable(work: Callable[..., T], solver: Callable[..., Any], like: Callable[[Any], Any]) -> Callable[..., T]:
    """Compile a function, and its derivatives at concrete arguments.

    The function has two parts, compiled at the same time as two programs: a solver, which is not differentiated, and
    the differentiable function of its solution.

    Args:
        work: Module-level function of the variables, the fixed inputs, the solution (pytrees of arrays), and a hashable
            `kind`, to a pytree of arrays. Its derivatives in all arguments but the variables must be zero.
        solver: Module-level function of the variables, the fixed inputs, and the `kind`, to the solution.
        like: Function of the fixed inputs that returns arrays with the shapes of the solution.
    """
    solve_program, program = jitted(solver, static=("kind",)), jitted(work, static=("kind",))

    @partial(jitted, static=("kind",), name=f"slopes of {work.__module__}.{work.__qualname__}")
    def slopes(variables: Any, fixed: Any, solution: Any, *, kind: Hashable) -> tuple[list[jax.Array], T]:
        # Differentiate with respect to one vector of all variables. Separate derivatives by each variable would be
        # separate outputs, and XLA would compute the values that they share once for each.
        vector, tree = ravel_pytree(variables)

        def numbers(vector):
            result = work(tree(vector), fixed, solution, kind=kind)
            return [leaf for leaf in jax.tree.leaves(result) if _varies(leaf)], result

        return jax.jacfwd(numbers, has_aux=True)(vector)

    def both(then: Callable[..., Any], variables: Any, fixed: Any, kind: Hashable) -> Any:
        numbers = tiles.array_namespace((variables, fixed)) is np
        if numbers:
            # Compile the second program in another thread while the first one compiles and runs.
            start_compilation(then, variables, fixed, like(fixed), kind=kind)
        solution = solve_program(jax.tree.map(lax.stop_gradient, variables), fixed, kind=kind)
        # The solution becomes NumPy's arrays, as `like` returns, because JAX's arrays would need another program.
        solution = jax.tree.map(np.asarray, solution) if numbers else solution
        return then(variables, fixed, solution, kind=kind)

    @partial(jax.custom_jvp, nondiff_argnums=(2,))
    def call(variables: Any, fixed: Any, kind: Hashable) -> T:
        return batched_by_padding(lambda variables, fixed: both(program, variables, fixed, kind))(variables, fixed)

    @partial(call.defjvp, symbolic_zeros=True)
    def derivative(kind: Hashable, primals: Any, tangents: Any) -> tuple[T, T]:
        variables, fixed = primals
        if not _numbers(primals):
            # Traced arguments: JAX differentiates the second part along the tangents.
            variable_tangents = jax.tree.map(_dense, tangents[0], is_leaf=_is_zero)
            return jax.jvp(lambda variables: both(program, variables, fixed, kind), (variables,), (variable_tangents,))
        if tiles.array_namespace(primals) is np:
            # Inside `jax.grad` JAX would split the program before compiling it. Values used by several parts would be
            # computed by each: twice the operations. A call in another thread is not inside `jax.grad`.
            with public_api.pool(1) as elsewhere:
                columns, result = elsewhere.submit(both, slopes, variables, fixed, kind).result()
            columns = list(map(np.asarray, columns))
        else:
            batched = batched_by_padding(lambda variables, fixed: both(slopes, variables, fixed, kind))
            columns, result = batched(variables, fixed)
        variable_tangents = jax.tree.leaves(tangents[0], is_leaf=_is_zero)
        rows = iter([_by_variable(column, variables) for column in columns])
        return result, jax.tree.map(lambda leaf: _along(leaf, rows, variable_tangents, _contracted), result)

    return wraps(work)(lambda variables, fixed, *, kind: call(variables, fixed, kind))


def differentiable_rows(work: Callable[..., T], sizes: tuple[int, ...]) -> Callable[..., T]:
    """Return a function of independent rows that computes derivatives of every order in forward mode.

    A row has few variables and many results. In forward mode one pass computes all derivatives of a row; in reverse JAX
    stores the whole run. The function that returns result and slopes is differentiable in the same way, so second
    derivatives take one pass, too. At concrete numbers, the slopes by all variables are one program with vijax's
    compiler options. For more rows than the largest size, JAX differentiates the function.

    Args:
        work: Module-level function of the fixed input (hashable), the variables (pytrees of arrays [row]), and
            `capacity` (static, by name), to a pytree of arrays [row, ...].
        sizes: Numbers of rows of a compiled call.
    """
    part = jax.jit(work, static_argnames="capacity")

    @cache
    def rows_with_slopes(which: tuple[int, ...]) -> Callable[..., tuple[T, list[jax.Array]]]:
        return differentiable_rows(_with_slopes(work, which), sizes)

    @partial(jitted, static=("capacity",), name=f"slopes by row of {work.__module__}.{work.__qualname__}")
    def slopes(fixed: Any, variables: Any, *, capacity: Hashable) -> tuple[T, list[jax.Array]]:
        all_leaves = tuple(range(len(jax.tree.leaves(variables))))
        return _with_slopes(work, all_leaves)(fixed, *variables, capacity=capacity)

    @partial(jax.custom_jvp, nondiff_argnums=(0, 2))
    def call(fixed: Any, variables: Any, capacity: Hashable) -> T:
        return batched_by_padding(partial(part, fixed, capacity=capacity))(*variables)

    @partial(call.defjvp, symbolic_zeros=True)
    def derivative(fixed: Any, capacity: Hashable, primals: Any, tangents: Any) -> tuple[T, T]:
        (variables,), (tangent,) = primals, tangents
        rows, steps = jax.tree.leaves(variables), jax.tree.leaves(tangent, is_leaf=_is_zero)
        library = tiles.array_namespace(rows)
        if len(rows[0]) > sizes[-1]:
            dense = jax.tree.map(_dense, tangent, is_leaf=_is_zero)
            return jax.jvp(lambda *variables: part(fixed, *variables, capacity=capacity), variables, dense)
        if not _numbers(rows):
            # At least one variable: `jax.vmap` accepts no empty axis.
            which = tuple(k for k, step in enumerate(steps) if not _is_zero(step)) or (0,)
            result, columns = rows_with_slopes(which)(fixed, *variables, capacity=capacity)
            steps = [steps[k] for k in which]
        elif library is np:
            # In another thread, which is not inside `jax.grad`, as in `differentiable`.
            with public_api.pool(1) as elsewhere:
                slopes_program = partial(slopes, fixed, capacity=capacity)
                result, columns = elsewhere.submit(tiles.map_tiles, slopes_program, variables, sizes).result()
            result = tiles.arrays(result)
        else:
            result, columns = batched_by_padding(partial(slopes, fixed, capacity=capacity))(variables)
        by_variable = (library.moveaxis(column, -1, 0) for column in columns)
        return result, jax.tree.map(lambda leaf: _along(leaf, by_variable, steps, _row_by_row), result)

    @wraps(work)
    def run(fixed: Any, *variables: Any, capacity: Hashable) -> T:
        return call(fixed, variables, capacity)

    return run


def _with_slopes(work: Callable[..., T], which: tuple[int, ...]) -> Callable[..., tuple[T, list[jax.Array]]]:
    """Return a function of rows that returns the result and its derivatives, along a new last axis.

    Args:
        work: As in `differentiable_rows`.
        which: Indices of the leaves of the variables for the differentiation.
    """

    def both(fixed: Any, *variables: Any, capacity: Hashable) -> tuple[T, list[jax.Array]]:
        leaves, tree = jax.tree.flatten(variables)

        def of_rows(*rows: Any) -> T:
            return work(fixed, *jax.tree.unflatten(tree, rows), capacity=capacity)

        def along(direction: Any) -> tuple[T, list[jax.Array]]:
            directions = [jnp.zeros_like(leaf) for leaf in leaves]
            for k, step in zip(which, direction, strict=True):
                directions[k] = jnp.broadcast_to(step, leaves[k].shape)
            result, tangents = jax.jvp(of_rows, leaves, directions)
            pairs = zip(*map(jax.tree.leaves, (result, tangents)), strict=True)
            return result, [tangent for leaf, tangent in pairs if _varies(leaf)]

        # Forward derivatives along the unit vectors; the rows are independent, so one direction moves all rows at once.
        return jax.vmap(along, out_axes=(None, -1))(jnp.eye(len(which), dtype=leaves[0].dtype))

    # Compiled programs are kept under the function's name.
    both.__module__, both.__qualname__ = work.__module__, f"{work.__qualname__} with slopes by {which}"
    return both


def batched_by_padding(work: Callable[..., T]) -> Callable[..., T]:
    """Return a function that is compiled for few batch lengths only, if `jax.vmap` is applied outside of a program.

    A batch is padded with its last element to the next power of two, and to at least `_LEAST`. The function itself is
    not differentiated.

    Args:
        work: Function of pytrees of arrays to a pytree of arrays.
    """

    @jax.custom_batching.custom_vmap
    def call(*arguments: Any) -> T:
        return work(*arguments)

    @call.def_vmap
    def batch(count: int, batched: Any, *arguments: Any) -> tuple[Any, Any]:
        several = jax.vmap(work, in_axes=tuple(jax.tree.map(lambda yes: 0 if yes else None, batched)))
        if is_tracing():
            # Inside a program the length is fixed, and the batch is a part of that program.
            result = several(*arguments)
        elif tiles.array_namespace(arguments) is jnp:  # one batch within another
            result = batched_by_padding(several)(*arguments)
        else:
            # Pad with the last element to a few lengths, and cut the result to the real ones.
            rows = np.minimum(np.arange(max(_LEAST, tiles.padded(count))), count - 1)
            wide = jax.tree.map(lambda leaf, yes: np.asarray(leaf)[rows] if yes else leaf, arguments, tuple(batched))
            result = tiles.arrays(jax.tree.map(lambda leaf: np.asarray(leaf)[:count], several(*wide)))
        return result, jax.tree.map(lambda _: True, result)

    # JAX traces a function with a batching rule at every call, so only batches use it.
    return lambda *arguments: (
        call(*arguments) if tiles.array_namespace(arguments) is jnp and not is_tracing() else work(*arguments)
    )


@jax.custom_jvp
def materialise_with_slopes(value: Any) -> Any:
    """Store a value used by several outputs, as `xla.materialise` does, and also its derivative."""
    return materialise(value)


@materialise_with_slopes.defjvp
def _materialise_with_slopes_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    return materialise_with_slopes(primals[0]), materialise(tangents[0])


def _numbers(tree: Any) -> bool:
    """Return True if all leaves are concrete, or batches that `jax.vmap` makes outside of a program."""
    return not is_tracing() and not any(isinstance(_unbatched(leaf), jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def _unbatched(leaf: Any) -> Any:
    # JAX has no public name for the class of batches. If JAX renames it, batches are differentiated by JAX, with a new
    # compilation for every length.
    while type(leaf).__name__ == "BatchTracer":
        leaf = leaf.val
    return leaf


def _by_variable(column: Any, variables: Any) -> list[Any]:
    """Split the derivatives of a result by all numbers of the variables into the derivatives by each variable."""
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(variables)]
    parts = tiles.array_namespace(column).split(column, np.cumsum([math.prod(shape) for shape in shapes])[:-1], axis=-1)
    return [part.reshape((*column.shape[:-1], *shape)) for part, shape in zip(parts, shapes, strict=True)]


def _varies(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.inexact)


def _is_zero(leaf: Any) -> bool:
    return isinstance(leaf, SymbolicZero)


def _dense(tangent: Any) -> Any:
    return jnp.zeros(tangent.shape, tangent.dtype) if _is_zero(tangent) else tangent


def _contracted(slope: Any, step: Any) -> jax.Array:
    return jnp.tensordot(slope, step, jnp.ndim(step))


def _row_by_row(slope: Any, step: Any) -> jax.Array:
    return slope * step.reshape(-1, *(1,) * (np.ndim(slope) - 1))


def _along(leaf: jax.Array, rows: Any, tangents: list[Any], times: Callable[[Any, Any], jax.Array]) -> Any:
    """Return the tangent of a result; for integers and booleans, zeros of dtype float0, which JAX requires for them."""
    if not _varies(leaf):
        # float0 is JAX's tangent dtype of integers and booleans.
        return np.zeros(leaf.shape, jax.dtypes.float0)
    # Variables with a symbolically zero tangent cost nothing.
    pairs = [(row, step) for row, step in zip(next(rows), tangents, strict=True) if not _is_zero(step)]
    parts = [times(row, step) for row, step in pairs]
    return sum(parts[1:], start=parts[0]) if parts else jnp.zeros_like(leaf)
