"""Search for the first zero (crossing) of a residual in every lane by certified samples, for `sampled_step`.

The search makes passes. A pass takes samples of the residual a fixed step h apart, with a bound M of the second
derivative between them. Between samples a > 0 and b > 0 there is no crossing if sqrt(a) + sqrt(b) > h sqrt(M/2).
Between a > 0 and b <= 0 there is exactly one if a - b > M h^2/2. An interval that satisfies neither is uncertain, and
the next pass samples it with a smaller step.
"""

from collections.abc import Callable
from operator import itemgetter
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.runtime.arrays import Lane
from vijax.runtime.compilation.xla import materialise, materialised, on_cpu

Samples = Float[Array, "sample lane"]
Rows = Float[Array, "*row lane"]
Powers = Float[Array, "sample *row lane"]

T = TypeVar("T")

SAMPLES = 32  # Samples per pass; a power of two, as `powers` doubles them.
# A lane without a result after this number of passes is declined and left to the fallback, because more passes would
# keep the other lanes waiting.
_PASSES = 6
_ZOOM = 1 / 16  # After an uncertain interval the next pass samples with this fraction of the sampling step.
FINEST = 1 / 8  # longest sampling step, as a fraction of half a period of the forcing and of the membrane
_NONE = float(SAMPLES)


class Crest(NamedTuple):
    """Deepest sample of a contact so far, with bounds of w between the samples."""

    when: Lane  # time of the deepest sample
    step: Lane  # sampling step at this sample
    height: Lane  # w at this sample
    most: Lane  # upper bound of w near this sample
    second: Lane  # upper bound of any other maximum


class Pass(NamedTuple):
    """State of a search for the first crossing of every lane.

    There is no crossing on (0, s]. Where `side` is not 0, the first crossing lies between s and s + h.
    """

    s: Lane
    h: Lane
    zoom: Lane  # factor of the next sampling step
    side: Lane  # +-1: the wall that is crossed; 0: not determined yet
    start: Lane  # residual at s (start) and at s + h (end)
    end: Lane
    crest: Crest


def powers(re: Rows, im: Rows) -> tuple[Powers, Powers]:
    """Return the powers 1 to SAMPLES of a complex number per lane, by doubling."""
    real, imaginary = re[None], im[None]
    while real.shape[0] < SAMPLES:
        more = (real * re - imaginary * im, real * im + imaginary * re)
        real, imaginary = materialise((jnp.concatenate([real, more[0]]), jnp.concatenate([imaginary, more[1]])))
        re, im = materialise((re * re - im * im, 2 * re * im))
    return real, imaginary


def reduce_samples(join: Callable[[T, T], T], samples: T) -> T:
    """Reduce all samples of each lane to one: join the first half with the second half until one sample is left.

    LLVM vectorises these operations, because each works on whole rows.

    Args:
        join: Combines two samples (arrays or trees). It is commutative, associative and idempotent: the order varies,
            and a sample may be combined with itself.
        samples: Any number of rows; a chain of joins would take six times as long to compile.
    """
    count = jax.tree.leaves(samples)[0].shape[0]
    while count > 1:
        count = (count + 1) // 2
        samples = join(*(jax.tree.map(itemgetter(half), samples) for half in (slice(count), slice(-count, None))))
    return jax.tree.map(itemgetter(0), samples)


@materialised
def smallest_sample(samples: Samples) -> Lane:
    """Return the smallest sample of each lane, faster than by XLA's own reduction, which is a scalar loop."""
    return reduce_samples(jnp.minimum, samples)


def safe_for(residual: Lane, rate: Lane, bend: Lane) -> Lane:
    """Return a time until which a residual > 0 stays positive, from its rate and second derivative >= -bend."""
    # Positive root of residual + rate s - bend s^2/2 = 0.
    return (rate + jnp.sqrt(jnp.maximum(rate * rate + 2 * bend * residual, 0.0))) / bend


class Crossing(NamedTuple):
    """Index of the first interval of a pass with a certified crossing, and of the first uncertain one; or _NONE."""

    closes: Lane
    uncertain: Lane


