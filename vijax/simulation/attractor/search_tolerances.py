"""Tolerances of the search for an attractor: for a recurrence of the motion, and for a converged Newton step."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from vijax.simulation.cell.cell import Settings

# Longest recurrence, in forcing periods, that counts as periodic; longer ones are chaos, or undecided. With a larger
# limit chaos recurs by chance more often, and each chance recurrence costs a search.
MAX_PERIOD = 32
# Longest recurrence of a late cell, which has spent its periods without a decision. The limit is higher because such a
# cell is not chaotic, and its orbit may be long.
LATE_PERIOD = 128
# Recurrence tolerance of a late cell, as a multiple of the slowest algebraic decay (`late_tolerance`).
_LATE_GAIN = 4.0


def repeatability_of(settings: Settings) -> Float[Array, ""] | float:
    """Return the largest distance between the ends of two rounds with equal starts: 0 unless steps are adaptive."""
    return 0.0 if settings.method is None else settings.method.repeatability


def recurrence_tolerance(dtype, repeatability=0.0):
    """Return the recurrence tolerance that starts a Newton round.

    It is 1e-6 in float64 and 3e-3 in float32, plus 100 times the method's repeatability.
    """
    return (1e-6 if dtype == jnp.float64 else 3e-3) + 100 * repeatability


def late_tolerance(periods):
    """Return the tolerance for a cell that has spent its periods: the slowest motion recurs within it by then.

    At a pitchfork the distance x to the orbit shrinks by c x^3 per period. After n periods x is (2 c n)^(-1/2), and the
    motion recurs to within c^(-1/2) (2 n)^(-3/2).
    """
    return _LATE_GAIN * (2 * periods) ** -1.5


def orbit_tolerance(dtype, repeatability=0.0):
    """Return the Newton correction of u and u' below which an orbit is accepted: 2e-12 in float64, 4e-6 in float32.

    In float32 the tolerance is closer to rounding (30 eps instead of 10^4 eps). With a larger one, an orbit accepted
    after the first round would contain the decay of a flip, which recurs sooner after two turns than after one, and the
    period would be reported twice too long.
    """
    return (1e4 if dtype == jnp.float64 else 30.0) * float(jnp.finfo(dtype).eps) + repeatability
