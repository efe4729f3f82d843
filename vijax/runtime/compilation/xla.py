"""Constructs that control XLA, for CPU and accelerator: stored values, kernels, loops, lanes, compiler options.

On the CPU, XLA makes one kernel of each stored value and calls the kernels one after another: with a few hundred lanes
the calls and the memory cost as much as the arithmetic. XLA can emit a computation of many such values as one kernel,
and does so by itself for loops of a few bytes, which it marks; `kernel` sets the same mark on a computation. If XLA
does not support the mark, and on any accelerator, the same arithmetic runs without the mark.

The mark is internal to XLA and undocumented. Before the first program is traced for a CPU, `kernel_failure` compiles a
small program with the mark and examines the result. If XLA ignores or rejects the mark, or if the environment has
`VIJAX_KERNELS=0` when vijax is imported, then `kernel`, `materialise`, `in_blocks` and `replace_rows` use no construct
that only XLA's compiler for CPUs supports, as on an accelerator. `VIJAX_KERNELS=0` also keeps lanes out of a GPU's
registers (`register_kernels`). Without the mark, results on a CPU agree to rounding (periodic cells to 1e-12), and
planes take three to five times as long.
"""

import os
import re
from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Bool, Int

from vijax.runtime.arrays import select
from vijax.runtime.doc_pages import see

P = ParamSpec("P")
T = TypeVar("T")

_LEGACY_EMITTER = "xla_cpu_use_fusion_emitters"
# Compiler passes that are disabled, because with them programs compile a sixth longer and run no faster.
_DISABLED_PASSES = (
    # Tiles already keep every core at work.
    "cpu-parallel-task-assigner",
    # The simplification pass reverses the moves of this pass, and both repeat until XLA stops at a limit.
    "reshape-mover",
    "while-loop-constant-sinking",
    "tree_reduction_rewriter",
    "zero_sized_hlo_elimination",
    "simplify-conditional",
)
_CPU_OPTIONS = {
    # On a CPU with 512-bit registers this has 1.5 times the throughput; on other CPUs LLVM splits the vectors.
    "xla_cpu_prefer_vector_width": 512,
    # With the default of 3 programs compile a fifth longer and run no faster.
    "xla_backend_optimization_level": 1,
    # XLA's newer emitter of fusions takes twice as long to compile, and its code runs no faster.
    _LEGACY_EMITTER: False,
    "xla_disable_hlo_passes": ",".join(_DISABLED_PASSES),
}
_GPU_OPTIONS = {
    # A run is one graph of kernels including its loops. Without this option the host evaluates the condition of a loop
    # before every trip, and a plane of 1024 x 1024 cells takes 2.5 times as long.
    "xla_gpu_enable_command_buffer": "FUSION,WHILE,CONDITIONAL,CUSTOM_CALL,DYNAMIC_SLICE_FUSION",
    "xla_gpu_graph_min_graph_size": 1,
}
# The cost of a program that runs for milliseconds is its compilation: without LLVM's optimisation it compiles in half
# the time, and runs up to five times as long.
_BRIEF = {"xla_backend_optimization_level": 0}
_NOT_INLINED = {"inlineable": "false"}  # a call that XLA cannot inline
_KERNEL_MARK = {"xla_cpu_small_call": "true"} | _NOT_INLINED
_TRIPS = 4  # trips of a short loop between two evaluations of its condition, on an accelerator
_FEW = 64  # up to this many balls are computed one after another on a CPU
_BLOCK = 64  # lanes: the values that a step stores fit in the first-level cache; with 32 LLVM runs out of registers

reuse_trace = jax.jit
"""Marks a building block that one program contains many times: it is traced once and the trace is reused, which cuts
the time before a program compiles to a third. XLA inlines it."""


def _kernels_enabled() -> bool:
    """Return False if the environment disables kernels.

    Raises:
        ValueError: If VIJAX_KERNELS is neither 0 nor 1.
    """
    value = os.environ.get("VIJAX_KERNELS", "1")
    if value not in ("0", "1"):
        raise ValueError(see("limits", f"VIJAX_KERNELS must be 0 (no kernels) or 1; got {value[:20]!r}"))
    return value == "1"


# Read once: programs compiled before a change would not follow it.
KERNELS = _kernels_enabled()


def platform() -> str:
    """Return the platform of new programs: the platform of JAX's preferred device, or of its default backend."""
    chosen: Any = jax.default_device.value
    return getattr(chosen, "platform", chosen) or jax.default_backend()


def on_cpu() -> bool:
    """Return True if programs are compiled for a CPU, not for an accelerator."""
    return platform() == "cpu"


def uses_kernels() -> bool:
    """Return True if programs traced now contain kernels made by XLA's mark."""
    return KERNELS and on_cpu() and not kernel_failure()


