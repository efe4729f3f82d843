"""Work on rows of lanes as work on single lanes: a kernel of Triton knows neither slices nor joins of arrays.

`unrolled` follows the traced work operation by operation. What it makes of an array [row, ..., lane] is a NumPy array
of objects [row, ...], each of them a lane's worth, or one number where the lane makes no difference; slices, joins and
the like are then NumPy's and leave nothing in the program.
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

# The work is traced for so many lanes: an axis of that length is theirs, and no other has it.
_TRACED = 1009

Rows = Any
"""A NumPy array of objects: lanes, or numbers that are the same in all."""


def unrolled(work: Callable[..., Any], lanes: list[Any]) -> list[Any]:
    """Do `work` on lanes, arrays of one axis, without an operation on arrays of more; give its leaves.

    Args:
        work: On a list of such arrays; elementwise arithmetic, loops, and what changes, joins, cuts or sums up rows.
        lanes: What it is done on.
    """
    shapes = [jax.ShapeDtypeStruct((_TRACED,), leaf.dtype) for leaf in lanes]
    traced = jax.make_jaxpr(lambda *leaves: jax.tree.leaves(work(list(leaves))))(*shapes)
    count = lanes[0].shape[0]
    found = _follow(traced, count, list(map(_single, lanes)))
    return [_full(rows.item(), aval, count) for rows, aval in zip(found, traced.out_avals, strict=True)]


def _single(value: Any) -> Rows:
    """Make rows of a lane, or of an array of numbers."""
    return _laid(value.ravel(), value.shape) if isinstance(value, np.ndarray) else _laid([value], ())


def _laid(values: Iterable[Any], shape: tuple[int, ...]) -> Rows:
    """Lay values out as rows, one by one: NumPy would look into those that are arrays."""
    rows = np.empty(shape, object)
    for place, value in zip(np.ndindex(shape), values, strict=True):
        rows[place] = value
    return rows


def _wide(aval: Any) -> bool:
    """Say whether a value of the traced work has the axis of lanes."""
    return aval.shape[-1:] == (_TRACED,)


def _full(value: Any, aval: Any, count: int) -> Any:
    """Give a value that has the axis of lanes that axis, where it is the same in all."""
    value = jnp.asarray(value, aval.dtype)
    return jnp.broadcast_to(value, (count,)) if _wide(aval) else value


def _follow(traced: core.ClosedJaxpr, count: int, given: list[Rows]) -> list[Rows]:
    """Do what is traced, on rows."""
    jaxpr, consts = traced.jaxpr, [_single(np.asarray(const)) for const in traced.consts]
    known: dict[Any, Rows] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *given], strict=True))

    def read(var: Any) -> Rows:
        if not isinstance(var, core.Literal):
            return known[var]
        kind: Any = var.aval
        return _single(np.asarray(var.val, kind.dtype))

    for eqn in jaxpr.eqns:
        args = list(map(read, eqn.invars))
        known |= dict(zip(eqn.outvars, _done(eqn, count, args), strict=True))
    return list(map(read, jaxpr.outvars))


def _done(eqn: Any, count: int, args: list[Rows]) -> list[Rows]:
    """Do one operation."""
    name, params = eqn.primitive.name, eqn.params
    if name == "while":
        return _loop(params, count, args, [var.aval for var in eqn.outvars])
    if name == "scan":
        return _trips(params, count, args)
    if inner := params.get("jaxpr") or params.get("call_jaxpr"):
        # That of a body which is computed again for its derivative (`xla.loop_body`) holds no constants.
        return _follow(inner if isinstance(inner, core.ClosedJaxpr) else core.ClosedJaxpr(inner, ()), count, args)
    if name == "unstack":
        return _along_first(np.moveaxis(args[0], params["axis"], 0))
    if name in _REDUCTIONS:
        return [_reduced(eqn, count, args[0])]
    if name in _SHAPES:
        return [_SHAPES[name](args, **_of_rows(eqn))]
    if name not in _ELEMENTWISE:
        raise _beyond(name)
    if _wide(eqn.outvars[0].aval):
        # A last axis of length one stands for all lanes.
        each = zip(args, eqn.invars, strict=True)
        args = [rows if _wide(var.aval) or not rows.ndim else rows[..., 0] for rows, var in each]
    return [_each(partial(eqn.primitive.bind, **params), count, args)]


def _along_first(rows: Rows) -> list[Rows]:
    """Return the rows at each place of the first axis; NumPy's own iteration would unwrap those of one axis."""
    return [rows[i, ...] for i in range(len(rows))]


def _beyond(operation: str) -> NotImplementedError:
    return NotImplementedError(
        f"unrolled work must not {operation}; vijax.runtime.unrolled lists the operations it may use"
    )


