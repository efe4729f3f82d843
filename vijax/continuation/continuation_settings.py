"""Settings of the continuation of a branch, with the effect of each on steps and events."""

import dataclasses
import math
from collections.abc import Callable

from vijax.runtime import validation

_MAX_COUNT = 10**6  # a larger number is a typing error

Rule = tuple[str, Callable[[float], bool]]  # requirement in words, and its test
# The whole range of the parameter has the arclength 1.
_LENGTH: Rule = ("an arclength between 0 and 1", lambda x: 0 < x <= 1)
_FRACTION: Rule = ("a number between 0 and 1", lambda x: 0 < x < 1)
_NUMBER_RULES: dict[str, Rule] = {
    "first_step": _LENGTH,
    "max_step": _LENGTH,
    "min_step": _LENGTH,
    "event_separation_step": _LENGTH,
    "growth": ("a finite number above 1", lambda x: 1 < x < math.inf),
    "min_cosine": _FRACTION,
    "max_bend_for_growth": _FRACTION,
    "newton_tolerance": _FRACTION,
    "zero_share": _FRACTION,
    "asymmetry": ("a positive finite number", lambda x: 0 < x < math.inf),
}
# Fields that are whole numbers of at least 1.
_COUNT_FIELDS = ("max_corrections_for_growth", "max_corrections", "max_narrowings", "closing_steps")


@dataclasses.dataclass(frozen=True)
class ContinuationSettings:
    """Settings of the steps along a branch, and of the classification of a change of sign on it.

    Lengths are arclengths in the space of the impact unknowns (onset times in half forcing periods, speeds into the
    wall in units of A pi/omega, contact durations) and of the parameter over its range, so that the whole range counts
    as one.

    Attributes:
        first_step: Length of the first step, 1e-3. A much longer first step may reach another branch near the start.
        max_step: Length of the longest step, 0.01. With a larger value there are fewer steps, but two events of one
            kind within one step are missed, because their test function changes sign twice. A branch also counts as
            closed within this distance of its start.
        min_step: Length below which a branch ends as "lost", 1e-9. With a larger value branches are lost where they
            bend sharply, as many do before a grazing; a much shorter step is below the rounding of some unknowns.
        growth: Factor on the length after an easy step, 1.5. With a larger factor more steps are rejected and halved.
        max_corrections_for_growth: Largest number of Newton corrections of an easy step, 3. With fewer, steps stay
            short: with 1 a branch has about eight times as many orbits.
        max_bend_for_growth: Largest bend of an easy step, as a fraction of the bend allowed by `min_cosine`, 0.2.
        min_cosine: Least cosine between the tangents at both ends of a step, 0.98: where the branch bends more, the
            step is halved. A smaller value cuts corners, and may jump between branches that pass close to each other.
        event_separation_step: Length below which several events may lie within one step, 1e-7. With a larger value the
            orbits just before an end are missing, and events that occur twice; with a value below rounding the branch
            is lost.
        newton_tolerance: Largest change of an unknown in the last Newton correction, 1e-11: the point is then as exact
            as rounding allows. Where rounding prevents such small corrections, a hundred times this value is accepted.
            With 1e-4 residuals are up to 1e-8.
        max_corrections: Newton corrections after which a step is halved, 6. With 2, steps stay short, as with a small
            `max_corrections_for_growth`.
        max_narrowings: Number of times that the interval around an event is narrowed, 40: by false position, and by
            bisection every third time. With 3, events were up to 5e-13 off, with 10 up to 6e-15.
        zero_share: Largest absolute value of a test function at a located change of sign, as a fraction of the sum of
            its absolute values at both ends of the step, 1e-3. If it is larger, the change of sign is a pole and no
            event. Too small a value drops events, ends of the branch included.
        asymmetry: Largest distance, in the impact unknowns, from an orbit at a bifurcation to its mirror image for
            which the orbit counts as symmetric, 1e-4. A bifurcation of a symmetric orbit is a pitchfork, not a fold. If
            a pitchfork is located nearby, five times this distance is allowed. Events of two branches that differ by
            less than `asymmetry` count as one event.
        closing_steps: Number of steps before a branch can close, 20. With too few steps, or with steps that are short
            compared with `max_step`, the branch closes before it has left its start.
        max_grazings: Number of grazes at soft walls through which a branch continues in each direction, 16. With 0 it
            ends at the first graze, as it does at rigid walls. Near chaos orbits graze again and again, and a larger
            number follows them to any length.

    Raises:
        ValueError: A value outside its range, or a first step that does not lie between the shortest and the longest.
    """

    first_step: float = 1e-3
    max_step: float = 0.01
    min_step: float = 1e-9
    growth: float = 1.5
    max_corrections_for_growth: int = 3
    max_bend_for_growth: float = 0.2
    min_cosine: float = 0.98
    event_separation_step: float = 1e-7
    newton_tolerance: float = 1e-11
    max_corrections: int = 6
    max_narrowings: int = 40
    zero_share: float = 1e-3
    asymmetry: float = 1e-4
    closing_steps: int = 20
    max_grazings: int = 16

    def __post_init__(self) -> None:
        # The dataclass is frozen, so that `object.__setattr__` has to write the validated and converted values.
        for name, (requirement, holds) in _NUMBER_RULES.items():
            object.__setattr__(self, name, validation.validate_real(name, getattr(self, name), requirement, holds))
        max_grazings = validation.validate_integer("max_grazings", self.max_grazings, 0, _MAX_COUNT)
        object.__setattr__(self, "max_grazings", max_grazings)
        for name in _COUNT_FIELDS:
            object.__setattr__(self, name, validation.validate_integer(name, getattr(self, name), 1, _MAX_COUNT))
        if not self.min_step <= self.first_step <= self.max_step:
            raise ValueError(
                f"first_step must lie between min_step and max_step; got {self.first_step:g} with "
                f"{self.min_step:g} and {self.max_step:g}"
            )


DEFAULT = ContinuationSettings()


def check_settings(settings: ContinuationSettings) -> ContinuationSettings:
    """Return the settings if they are `ContinuationSettings`; their values have been validated by the constructor."""
    return validation.validate_instance("settings", settings, ContinuationSettings, "vijax.ContinuationSettings(...)")