@cache
def kernel_failure() -> str:
    """Return the reason why XLA makes no kernel of a marked computation on the CPU; "" if it makes one.

    Compiles a marked computation of two stored values, without running it. This takes about 40 ms, once per process
    that traces a program; programs read from disk do not need it. A kernel of a whole computation has the name of that
    computation; other kernels have names of its operations.
    """

    def two_values(x: Any) -> Any:
        return _stored(jnp.sin(_stored(jnp.tan(_stored(x)))))

    def marked(x: Any) -> Any:
        return set_xla_metadata(jax.jit(two_values)(x), **_KERNEL_MARK)

    program = jax.jit(marked, compiler_options=compiler_options(brief=True))
    try:
        executable: Any = program.lower(jax.ShapeDtypeStruct((4,), jnp.float32)).compile().runtime_executable()
        made = executable.serialize()
    except Exception as error:  # any error of a later JAX here: planes can be computed without kernels
        return f"XLA rejects the mark of kernels: {str(error).partition(chr(10))[0][:200]}"
    # JAX keeps this program on disk, too. A program read from disk has the names of its kernels, but not the names of
    # the parts of XLA that made them, so only names of kernels are examined.
    return "" if re.search(rb"two_values[\w.]*_kernel", made) else "XLA ignores the mark of kernels"


def compiler_options(*, brief: bool = False) -> dict[str, Any]:
    """Return the options of `jax.jit` for the backend that JAX will use, without options set in XLA_FLAGS.

    Args:
        brief: True if the program runs so briefly that its cost is its compilation.
    """
    user_flags = os.environ.get("XLA_FLAGS", "")
    options = _options() | (_BRIEF if brief and on_cpu() else {})
    # An option that the user specifies in XLA_FLAGS is left to XLA.
    return {name: value for name, value in options.items() if name not in user_flags}


def _options() -> dict[str, Any]:
    options = {"cpu": _CPU_OPTIONS, "gpu": _GPU_OPTIONS}.get(platform(), {})
    # From JAX 0.11 on only the newer emitter exists, and this option is an error.
    return {name: value for name, value in options.items() if name != _LEGACY_EMITTER or jax.__version_info__ < (0, 11)}


@jax.jit
def _same(value: Any) -> Any:
    return value


@reuse_trace
def _stored(value: Any) -> Any:
    return set_xla_metadata(_same(value), **_NOT_INLINED)


def materialise(value: Any) -> Any:
    """Store a value used by several outputs: XLA on CPU fuses one output at a time, and would recompute it for each.

    With kernels, the value passes through an identity call that XLA cannot inline. An optimization barrier would not
    help, because XLA removes it before fusion, and no kernel may contain one; it is used without kernels, as JAX has no
    other construct. On an accelerator a fusion has several outputs and computes each value of a lane once; stored
    values would split a step of 3 kernels into 81.
    """
    if uses_kernels():
        return _stored(value)
    return lax.optimization_barrier(value) if on_cpu() else value


def materialised(work: Callable[P, T]) -> Callable[P, T]:
    """Return a function that stores its whole result; see `materialise`."""

    @wraps(work)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        return materialise(work(*args, **kwargs))

    return call


def kernel(work: Callable[P, T]) -> Callable[P, T]:
    """Compile a function as one kernel.

    The function may contain arithmetic, gathers, reductions and loops, but no scatter, sort or library call.
    """
    if not uses_kernels():
        return work

    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        # Trace first: values captured by `work` become inputs of the marked call.
        traced, shape = jax.make_jaxpr(work, return_shape=True)(*args, **kwargs)

        def body(closed_over, arguments):
            # A stored input counts as read: an input that nothing reads would crash the process.
            return jax.core.eval_jaxpr(traced.jaxpr, materialise(closed_over), *materialise(arguments))

        results = jax.jit(body)(traced.consts, jax.tree.leaves((args, kwargs)))
        return jax.tree.unflatten(jax.tree.structure(shape), set_xla_metadata(results, **_KERNEL_MARK))

    return call


def bounded_while_loop(work: Callable[[T], T], most: int, condition: Callable[[T], Bool[Array, ""]], state: T) -> T:
    """Apply `work` up to `most` times while `condition` holds."""

    def next_trip(carry: tuple[Any, T]) -> tuple[Any, T]:
        return carry[0] + 1, work(carry[1])

    start = jnp.zeros((), jnp.int32), state
    return lax.while_loop(lambda carry: (carry[0] < most) & condition(carry[1]), next_trip, start)[1]


def short_while_loop(condition: Callable[[T], Bool[Array, ""]], work: Callable[[T], T], state: T) -> T:
    """Apply `work` while `condition` holds: a `lax.while_loop` for short work on a few numbers.

    On an accelerator the evaluation of the condition after a trip takes longer than a short trip. Therefore four trips
    are made between two evaluations; a state that has ended in the meantime is not changed.
    """
    if on_cpu():
        return lax.while_loop(condition, work, state)

    def several_trips(state: T) -> T:
        for _ in range(_TRIPS):
            state = select(condition(state), work(state), state)
        return state

    return lax.while_loop(condition, several_trips, state)


