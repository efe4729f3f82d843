"""Contacts that gravity prolongs: certificates of their exits, and reference times to start the search for the exits.

Without forcing and gravity a contact lasts pi/omega1 (the free contact); gravity into the wall can prolong it. The ball
then leaves near the first minimum of the oscillation. If w stays positive at this minimum, the ball leaves at about the
time when the steady response R of the membrane to gravity and forcing returns to zero.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vijax.impact.fast.fast_contact_motion import ContactEntry, Reference
from vijax.impact.fast.fast_walls import MARGIN, SoftWall
from vijax.impact.impact import Lane
from vijax.impact.polynomial import long_decay, phase
from vijax.model.flow import PI
from vijax.runtime.arrays import not_none, select
from vijax.runtime.compilation.xla import materialise, materialised

# w is certified to be positive until this time before the steady response reaches zero, in units of 1/kappa.
_BEFORE = 1.5
# log(kappa/omega1) is at most this number times (zeta/omega1)^2.
_LOW_ENDS = 0.5


class ProlongedContact(eqx.Module):
    """Certificates of a contact that gravity prolongs. The swing is w minus the steady response.

    Attributes:
        ends_at_steady_exit: The contact is certified to last until about the zero of the steady response.
        ends_at_first_minimum: The contact is certified to last longer than the free contact (pi/omega1). If it ends
            before the second maximum of the swing, it ends at about the first minimum of the swing.
        positive_until: A time. If w is positive from this time until the exit, w is positive before this time too.
        pull_bound: w'' >= -pull_bound after `positive_until`.
    """

    ends_at_steady_exit: Bool[Array, " lane"]
    ends_at_first_minimum: Bool[Array, " lane"]
    positive_until: Lane
    pull_bound: Lane

    @property
    def outlasts_free(self) -> Bool[Array, " lane"]:
        """Return True if the contact is certified to last longer than the free contact, pi/omega1."""
        return self.ends_at_steady_exit | self.ends_at_first_minimum

    def is_first_zero(self, duration: Lane, out: Lane) -> Bool[Array, " lane"]:
        """Certify that a zero of w with the outward speed `out` is the first one.

        By Taylor's formula w is positive between `positive_until` and the zero.
        """
        way = duration - self.positive_until
        return (self.ends_at_first_minimum | (way > 0)) & (2 * out > self.pull_bound * way)


def gravity_prolonged_contact(
    wall: SoftWall, entry: ContactEntry, rough: tuple[SoftWall, ContactEntry], begins: Lane
) -> tuple[ProlongedContact, Reference]:
    """Certify contacts that last longer than a contact without forcing, and return reference times for their exits.

    Args:
        wall, entry: Wall and onset of the contact.
        rough: Wall and onset in single precision.
        begins: Phase of the forcing towards the wall at the onset.

    Returns:
        The certificates, and for each lane the reference time that the search for the exit starts at.
    """
    when = not_none(wall.steady_exit).phase - begins
    when = materialise(when - 2 * jnp.floor(0.5 * when))
    prolonged = certify_prolonged(*rough, when.astype(jnp.float32))
    turns = wall.omega1 * when * (1 / PI)
    sine, cosine = phase(turns - 2 * jnp.floor(0.5 * turns))
    return prolonged, select(
        prolonged.ends_at_steady_exit,
        _steady_exit_reference(wall, entry, when, cosine, sine),
        _first_minimum_reference(wall),
    )


@materialised
def certify_prolonged(wall: SoftWall, entry: ContactEntry, when: Lane) -> ProlongedContact:
    """Certify that a contact lasts longer than the free contact, the contact without forcing and gravity.

    `when` is the time when the steady response R of the contact falls through zero. The penetration is w = R + swing,
    with the swing a e^(-zeta s) cos(omega1 s - f). The envelope is a e^(-zeta s).

    1. The forcing is positive during a free contact, so w is positive for that time (Duhamel's formula with h > 0).
    2. f is at least a quarter turn. From then on the swing falls until its minimum, where its phase is a quarter turn
       plus the phase of a free crest, and its value is -omega1/kappa times the envelope. R, a sine plus a constant,
       rises before it falls.
    3. If R exceeds the size of that minimum at the end of the free contact, then w > 0 from that time until any time s*
       before the minimum with w(s*) > 0: each w in between exceeds w(s*), or exceeds R at the end of the free contact
       minus the size of the minimum. Such a contact that ends about there ends at its first minimum.
    4. If R also exceeds the size of the minimum after the minimum, gravity holds the ball until the forcing lifts it
       off, and the contact ends at the steady exit. The envelope has the size of the minimum a little later, at most
       `_LOW_ENDS` times the decay of the swing per radian. From then on R exceeds the envelope if it does so shortly
       before `when`, because -log R is convex.
    """
    steady_exit = not_none(wall.steady_exit)
    rest, pressure = not_none(entry.rest), not_none(entry.pressure)
    swing = materialise(jnp.sqrt(entry.free_cos * entry.free_cos + entry.free_sin * entry.free_sin))
    size = jnp.abs(wall.gain_in) + jnp.abs(wall.gain_out)
    # Envelope at the time `_BEFORE` / kappa before `when`, and a lower bound of R there.
    before, brake = _BEFORE / wall.kappa, _BEFORE * wall.zeta / wall.kappa
    ring = materialise((1 + MARGIN) * swing * long_decay(wall.zeta * when) * (1 + brake + brake * brake))
    fades = before * (steady_exit.rate - 0.5 * PI**2 * size * before) > ring
    # Step 1: a forcing into the wall keeps w positive for the time of a free contact.
    force = entry.force_cos * wall.cos_span - entry.force_sin * wall.sin_span + pressure
    drive = entry.force_sin * wall.cos_span + entry.force_cos * wall.sin_span
    positive_in_free_contact = (
        (entry.force > MARGIN) & (force > MARGIN) & ((entry.force_sin <= 0) | (drive >= 0)) & (wall.span < 1)
    )
    # Angle of f beyond a quarter turn: a lower bound (its sine), and an upper bound.
    sine, decay = materialise((-entry.free_cos / swing, wall.zeta / wall.omega1))
    turn = sine * (1 + (0.5 * PI - 1) * sine * sine)
    envelope = swing * wall.r * wall.crest_decay / (1 + decay * sine)
    minimum_size = envelope * (wall.omega1 / wall.kappa) + MARGIN * rest
    steady_cos = entry.steady_cos * wall.cos_span + entry.steady_sin * wall.sin_span
    steady_sin = entry.steady_sin * wall.cos_span - entry.steady_cos * wall.sin_span
    steady_later = steady_cos * wall.cos_crest + steady_sin * wall.sin_crest
    rate = PI * (steady_sin * wall.cos_crest - steady_cos * wall.sin_crest)
    delay = materialise((turn + _LOW_ENDS * decay) / wall.omega1)
    last_steady = steady_later + delay * (rate - 0.5 * PI**2 * size * delay)
    has_swing = (entry.free_sin > 0) & (entry.free_cos <= 0)
    outlasts = (
        (pressure > 0)
        & has_swing
        & positive_in_free_contact
        & (steady_cos + rest > minimum_size)
        & (when < wall.span + steady_exit.arc)
    )
    first_minimum = wall.span + wall.crest
    check_time = when - before
    after_minimum = check_time > first_minimum + delay
    ends_at_steady_exit = materialise(outlasts & (last_steady + rest > minimum_size) & fades & after_minimum)
    # The exit lies within 0.53 durations of a free contact from the reference time, 1.5 durations. R rises again one
    # period after its last rise.
    ends_at_first_minimum = outlasts & ~ends_at_steady_exit & (2.1 * wall.span < when + 2 - steady_exit.arc)
    positive_until = jnp.where(ends_at_steady_exit, check_time, first_minimum + sine / wall.omega1)
    pull_bound = PI**2 * size + wall.kappa * wall.kappa * jnp.where(ends_at_steady_exit, ring, envelope)
    return ProlongedContact(ends_at_steady_exit, ends_at_first_minimum, positive_until, (1 + MARGIN) * pull_bound)


def _steady_exit_reference(wall: SoftWall, entry: ContactEntry, when: Lane, cosine: Lane, sine: Lane) -> Reference:
    """Return the time s = `when` as a reference; `cosine` and `sine` are cos and sin of omega1 s."""
    steady_exit = not_none(wall.steady_exit)
    drive_cosine = steady_exit.force_cos * entry.force_cos + steady_exit.force_sin * entry.force_sin
    drive_sine = steady_exit.force_sin * entry.force_cos - steady_exit.force_cos * entry.force_sin
    return Reference(when, drive_cosine, drive_sine, cosine, sine, long_decay(wall.zeta * when))


def _first_minimum_reference(wall: SoftWall) -> Reference:
    """Return 1.5 pi/omega1 as a reference time; the swing is about at its first minimum at this time."""
    drive_cosine = wall.cos_span * wall.cos_middle - wall.sin_span * wall.sin_middle
    drive_sine = wall.sin_span * wall.cos_middle + wall.cos_span * wall.sin_middle
    none = jnp.zeros_like(wall.span)
    return Reference(1.5 * wall.span, drive_cosine, drive_sine, none, none - 1, wall.r * wall.root_r)
