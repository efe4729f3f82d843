"""What vijax asks of XLA, other things of a CPU than of an accelerator.

Values that are stored, kernels of many operations, loops, lookups among lanes, options of its compiler.

On the CPU, XLA makes one kernel of each value that is stored and calls them one after another: with a few hundred lanes
calls and memory cost as much as the arithmetic. It can emit a computation of many such values as one kernel, and does
so by itself for loops of a few bytes; `kernel` asks for it by the same mark. An XLA that does not know the mark, and
any accelerator, runs the same arithmetic without it.

The mark is XLA's own and documented nowhere. Before the first program is traced for a CPU, `kernel_failure` compiles a
small program with the mark and examines what XLA made of it. If XLA ignores or rejects the mark, or if the environment
has `VIJAX_KERNELS=0` when vijax is imported, then `kernel`, `share`, `in_blocks` and `put` use no construct that only
XLA's compiler for CPUs knows, as on an accelerator. `VIJAX_KERNELS=0` also keeps lanes out of a GPU's registers
(`registers`). Results agree to rounding (periodic cells to 1e-12), and planes take three to five times as long.
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

from vijax.runtime.arrays import choose
from vijax.runtime.pages import see

P = ParamSpec("P")
T = TypeVar("T")

_OLD_WAY = "xla_cpu_use_fusion_emitters"
# Passes of the compiler that programs here take a sixth longer to compile with, and run no faster.
_LEFT_OUT = (
    # Tiles already keep every core at work.
    "cpu-parallel-task-assigner",
    # What it moves the simplification beside it moves back, again and again, until XLA stops counting.
    "reshape-mover",
    "while-loop-constant-sinking",
    "tree_reduction_rewriter",
    "zero_sized_hlo_elimination",
    "simplify-conditional",
)
_CPU_OPTIONS = {
    # Half again the throughput where the CPU has 512-bit registers; elsewhere LLVM splits them.
    "xla_cpu_prefer_vector_width": 512,
    # Of 3, the default, programs compile a fifth longer and run no faster.
    "xla_backend_optimization_level": 1,
    # XLA's newer way to emit a fusion takes twice as long to compile, and what it makes runs no faster.
    _OLD_WAY: False,
    "xla_disable_hlo_passes": ",".join(_LEFT_OUT),
}
_GPU_OPTIONS = {
    # A run is one graph of kernels, its loops in it: else the host is asked before every trip whether it goes on, and
    # a plane of 1024 x 1024 cells takes two and a half times as long.
    "xla_gpu_enable_command_buffer": "FUSION,WHILE,CONDITIONAL,CUSTOM_CALL,DYNAMIC_SLICE_FUSION",
    "xla_gpu_graph_min_graph_size": 1,
}
# A program that runs for milliseconds costs what it takes to compile: LLVM leaves it as it is, which takes half the
# time, and it runs up to five times as long.
_BRIEF = {"xla_backend_optimization_level": 0}
_STAYS = {"inlineable": "false"}  # a call that XLA does not see through
_ONE_KERNEL = {"xla_cpu_small_call": "true"} | _STAYS
_TRIPS = 4  # of a short loop, between two looks whether it goes on, on an accelerator
_FEW = 64  # balls that a CPU takes one after another
_BLOCK = 64  # lanes: what a step stores of them stays in the first cache; with 32 LLVM runs out of registers

once = jax.jit
"""Marks a building block that one program contains many times: tracing it once and reusing the trace cuts the time
before a program compiles to a third. XLA sees through it."""


def _kernels_wanted() -> bool:
    """Return False if the environment turns kernels off.

    Raises:
        ValueError: If VIJAX_KERNELS is neither 0 nor 1.
    """
    value = os.environ.get("VIJAX_KERNELS", "1")
    if value not in ("0", "1"):
        raise ValueError(see("limits", f"VIJAX_KERNELS must be 0 (no kernels) or 1; got {value[:20]!r}"))
    return value == "1"


# Read once: programs that are compiled already would not follow.
KERNELS = _kernels_wanted()


def platform() -> str:
    """Name the platform that programs are made for: that of the device which JAX was told to prefer, if it was."""
    chosen: Any = jax.default_device.value
    return getattr(chosen, "platform", chosen) or jax.default_backend()


def on_cpu() -> bool:
    """Say whether programs are made for a CPU, not for an accelerator."""
    return platform() == "cpu"


def uses_kernels() -> bool:
    """Return True if programs traced now contain kernels made by XLA's mark."""
    return KERNELS and on_cpu() and not kernel_failure()