def _of_rows(eqn: Any) -> dict[str, Any]:
    """Give the parameters of an operation on shapes, without the axis of lanes."""
    params = dict(eqn.params)
    out = eqn.outvars[0].aval
    params["shape"] = out.shape[:-1] if _wide(out) else out.shape
    if eqn.primitive.name == "broadcast_in_dim" and _wide(out):
        rows = len(params["shape"])
        params["broadcast_dimensions"] = tuple(axis for axis in params["broadcast_dimensions"] if axis < rows)
    if eqn.primitive.name == "slice" and _wide(out):
        params |= {name: params[name] and params[name][:-1] for name in ("start_indices", "limit_indices", "strides")}
    return params


def _broadcast(args: list[Rows], *, shape: tuple[int, ...], broadcast_dimensions: tuple[int, ...], **_: Any) -> Rows:
    rows = args[0]
    # A last axis of length one that became that of the lanes is none of the rows.
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
# How two rows become one.
_REDUCTIONS: dict[str, Callable[..., Any]] = {"reduce_or": lax.bitwise_or, "reduce_sum": lax.add}


def _reduced(eqn: Any, count: int, rows: Rows) -> Rows:
    """Reduce rows one after another.

    Lanes tell each other no more than whether any is to go on: anything else would depend on which are side by side.
    """
    name, axes = eqn.primitive.name, eqn.params["axes"]
    own = tuple(axis for axis in axes if axis < rows.ndim)
    if own:
        laid = np.moveaxis(rows, own, range(len(own)))
        laid = laid.reshape(-1, *laid.shape[len(own) :])
        join = partial(_each, _REDUCTIONS[name], count)
        rows = reduce(lambda one, other: join([one, other]), _along_first(laid))
    if len(own) == len(axes):
        return rows
    if name != "reduce_or":
        raise _beyond(f"{name} over lanes")
    return _each(_any, count, [rows])


def _each(work: Callable[..., Any], count: int, args: list[Rows]) -> Rows:
    """Do elementwise arithmetic on every row."""
    shape = np.broadcast_shapes(*(rows.shape for rows in args))
    wide = [np.broadcast_to(rows, shape) for rows in args]
    return _laid((_one(work, count, [rows[place] for rows in wide]) for place in np.ndindex(shape)), shape)


def _one(work: Callable[..., Any], count: int, values: list[Any]) -> Any:
    if all(isinstance(value, np.generic) for value in values):
        with jax.ensure_compile_time_eval():
            return np.asarray(work(*values))[()]
    if any(value.ndim for value in values):
        values = [jnp.broadcast_to(jnp.asarray(value), (count,)) for value in values]
    return work(*values)


def _trips(params: dict[str, Any], count: int, args: list[Rows]) -> list[Rows]:
    """Do a loop whose trips are known as so many pieces of work; one over rows is none of these."""
    consts, carry, scanned = _parts(params, args)
    if scanned or len(params["jaxpr"].out_avals) > len(carry):
        raise _beyond("scan rows")
    for _ in range(params["length"]):
        carry = _follow(params["jaxpr"], count, [*consts, *carry])
    return carry


def _parts(params: dict[str, Any], args: list[Rows]) -> tuple[list[Rows], list[Rows], list[Rows]]:
    """Return the constants, the carry and the scanned rows among the arguments of a scan."""
    if "ft_in" in params:  # JAX 0.12 names the three parts by a tree, earlier ones by their lengths
        consts, carry, scanned = map(list, params["ft_in"].update(args).unpack())
        return consts, carry, scanned
    first, second = params["num_consts"], params["num_consts"] + params["num_carry"]
    return args[:first], args[first:second], args[second:]


def _loop(params: dict[str, Any], count: int, args: list[Rows], shapes: list[Any]) -> list[Rows]:
    """Go on while the condition holds, with a flat list of lanes and numbers; each lane on its own if it is one's."""
    first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    for_cond, for_body, start = args[:first], args[first:second], args[second:]

    def flat(carry: list[Rows]) -> list[Any]:
        each = zip(carry, shapes, strict=True)
        return [_full(value, aval, count) for rows, aval in each for value in rows.reshape(-1)]

    def laid(values: Any) -> list[Rows]:
        left = iter(values)
        return [_laid(itertools.islice(left, rows.size), rows.shape) for rows in start]

    def going(values: list[Any]) -> Any:
        return _follow(params["cond_jaxpr"], count, [*for_cond, *laid(values)])[0].item()

    def trip(values: list[Any]) -> list[Any]:
        return flat(_follow(params["body_jaxpr"], count, [*for_body, *laid(values)]))

    if not _wide(params["cond_jaxpr"].out_avals[0]):
        return laid(lax.while_loop(going, trip, flat(start)))

    def own_trip(state: tuple[Any, list[Any]]) -> tuple[Any, list[Any]]:
        goes, values = state
        values = [lax.select(goes, after, before) for after, before in zip(trip(values), values, strict=True)]
        return going(values), values

    values = flat(start)
    return laid(lax.while_loop(lambda state: _any(state[0]), own_trip, (going(values), values))[1])


def _any(lanes: Any) -> Any:
    return lanes.sum(dtype=jnp.int32) > 0  # Triton knows no other way
