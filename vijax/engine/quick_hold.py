"""Contacts that gravity prolongs: how long they are sure to last, and where their ends are looked for."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.engine.impact import Lane
from vijax.engine.polynomial import long_decay, phase
from vijax.engine.quick_course import ContactEntry, Reference
from vijax.engine.quick_wall import DOUBT, SoftWall
from vijax.model.flow import PI
from vijax.runtime.arrays import choose, present
from vijax.runtime.xla import share, shared

# A contact that gravity prolongs is followed from so many 1/kappa before its steady response ends.
_BEFORE = 1.5
# log(kappa/omega1) is at most this times (zeta/omega1)^2.
_LOW_ENDS = 0.5


class Lasting(eqx.Module):
    """What is certain of a contact that gravity prolongs.

    Attributes:
        ebbs: It lasts until about the end of the steady response.
        dips: It lasts beyond the free one and ends at the first low of the swing, if it ends before the next.
        since: w is positive until this time, if it is from then on until the exit.
        pull: w'' is not below -pull from then on.
    """

    ebbs: Bool[Array, " lane"]
    dips: Bool[Array, " lane"]
    since: Lane
    pull: Lane

    @property
    def long(self) -> Bool[Array, " lane"]:
        """Say whether it outlasts the free one."""
        return self.ebbs | self.dips

    def ends(self, duration: Lane, out: Lane) -> Bool[Array, " lane"]:
        """Say whether a zero of w, met at a speed, is the first: by Taylor's formula w is positive before it."""
        way = duration - self.since
        return (self.dips | (way > 0)) & (2 * out > self.pull * way)


def prolonged(
    wall: SoftWall, entry: ContactEntry, rough: tuple[SoftWall, ContactEntry], begins: Lane
) -> tuple[Lasting, Reference]:
    """Find what is certain of contacts that outlast the free one, and from where the ends of those are sought.

    Args:
        wall, entry: Of the contact.
        rough: Both in single precision.
        begins: Phase of the forcing towards the wall at the onset.
    """
    when = present(wall.ebb).phase - begins
    when = share(when - 2 * jnp.floor(0.5 * when))
    lasting = lasts(*rough, when.astype(jnp.float32))
    turns = wall.omega1 * when * (1 / PI)
    sine, cosine = phase(turns - 2 * jnp.floor(0.5 * turns))
    return lasting, choose(lasting.ebbs, _ebb(wall, entry, when, cosine, sine), _dip(wall))


@shared
def lasts(wall: SoftWall, entry: ContactEntry, when: Lane) -> Lasting:
    """Say whether a contact is sure to outlast the free one, `when` being the end of its steady response R.

    w is positive for the time of a free contact since the forcing is (Duhamel with h > 0). The swing a e^(-zeta s)
    cos(omega1 s - f), f a quarter turn or more, falls from then on until its phase is a quarter turn and that of a free
    crest. Its low is there, the envelope times omega1/kappa. R, a sine above a constant, rises before it falls.

    If R is above the low as the free contact ends, w is positive from then until any time before the low at which it is
    so: it is above what it is then, or above what R was less the low. A contact that ends about there dips. Where R is
    above the low as that is over, too, gravity holds the ball until the forcing takes it off, and the contact ebbs. The
    envelope is as small as the low a little later, `_LOW_ENDS` of the swing's decay in a radian at most. From then on R
    is above the envelope if it is so shortly before `when`, -log R being convex.
    """
    ebb = present(wall.ebb)
    rest, pressure = present(entry.rest), present(entry.pressure)
    swing = share(jnp.sqrt(entry.free_cos * entry.free_cos + entry.free_sin * entry.free_sin))
    size = jnp.abs(wall.gain_in) + jnp.abs(wall.gain_out)
    # How much of the envelope is left `_BEFORE` that time, and a lower bound of R there.
    before, brake = _BEFORE / wall.kappa, _BEFORE * wall.zeta / wall.kappa
    ring = share((1 + DOUBT) * swing * long_decay(wall.zeta * when) * (1 + brake + brake * brake))
    fades = before * (ebb.rate - 0.5 * PI**2 * size * before) > ring
    # A forcing into the wall keeps w positive for the time of a free contact.
    force = entry.force_cos * wall.cos_span - entry.force_sin * wall.sin_span + pressure
    drive = entry.force_sin * wall.cos_span + entry.force_cos * wall.sin_span
    held = (entry.force > DOUBT) & (force > DOUBT) & ((entry.force_sin <= 0) | (drive >= 0)) & (wall.span < 1)
    # By how much f is beyond a quarter turn: by the sine of that at least, and by this at most.
    sine, decay = share((-entry.free_cos / swing, wall.zeta / wall.omega1))
    turn = sine * (1 + (0.5 * PI - 1) * sine * sine)
    envelope = swing * wall.r * wall.crest_decay / (1 + decay * sine)
    low = envelope * (wall.omega1 / wall.kappa) + DOUBT * rest
    steady_cos = entry.steady_cos * wall.cos_span + entry.steady_sin * wall.sin_span
    steady_sin = entry.steady_sin * wall.cos_span - entry.steady_cos * wall.sin_span
    later = steady_cos * wall.cos_crest + steady_sin * wall.sin_crest
    rate = PI * (steady_sin * wall.cos_crest - steady_cos * wall.sin_crest)
    delay = share((turn + _LOW_ENDS * decay) / wall.omega1)
    last = later + delay * (rate - 0.5 * PI**2 * size * delay)
    turned = (entry.free_sin > 0) & (entry.free_cos <= 0)
    outlasts = (pressure > 0) & turned & held & (steady_cos + rest > low) & (when < wall.span + ebb.arc)
    first_low = wall.span + wall.crest
    soon = when - before
    late = soon > first_low + delay
    ebbs = share(outlasts & (last + rest > low) & fades & late)
    # An exit is found within 0.53 free contacts of its course's reference. R rises again a period after it rose.
    dips = outlasts & ~ebbs & (2.1 * wall.span < when + 2 - ebb.arc)
    since = jnp.where(ebbs, soon, first_low + sine / wall.omega1)
    pull = PI**2 * size + wall.kappa * wall.kappa * jnp.where(ebbs, ring, envelope)
    return Lasting(ebbs, dips, since, (1 + DOUBT) * pull)


def _ebb(wall: SoftWall, entry: ContactEntry, when: Lane, cosine: Lane, sine: Lane) -> Reference:
    """Describe the time when the steady response ends, with cos and sin of omega1 s then."""
    ebb = present(wall.ebb)
    drive_cosine = ebb.force_cos * entry.force_cos + ebb.force_sin * entry.force_sin
    drive_sine = ebb.force_sin * entry.force_cos - ebb.force_cos * entry.force_sin
    return Reference(when, drive_cosine, drive_sine, cosine, sine, long_decay(wall.zeta * when))


def _dip(wall: SoftWall) -> Reference:
    """Describe the time of one and a half free contacts, where the swing is about at its low."""
    drive_cosine = wall.cos_span * wall.cos_middle - wall.sin_span * wall.sin_middle
    drive_sine = wall.sin_span * wall.cos_middle + wall.cos_span * wall.sin_middle
    none = jnp.zeros_like(wall.span)
    return Reference(1.5 * wall.span, drive_cosine, drive_sine, none, none - 1, wall.r * wall.root_r)