def curb_of(bend: Samples, fourth: Lane, h: Lane) -> Float[Array, "interval lane"]:
    """Return a bound of h^2/2 |g''| between samples of g'' (`bend`), where |g''''| is at most `fourth`."""
    size = jnp.abs(bend)
    return 0.5 * h * h * (jnp.maximum(size[:-1], size[1:]) + 0.125 * h * h * fourth)


def first_crossing(residual: Samples, curb: Float[Array, "interval lane"], slack: Lane) -> Crossing:
    """Return the first interval between samples with a certified crossing, and the first uncertain interval.

    Args:
        residual: Samples of the residual.
        curb: Bound of h^2/2 times the second derivative, for each interval.
        slack: Bound of the rounding error of a sample.
    """
    order = jnp.arange(SAMPLES - 1, dtype=residual.dtype)[:, None]
    root = materialise(jnp.sqrt(jnp.maximum(residual - slack, 0.0)))
    # With curb = M h^2/2 this is sqrt(a) + sqrt(b) > h sqrt(M/2): no crossing.
    clear = root[:-1] + root[1:] > jnp.sqrt(curb)
    closes = (residual[:-1] > 0) & (residual[1:] <= 0)
    # Exactly one crossing: a - b > M h^2/2.
    plain = closes & (residual[:-1] - residual[1:] > curb + slack)
    return Crossing(
        smallest_sample(materialise(jnp.where(plain, order, _NONE))),
        smallest_sample(materialise(jnp.where(clear | plain, _NONE, order))),
    )


def _at(samples: Samples, index: Lane) -> Lane:
    """Return one sample of each lane by its index.

    Kernels of an accelerator have no indexed lookup. On an accelerator all other samples are therefore replaced by 0
    and the samples are summed.
    """
    row = jnp.clip(index, 0, SAMPLES - 1)
    if on_cpu():
        return jnp.take_along_axis(samples, row.astype(jnp.int32)[None], axis=0)[0]
    order = jnp.arange(SAMPLES, dtype=row.dtype)[:, None]
    return jnp.where(order == row, samples, 0.0).sum(axis=0)


def search(advance: Callable[[Pass], Pass], side: Lane) -> Pass:
    """Make passes until every lane has its crossing, at most `_PASSES`; a lane with `side` != 0 is not searched."""
    zeros, unit = jnp.zeros_like(side), jnp.ones_like(side)
    start = Pass(zeros, zeros, unit, side, unit, zeros, Crest(zeros, zeros, zeros, zeros, zeros))

    def searching(carry):
        at, passes = carry
        return (at.side == 0).any() & (passes < _PASSES)

    return lax.while_loop(searching, lambda carry: (advance(carry[0]), carry[1] + 1), (start, 0))[0]


def record_pass(at: Pass, s: Samples, h: Lane, crossing: Crossing, side: Lane, residual: Samples, crest: Crest) -> Pass:
    """Return the state after a pass.

    The search continues at the crossing, at the first uncertain interval, or at the end of the samples. Lanes with a
    crossing are unchanged.
    """
    index = jnp.minimum(crossing.closes, crossing.uncertain)
    is_uncertain = crossing.uncertain < crossing.closes
    # The sampling step shrinks after an uncertain interval and grows back afterwards.
    zoom = jnp.where(is_uncertain, at.zoom * _ZOOM, jnp.minimum(at.zoom / _ZOOM, 1.0))
    side = jnp.where(crossing.closes < crossing.uncertain, side, 0.0).astype(h.dtype)
    new = Pass(_at(s, index), h, zoom, side, _at(residual, index), _at(residual, index + 1), crest)
    return jax.tree.map(lambda new_value, old_value: jnp.where(at.side == 0, new_value, old_value), new, at)


@materialised
def chord(result: Pass) -> Lane:
    """Return the time of the zero of the straight line between the two samples around a crossing."""
    return result.s + result.h * result.start / (result.start - result.end)
