"""Functions of rows of lanes rewritten as functions of single lanes: a Triton kernel has no slices or joins of arrays.

`lane_unrolling` traces the function and interprets it operation by operation. An array [row, ..., lane] becomes a NumPy
array of objects [row, ...]; each object is the values of all lanes, or one number if it is the same in all lanes.
Slices, joins and similar operations are then done by NumPy and leave no operation in the program.
"""

import itertools
from collections.abc import Callable, Iterable
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

# Number of lanes of the trace: a prime, so that an axis of this length is the axis of lanes and no other axis has it.
_TRACED = 1009

Rows = Any
"""A NumPy array of objects: values of all lanes, or numbers that are the same in all lanes."""


def unrolled(work: Callable[..., Any], lanes: list[Any]) -> list[Any]:
    """Apply `work` to one-axis arrays of lanes, without arrays of more axes; return the leaves of the result.

    Args:
        work: Function of a list of such arrays; elementwise arithmetic, loops, and operations that reshape, join, slice
            or sum rows.
        lanes: Arguments of `work`.
    """
    shapes = [jax.ShapeDtypeStruct((_TRACED,), leaf.dtype) for leaf in lanes]
    traced = jax.make_jaxpr(lambda *leaves: jax.tree.leaves(work(list(leaves))))(*shapes)
    count = lanes[0].shape[0]
    results = _interpret_jaxpr(traced, count, list(map(_single, lanes)))
    return [_full(rows.item(), aval, count) for rows, aval in zip(results, traced.out_avals, strict=True)]


def _single(value: Any) -> Rows:
    """Return rows made of one array of lanes, or of an array of numbers."""
    return _laid(value.ravel(), value.shape) if isinstance(value, np.ndarray) else _laid([value], ())


def _laid(values: Iterable[Any], shape: tuple[int, ...]) -> Rows:
    """Return values as rows of a shape, filled one by one: NumPy would convert values that are arrays."""
    rows = np.empty(shape, object)
    for place, value in zip(np.ndindex(shape), values, strict=True):
        rows[place] = value
    return rows


def _wide(aval: Any) -> bool:
    """Return True if a value of the traced work has the axis of lanes."""
    return aval.shape[-1:] == (_TRACED,)


def _full(value: Any, aval: Any, count: int) -> Any:
    """Return a value with the axis of lanes if `aval` has this axis; a value common to all lanes is broadcast."""
    value = jnp.asarray(value, aval.dtype)
    return jnp.broadcast_to(value, (count,)) if _wide(aval) else value


def _interpret_jaxpr(traced: core.ClosedJaxpr, count: int, arguments: list[Rows]) -> list[Rows]:
    """Interpret a traced function on rows."""
    jaxpr, consts = traced.jaxpr, [_single(np.asarray(const)) for const in traced.consts]
    # Environment of the interpreter: rows of every variable of the jaxpr.
    values: dict[Any, Rows] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True))

    def read(var: Any) -> Rows:
        if not isinstance(var, core.Literal):
            return values[var]
        kind: Any = var.aval
        return _single(np.asarray(var.val, kind.dtype))

    for eqn in jaxpr.eqns:
        args = list(map(read, eqn.invars))
        values |= dict(zip(eqn.outvars, _interpret(eqn, count, args), strict=True))
    return list(map(read, jaxpr.outvars))


def _interpret(eqn: Any, count: int, args: list[Rows]) -> list[Rows]:
    """Interpret one operation."""
    name, params = eqn.primitive.name, eqn.params
    if name == "while":
        return _loop(params, count, args, [var.aval for var in eqn.outvars])
    if name == "scan":
        return _trips(params, count, args)
    # Calls, such as jit and checkpoint: interpret their body.
    if inner := params.get("jaxpr") or params.get("call_jaxpr"):
        # The jaxpr of a checkpointed body (`xla.loop_body`) is open and has no constants.
        return _interpret_jaxpr(
            inner if isinstance(inner, core.ClosedJaxpr) else core.ClosedJaxpr(inner, ()), count, args
        )
    if name == "unstack":
        return _along_first(np.moveaxis(args[0], params["axis"], 0))
    if name in _REDUCTIONS:
        return [_reduced(eqn, count, args[0])]
    if name in _SHAPES:
        return [_SHAPES[name](args, **_of_rows(eqn))]
    if name not in _ELEMENTWISE:
        raise _unsupported(name)
    if _wide(eqn.outvars[0].aval):
        # A last axis of length one stands for all lanes: drop it.
        pairs = zip(args, eqn.invars, strict=True)
        args = [rows if _wide(var.aval) or not rows.ndim else rows[..., 0] for rows, var in pairs]
    return [_map_rows(partial(eqn.primitive.bind, **params), count, args)]


