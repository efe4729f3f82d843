"""How closely a motion must come back to count as recurring, and Newton's step must end to count as an orbit."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.batch.cell import Settings

# Longest recurrence, in forcing periods, that counts as periodic; what takes longer is chaos, or undecided. With a
# larger one chaos comes back by chance more often, and each time costs a search.
MAX_PERIOD = 32
# The same for a late cell, whose periods are spent without a verdict: it is no chaos, and its orbit may be long.
LATE_PERIOD = 128
# A late cell's recurrence counts within so many times that of the slowest motion, `late_recurrence`.
_LATE_GAIN = 4.0


def grain(settings: Settings) -> Float[Array, ""] | float:
    """Say how far apart a round from one point may end: not at all, unless a solver chooses its steps."""
    return 0.0 if settings.method is None else settings.method.grain


def recurrence(dtype, grain=0.0):
    """Say how closely an impact must recur to start a Newton round: 1e-6 in float64, more as the method is coarse."""
    return (1e-6 if dtype == jnp.float64 else 3e-3) + 100 * grain


def late_recurrence(periods):
    """Say how closely an impact must recur once the periods are spent: as that of the slowest motion does by then.

    At a pitchfork the distance x to the orbit shrinks by c x^3 a period: it is (2 c n)^(-1/2) after n periods, and the
    motion recurs to within c^(-1/2) (2 n)^(-3/2).
    """
    return _LATE_GAIN * (2 * periods) ** -1.5


def settled(dtype, grain=0.0):
    """Give the Newton correction below which an orbit is accepted, of u and u': 2e-12 in float64, 4e-6 in float32.

    In float32 that is nearer to rounding: an orbit accepted at the first look would keep the decay of a flip, which
    recurs sooner after two turns than after one, and have twice its period.
    """
    return (1e4 if dtype == jnp.float64 else 30.0) * float(jnp.finfo(dtype).eps) + grain