@cache
def kernel_failure() -> str:
    """Return why XLA makes no kernel of a marked computation on the CPU; "" if it makes one.

    Compiles a marked computation of two stored values, without running it. This takes about 40 ms, once per process
    that traces a program; kept programs need no answer. A kernel of a whole computation has the name of that
    computation, others have names of its operations.
    """

    def two_values(x: Any) -> Any:
        return _kept(jnp.sin(_kept(jnp.tan(_kept(x)))))

    def marked(x: Any) -> Any:
        return set_xla_metadata(jax.jit(two_values)(x), **_ONE_KERNEL)

    program = jax.jit(marked, compiler_options=compiler_options(brief=True))
    try:
        executable: Any = program.lower(jax.ShapeDtypeStruct((4,), jnp.float32)).compile().runtime_executable()
        made = executable.serialize()
    except Exception as error:  # whatever a later JAX raises here, planes can be computed without kernels
        return f"XLA rejects the mark of kernels: {str(error).partition(chr(10))[0][:200]}"
    # JAX keeps this program too; read back, it has the names of kernels, not of the parts of XLA that made them.
    return "" if re.search(rb"two_values[\w.]*_kernel", made) else "XLA ignores the mark of kernels"


def compiler_options(*, brief: bool = False) -> dict[str, Any]:
    """Choose the options of `jax.jit` for the backend that JAX will use; what XLA_FLAGS says comes first.

    Args:
        brief: Whether the program runs so briefly that its compilation is what it costs.
    """
    said = os.environ.get("XLA_FLAGS", "")
    options = _options() | (_BRIEF if brief and on_cpu() else {})
    return {name: value for name, value in options.items() if name not in said}


def _options() -> dict[str, Any]:
    options = {"cpu": _CPU_OPTIONS, "gpu": _GPU_OPTIONS}.get(platform(), {})
    # From JAX 0.11 on there is the newer way alone, and to ask for the other is an error.
    return {name: value for name, value in options.items() if name != _OLD_WAY or jax.__version_info__ < (0, 11)}


@jax.jit
def _same(value: Any) -> Any:
    return value


@once
def _kept(value: Any) -> Any:
    return set_xla_metadata(_same(value), **_STAYS)


def share(value: Any) -> Any:
    """Keep a value that several results need: XLA on CPU fuses one result at a time, and would compute it for each.

    A call that does nothing and stays a call. (A barrier is taken away before fusion, and no kernel may contain one;
    without kernels it is what JAX offers.) An accelerator's fusion has many results and computes each value of a lane
    once: stored ones would cut a step that is 3 kernels into 81.
    """
    if uses_kernels():
        return _kept(value)
    return lax.optimization_barrier(value) if on_cpu() else value


def shared(work: Callable[P, T]) -> Callable[P, T]:
    """Make a function store its whole result; see `share`."""

    @wraps(work)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        return share(work(*args, **kwargs))

    return call


def kernel(work: Callable[P, T]) -> Callable[P, T]:
    """Make one kernel of a function: arithmetic, gathers, reductions and loops, no scatter, sort or library call."""
    if not uses_kernels():
        return work

    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        traced, shape = jax.make_jaxpr(work, return_shape=True)(*args, **kwargs)

        def body(closed_over, given):
            # Shared, every input is read: one that nothing reads would end the process.
            return jax.core.eval_jaxpr(traced.jaxpr, share(closed_over), *share(given))

        results = jax.jit(body)(traced.consts, jax.tree.leaves((args, kwargs)))
        return jax.tree.unflatten(jax.tree.structure(shape), set_xla_metadata(results, **_ONE_KERNEL))

    return call


def up_to(work: Callable[[T], T], most: int, goes_on: Callable[[T], Bool[Array, ""]], state: T) -> T:
    """Do `work` up to so many times while `goes_on`."""

    def again(carry: tuple[Any, T]) -> tuple[Any, T]:
        return carry[0] + 1, work(carry[1])

    start = jnp.zeros((), jnp.int32), state
    return lax.while_loop(lambda carry: (carry[0] < most) & goes_on(carry[1]), again, start)[1]


def search(goes_on: Callable[[T], Bool[Array, ""]], work: Callable[[T], T], state: T) -> T:
    """Do `work` while `goes_on`: `lax.while_loop` for short work on a few numbers.

    To end a trip takes an accelerator longer than such a trip does: it makes four at a time, and leaves alone what
    ended before.
    """
    if on_cpu():
        return lax.while_loop(goes_on, work, state)

    def some(state: T) -> T:
        for _ in range(_TRIPS):
            state = choose(goes_on(state), work(state), state)
        return state

    return lax.while_loop(goes_on, some, state)