def loop_body(work: Callable[P, T]) -> Callable[P, T]:
    """Return the body of a loop for reverse derivatives, including second ones, such as `jax.hessian` computes.

    When JAX 0.10 differentiates a loop in reverse, it drops custom derivative rules (`jax.custom_jvp`) in the body and
    differentiates the code inside, so that second derivatives would be silently wrong. It keeps the rules in a
    checkpointed body.
    """
    return jax.checkpoint(work, prevent_cse=False)


def map_lanes(work: Callable[P, T]) -> Callable[P, T]:
    """Return a function that applies `work` to every ball: arguments and results have one more leading axis.

    A CPU processes few balls one after another: code on numbers instead of rows compiles a quarter faster, and no ball
    waits for the longest search of another. Many balls, and all balls on an accelerator, are vectorised.
    """

    def call(*balls: P.args, **kwargs: P.kwargs) -> T:
        if on_cpu() and jax.tree.leaves(balls)[0].shape[0] <= _FEW:

            def apply_to_ball(ball: Any) -> T:
                return work(*ball, **kwargs)

            return lax.map(loop_body(apply_to_ball), balls)
        return jax.vmap(partial(work, **kwargs))(*balls)

    return call


def first_true_indices(mask: Bool[Array, " lane"], width: int) -> tuple[Int[Array, " width"], Bool[Array, " lane"]]:
    """Return the first `width` lanes of a mask (padded by others if fewer are True), and a mask of the selected lanes.

    The rank of a lane is the number of True lanes up to it. On the CPU the ranks are summed by doubling, ten times as
    fast as by XLA's cumulative sum, and the lanes are located by binary search, because no kernel may contain a
    scatter.
    """
    if on_cpu():
        rank = _summed(mask.astype(jnp.int32))
        members = jnp.searchsorted(rank, jnp.arange(1, width + 1, dtype=jnp.int32))
        return jnp.minimum(members, mask.size - 1), mask & (rank <= width)
    rank = jnp.cumsum(mask, dtype=jnp.int32)
    chosen = mask & (rank <= width)
    lane = jnp.arange(mask.size, dtype=jnp.int32)
    # Each selected lane writes its index at its rank; the others write past the end and are dropped.
    place = jnp.where(chosen, rank - 1, width + lane)
    return jnp.zeros(width, jnp.int32).at[place].set(lane, mode="drop", unique_indices=True), chosen


def _summed(count: Int[Array, " lane"]) -> Int[Array, " lane"]:
    # Inclusive prefix sum: after k steps each entry sums the last 2**k counts.
    reach = 1
    while reach < count.size:
        count = count + jnp.pad(count[:-reach], (reach, 0))
        reach *= 2
    return count


def round_up_to_blocks(count: int) -> int:
    """Round a number of lanes up so that `in_blocks` splits it evenly; less than one block is unchanged."""
    return -(-count // _BLOCK) * _BLOCK if uses_kernels() and count > _BLOCK else count


def in_blocks(work: Callable[[T], T], lanes: T) -> T:
    """Apply `work` to all lanes, on the CPU block by block: lanes of one block do not wait for lanes of another."""
    count = jax.tree.leaves(lanes)[0].shape[0]
    if not uses_kernels() or count <= _BLOCK:
        return work(lanes)
    # The number of lanes is a multiple of _BLOCK (`round_up_to_blocks`).
    blocks = jax.tree.map(lambda leaf: leaf.reshape(-1, _BLOCK, *leaf.shape[1:]), lanes)
    return jax.tree.map(lambda leaf: leaf.reshape(count, *leaf.shape[2:]), lax.map(work, blocks))


def replace_rows(lanes: T, part: T, rows: Int[Array, " row"], count: Int[Array, ""]) -> T:
    """Replace the rows `rows[:count]` of `lanes` by the rows of `part`.

    With kernels, rows are replaced one after another, because a kernel cannot contain a scatter, and other forms of
    merging read every lane. Without kernels every lane looks up its replacement, so that one scatter serves all leaves
    and the other operations fuse.
    """
    if not uses_kernels():
        size = jax.tree.leaves(lanes)[0].shape[0]
        order = jnp.arange(rows.size, dtype=jnp.int32)
        # Rows past `count` write past the end and are dropped.
        at = jnp.where(order < count, rows, size + order)
        source = jnp.full(size, -1, jnp.int32).at[at].set(order, mode="drop", unique_indices=True)
        new = jax.tree.map(lambda leaf: leaf[jnp.maximum(source, 0)], part)
        return select(source >= 0, new, lanes)

    def put_row(i, lanes):
        # Unsigned indices: support for negative ones is three operations per leaf, half of the code to compile.
        at, row = i.astype(jnp.uint32), rows[i].astype(jnp.uint32)

        def replaced(leaf, new):
            return lax.dynamic_update_slice_in_dim(leaf, lax.dynamic_slice_in_dim(new, at, 1), row, 0)

        return jax.tree.map(replaced, lanes, part)

    return lax.fori_loop(0, count, put_row, lanes)