def _along_first(rows: Rows) -> list[Rows]:
    """Return the rows at each position of the first axis; NumPy's own iteration would unwrap one-axis rows."""
    return [rows[i, ...] for i in range(len(rows))]


def _unsupported(operation: str) -> NotImplementedError:
    """Return the error for work that contains an operation which cannot be mapped to single lanes."""
    return NotImplementedError(
        f"unrolled work must not {operation}; vijax.runtime.compilation.lane_unrolling lists the operations it may use"
    )


def _of_rows(eqn: Any) -> dict[str, Any]:
    """Return the parameters of an operation on shapes, without the axis of lanes."""
    params = dict(eqn.params)
    out = eqn.outvars[0].aval
    # The axis of lanes is always the last one.
    params["shape"] = out.shape[:-1] if _wide(out) else out.shape
    if eqn.primitive.name == "broadcast_in_dim" and _wide(out):
        rows = len(params["shape"])
        params["broadcast_dimensions"] = tuple(axis for axis in params["broadcast_dimensions"] if axis < rows)
    if eqn.primitive.name == "slice" and _wide(out):
        params |= {name: params[name] and params[name][:-1] for name in ("start_indices", "limit_indices", "strides")}
    return params


def _broadcast(args: list[Rows], *, shape: tuple[int, ...], broadcast_dimensions: tuple[int, ...], **_: Any) -> Rows:
    rows = args[0]
    # A last axis of length one that becomes the axis of lanes is no axis of the rows.
    rows = rows.reshape(rows.shape[: len(broadcast_dimensions)])
    laid = np.expand_dims(rows, tuple(axis for axis in range(len(shape)) if axis not in broadcast_dimensions))
    return np.broadcast_to(laid, shape)


def _cut(args: list[Rows], *, start_indices: Any, limit_indices: Any, strides: Any, **_: Any) -> Rows:
    steps = strides or (1,) * len(start_indices)
    return args[0][tuple(map(slice, start_indices, limit_indices, steps))]


_SHAPES: dict[str, Callable[..., Rows]] = {
    "broadcast_in_dim": _broadcast,
    "slice": _cut,
    "squeeze": lambda args, *, dimensions, **_: np.squeeze(args[0], dimensions),
    "reshape": lambda args, *, shape, **_: args[0].reshape(shape),
    "concatenate": lambda args, *, dimension, **_: np.concatenate(args, dimension),
    "stack": lambda args, *, axis, **_: np.stack(args, axis),
    "iota": lambda args, *, shape, dimension, dtype, **_: _single(
        np.broadcast_to(np.expand_dims(np.arange(shape[dimension], dtype=dtype), _others(shape, dimension)), shape)
    ),
}


def _others(shape: tuple[int, ...], dimension: int) -> tuple[int, ...]:
    return tuple(axis for axis in range(len(shape)) if axis != dimension)


_ARITHMETIC = """
    abs acos add and atan2 ceil clamp convert_element_type copy cos div eq exp expm1 floor ge gt integer_pow is_finite
    le log log1p lt max min mul ne neg not or pow rem rsqrt select_n sign sin sqrt square stop_gradient sub tan tanh xor
"""
_ELEMENTWISE = frozenset(_ARITHMETIC.split())
# Binary operation of each reduction.
_REDUCTIONS: dict[str, Callable[..., Any]] = {"reduce_or": lax.bitwise_or, "reduce_sum": lax.add}


