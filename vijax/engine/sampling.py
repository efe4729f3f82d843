"""A search for the first crossing of every lane by certified samples, pass after pass; `sampled` is built on it.

Samples a fixed distance apart, and a bound M on the second derivative between them, tell where a crossing can be: from
a > 0 to b > 0 a step h apart there is none if sqrt(a) + sqrt(b) > h sqrt(M/2), and from a > 0 to b <= 0 there is just
one if a - b > M h^2/2. A lane with a closer call is told to be in doubt.
"""

from collections.abc import Callable
from operator import itemgetter
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vijax.runtime.arrays import Lane
from vijax.runtime.xla import on_cpu, share, shared

Samples = Float[Array, "sample lane"]
Rows = Float[Array, "*row lane"]
Powers = Float[Array, "sample *row lane"]

T = TypeVar("T")

SAMPLES = 32  # A pass takes so many; a power of two, as `powers` doubles them.
_PASSES = 6  # After these a lane is declined, for the careful step to do: more keep the others waiting.
_ZOOM = 1 / 16  # where a pass met a doubt, the next one samples so much more closely
FINEST = 1 / 8  # longest sampling step, in half periods of the forcing and of the membrane
_NONE = float(SAMPLES)


class Crest(NamedTuple):
    """Where a contact is deepest so far."""

    when: Lane  # when the highest sample was
    step: Lane
    height: Lane
    most: Lane  # how high the maximum beside it could be
    rival: Lane  # and another one


class Pass(NamedTuple):
    """Search of every lane for its first crossing: none on (0, s]; then one between s and s + h."""

    s: Lane
    h: Lane
    zoom: Lane  # how much finer than usual the next samples are
    side: Lane  # +-1: the wall that is crossed; 0: none yet
    start: Lane  # distance at s and at s + h
    end: Lane
    crest: Crest


def powers(re: Rows, im: Rows) -> tuple[Powers, Powers]:
    """Compute powers 1 to SAMPLES of a complex number per lane, by doubling."""
    real, imaginary = re[None], im[None]
    while real.shape[0] < SAMPLES:
        more = (real * re - imaginary * im, real * im + imaginary * re)
        real, imaginary = share((jnp.concatenate([real, more[0]]), jnp.concatenate([imaginary, more[1]])))
        re, im = share((re * re - im * im, 2 * re * im))
    return real, imaginary


def joined(join: Callable[[T, T], T], samples: T) -> T:
    """Join all samples of each lane, half with half until one is left: whole rows, of which LLVM makes vectors.

    Args:
        join: Makes one of two, arrays or trees of them: in any order, and a sample may be its own partner.
        samples: Any number of rows; a chain of joins would be six times as much to compile.
    """
    count = jax.tree.leaves(samples)[0].shape[0]
    while count > 1:
        count = (count + 1) // 2
        samples = join(*(jax.tree.map(itemgetter(half), samples) for half in (slice(count), slice(-count, None))))
    return jax.tree.map(itemgetter(0), samples)


@shared
def least(samples: Samples) -> Lane:
    """Find the smallest of each lane; XLA's reduction is a scalar loop."""
    return joined(jnp.minimum, samples)


def safe_for(gap: Lane, rate: Lane, bend: Lane) -> Lane:
    """Find a time before which a gap that changes at `rate` cannot close if its second derivative is above -bend."""
    return (rate + jnp.sqrt(jnp.maximum(rate * rate + 2 * bend * gap, 0.0))) / bend


class Crossing(NamedTuple):
    """The first interval of a pass in which a gap surely closes, and the first that is in doubt; else _NONE."""

    closes: Lane
    doubt: Lane


def curb_of(bend: Samples, fourth: Lane, h: Lane) -> Float[Array, "interval lane"]:
    """Bound h^2/2 |g"| between samples of g", by their chord and a bound of its second derivative."""
    size = jnp.abs(bend)
    return 0.5 * h * h * (jnp.maximum(size[:-1], size[1:]) + 0.125 * h * h * fourth)


def first_crossing(gap: Samples, curb: Float[Array, "interval lane"], slack: Lane) -> Crossing:
    """Find the first crossing among samples; `slack` is the rounding of one."""
    order = jnp.arange(SAMPLES - 1, dtype=gap.dtype)[:, None]
    root = share(jnp.sqrt(jnp.maximum(gap - slack, 0.0)))
    clear = root[:-1] + root[1:] > jnp.sqrt(curb)
    closes = (gap[:-1] > 0) & (gap[1:] <= 0)
    plain = closes & (gap[:-1] - gap[1:] > curb + slack)
    return Crossing(least(share(jnp.where(plain, order, _NONE))), least(share(jnp.where(clear | plain, _NONE, order))))


def _at(samples: Samples, index: Lane) -> Lane:
    """Look up a sample of each lane; an accelerator, whose kernels know no lookup, adds up all others as zeros."""
    row = jnp.clip(index, 0, SAMPLES - 1)
    if on_cpu():
        return jnp.take_along_axis(samples, row.astype(jnp.int32)[None], axis=0)[0]
    order = jnp.arange(SAMPLES, dtype=row.dtype)[:, None]
    return jnp.where(order == row, samples, 0.0).sum(axis=0)


def search(advance: Callable[[Pass], Pass], side: Lane) -> Pass:
    """Pass after pass until every lane has its crossing; one that begins with a `side` is not searched."""
    zero, one = jnp.zeros_like(side), jnp.ones_like(side)
    start = Pass(zero, zero, one, side, one, zero, Crest(zero, zero, zero, zero, zero))

    def searching(carry):
        at, passes = carry
        return (at.side == 0).any() & (passes < _PASSES)

    return lax.while_loop(searching, lambda carry: (advance(carry[0]), carry[1] + 1), (start, 0))[0]


def onward(at: Pass, s: Samples, h: Lane, crossing: Crossing, side: Lane, gap: Samples, crest: Crest) -> Pass:
    """Note a pass: the record stands at the crossing, the first doubt, or the end; crossings found are kept."""
    index = jnp.minimum(crossing.closes, crossing.doubt)
    doubtful = crossing.doubt < crossing.closes
    zoom = jnp.where(doubtful, at.zoom * _ZOOM, jnp.minimum(at.zoom / _ZOOM, 1.0))
    side = jnp.where(crossing.closes < crossing.doubt, side, 0.0).astype(h.dtype)
    new = Pass(_at(s, index), h, zoom, side, _at(gap, index), _at(gap, index + 1), crest)
    return jax.tree.map(lambda fresh, kept: jnp.where(at.side == 0, fresh, kept), new, at)


@shared
def chord(found: Pass) -> Lane:
    """Guess the crossing, between its two samples."""
    return found.s + found.h * found.start / (found.start - found.end)