def loop_body(work: Callable[P, T]) -> Callable[P, T]:
    """Make the body of a loop that may be differentiated in reverse, and that derivative again, as by `jax.hessian`.

    JAX 0.10 forgets a body's own rules of derivatives on the way (`jax.custom_jvp`) and differentiates what they
    compute: second derivatives would be wrong without a word. It keeps those of a body that is computed again.
    """
    return jax.checkpoint(work, prevent_cse=False)


def each(work: Callable[P, T]) -> Callable[P, T]:
    """Make what does `work` for every ball: arguments and results have a leading axis more.

    A CPU takes few balls one after another. What is made of numbers alone, not of rows, is a quarter less to compile,
    and no ball waits for the longest search of another. Many, and all on an accelerator, go abreast.
    """

    def call(*balls: P.args, **kwargs: P.kwargs) -> T:
        if on_cpu() and jax.tree.leaves(balls)[0].shape[0] <= _FEW:

            def one(ball: Any) -> T:
                return work(*ball, **kwargs)

            return lax.map(loop_body(one), balls)
        return jax.vmap(partial(work, **kwargs))(*balls)

    return call


def first(mask: Bool[Array, " lane"], width: int) -> tuple[Int[Array, " width"], Bool[Array, " lane"]]:
    """Find the first `width` lanes of a mask, any others where there are fewer; and for every lane whether it is one.

    By rank. On the CPU that is summed by doubling, ten times faster than XLA's, and looked up by binary search, as no
    kernel may hold a scatter.
    """
    if on_cpu():
        rank = _summed(mask.astype(jnp.int32))
        members = jnp.searchsorted(rank, jnp.arange(1, width + 1, dtype=jnp.int32))
        return jnp.minimum(members, mask.size - 1), mask & (rank <= width)
    rank = jnp.cumsum(mask, dtype=jnp.int32)
    chosen = mask & (rank <= width)
    lane = jnp.arange(mask.size, dtype=jnp.int32)
    place = jnp.where(chosen, rank - 1, width + lane)
    return jnp.zeros(width, jnp.int32).at[place].set(lane, mode="drop", unique_indices=True), chosen


def _summed(count: Int[Array, " lane"]) -> Int[Array, " lane"]:
    reach = 1
    while reach < count.size:
        count = count + jnp.pad(count[:-reach], (reach, 0))
        reach *= 2
    return count


def whole_blocks(count: int) -> int:
    """Round lanes up to what `in_blocks` parts evenly; fewer than one block stay as they are."""
    return -(-count // _BLOCK) * _BLOCK if uses_kernels() and count > _BLOCK else count


def in_blocks(work: Callable[[T], T], lanes: T) -> T:
    """Do `work` on all lanes, on the CPU block by block: lanes of one block do not wait for those of another."""
    count = jax.tree.leaves(lanes)[0].shape[0]
    if not uses_kernels() or count <= _BLOCK:
        return work(lanes)
    blocks = jax.tree.map(lambda leaf: leaf.reshape(-1, _BLOCK, *leaf.shape[1:]), lanes)
    return jax.tree.map(lambda leaf: leaf.reshape(count, *leaf.shape[2:]), lax.map(work, blocks))


def put(lanes: T, part: T, rows: Int[Array, " row"], count: Int[Array, ""]) -> T:
    """Replace the first `count` of these rows of `lanes` by those of `part`.

    On the CPU one after another: a scatter cannot be in a kernel, and what is merged otherwise is read in every lane.
    Elsewhere every lane looks up what replaces it: one scatter for all leaves, the rest of it fuses.
    """
    if not uses_kernels():
        size = jax.tree.leaves(lanes)[0].shape[0]
        order = jnp.arange(rows.size, dtype=jnp.int32)
        at = jnp.where(order < count, rows, size + order)
        source = jnp.full(size, -1, jnp.int32).at[at].set(order, mode="drop", unique_indices=True)
        new = jax.tree.map(lambda leaf: leaf[jnp.maximum(source, 0)], part)
        return choose(source >= 0, new, lanes)

    def one(i, lanes):
        # No row is counted from the end: to allow for it is three operations a leaf, half of what there is to compile.
        at, row = i.astype(jnp.uint32), rows[i].astype(jnp.uint32)

        def replaced(leaf, new):
            return lax.dynamic_update_slice_in_dim(leaf, lax.dynamic_slice_in_dim(new, at, 1), row, 0)

        return jax.tree.map(replaced, lanes, part)

    return lax.fori_loop(0, count, one, lanes)