def _reduced(eqn: Any, count: int, rows: Rows) -> Rows:
    """Reduce rows one after another.

    Over lanes only one reduction is permitted, "does any lane continue": every other result would depend on the lanes
    that share a block.
    """
    name, axes = eqn.primitive.name, eqn.params["axes"]
    row_axes = tuple(axis for axis in axes if axis < rows.ndim)
    if row_axes:
        laid = np.moveaxis(rows, row_axes, range(len(row_axes)))
        laid = laid.reshape(-1, *laid.shape[len(row_axes) :])
        join = partial(_map_rows, _REDUCTIONS[name], count)
        rows = reduce(lambda first, second: join([first, second]), _along_first(laid))
    if len(row_axes) == len(axes):
        return rows
    if name != "reduce_or":
        raise _unsupported(f"{name} over lanes")
    return _map_rows(_any, count, [rows])


def _map_rows(work: Callable[..., Any], count: int, args: list[Rows]) -> Rows:
    """Apply elementwise arithmetic to every row."""
    shape = np.broadcast_shapes(*(rows.shape for rows in args))
    wide = [np.broadcast_to(rows, shape) for rows in args]
    return _laid((_apply(work, count, [rows[place] for rows in wide]) for place in np.ndindex(shape)), shape)


def _apply(work: Callable[..., Any], count: int, values: list[Any]) -> Any:
    # Numbers common to all lanes are computed while tracing, and leave no operation in the kernel.
    if all(isinstance(value, np.generic) for value in values):
        with jax.ensure_compile_time_eval():
            return np.asarray(work(*values))[()]
    # If values of lanes and common numbers are mixed, all get the axis of lanes.
    if any(value.ndim for value in values):
        values = [jnp.broadcast_to(jnp.asarray(value), (count,)) for value in values]
    return work(*values)


def _trips(params: dict[str, Any], count: int, args: list[Rows]) -> list[Rows]:
    """Unroll a loop with a known number of trips; a loop over scanned rows is not supported."""
    consts, carry, scanned = _parts(params, args)
    if scanned or len(params["jaxpr"].out_avals) > len(carry):
        raise _unsupported("scan rows")
    for _ in range(params["length"]):
        carry = _interpret_jaxpr(params["jaxpr"], count, [*consts, *carry])
    return carry


def _parts(params: dict[str, Any], args: list[Rows]) -> tuple[list[Rows], list[Rows], list[Rows]]:
    """Return the constants, the carry and the scanned rows among the arguments of a scan."""
    if "ft_in" in params:  # JAX 0.12 stores the three parts as a tree, earlier versions their lengths
        consts, carry, scanned = map(list, params["ft_in"].update(args).unpack())
        return consts, carry, scanned
    carry_start, carry_end = params["num_consts"], params["num_consts"] + params["num_carry"]
    return args[:carry_start], args[carry_start:carry_end], args[carry_end:]


def _loop(params: dict[str, Any], count: int, args: list[Rows], shapes: list[Any]) -> list[Rows]:
    """Interpret a while loop on a flat list of lanes and numbers; lanes with their own condition end separately."""
    first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    for_cond, for_body, start = args[:first], args[first:second], args[second:]

    def flat(carry: list[Rows]) -> list[Any]:
        pairs = zip(carry, shapes, strict=True)
        return [_full(value, aval, count) for rows, aval in pairs for value in rows.reshape(-1)]

    def laid(values: Any) -> list[Rows]:
        remaining = iter(values)
        return [_laid(itertools.islice(remaining, rows.size), rows.shape) for rows in start]

    def continues(values: list[Any]) -> Any:
        return _interpret_jaxpr(params["cond_jaxpr"], count, [*for_cond, *laid(values)])[0].item()

    def trip(values: list[Any]) -> list[Any]:
        return flat(_interpret_jaxpr(params["body_jaxpr"], count, [*for_body, *laid(values)]))

    # A scalar condition: one loop for the whole block.
    if not _wide(params["cond_jaxpr"].out_avals[0]):
        return laid(lax.while_loop(continues, trip, flat(start)))

    # A condition per lane: lanes that have ended keep their values.
    def masked_trip(state: tuple[Any, list[Any]]) -> tuple[Any, list[Any]]:
        active, values = state
        values = [lax.select(active, after, before) for after, before in zip(trip(values), values, strict=True)]
        return continues(values), values

    values = flat(start)
    return laid(lax.while_loop(lambda state: _any(state[0]), masked_trip, (continues(values), values))[1])


def _any(lanes: Any) -> Any:
    return lanes.sum(dtype=jnp.int32) > 0  # Triton supports no `any`
