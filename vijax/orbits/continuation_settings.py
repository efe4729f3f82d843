"""How a branch is followed: what a user may set, and what breaks when it moves."""

import dataclasses
import math
from collections.abc import Callable

from vijax.runtime import checks

_MOST_COUNT = 10**6  # larger ones are mistyped

Rule = tuple[str, Callable[[float], bool]]
_LENGTH: Rule = ("an arclength between 0 and 1", lambda x: 0 < x <= 1)
_SHARE: Rule = ("a number between 0 and 1", lambda x: 0 < x < 1)
_NUMBERS: dict[str, Rule] = {
    "first_step": _LENGTH,
    "max_step": _LENGTH,
    "min_step": _LENGTH,
    "crowded_step": _LENGTH,
    "growth": ("a finite number above 1", lambda x: 1 < x < math.inf),
    "min_cosine": _SHARE,
    "easy_bend": _SHARE,
    "newton_tolerance": _SHARE,
    "zero_share": _SHARE,
    "asymmetry": ("a positive finite number", lambda x: 0 < x < math.inf),
}
_COUNTS = ("easy_corrections", "max_corrections", "max_narrowings", "closing_steps")


@dataclasses.dataclass(frozen=True)
class ContinuationSettings:
    """What decides the steps along a branch, and what is made of a sign change on it.

    Lengths are arclengths in the space of knots (onset times in half forcing periods, speeds into the wall in units of
    A pi/omega, contact times) and of the parameter over its range, which so counts as one.

    Attributes:
        first_step: Length of the first step, 1e-3. A much longer one may land on another branch near the start.
        max_step: Length of the longest, 0.01. Longer steps are fewer, but pass over two events of one kind between
            neighbouring orbits, which leave no change of sign; a branch is closed within this distance of its start.
        min_step: Length at which a branch is given up as "lost", 1e-9. A larger one loses branches where they bend
            sharply, as many do before a grazing; a much smaller one no longer moves all digits of a point.
        growth: Factor on the length after an easy step, 1.5. With a larger one more steps are refused, and halved.
        easy_corrections: Newton corrections up to which a step is easy, 3. With fewer, steps stay short: with 1 about
            eight times as many orbits are on a branch.
        easy_bend: Part of the bend that `min_cosine` allows up to which a step is easy, 0.2.
        min_cosine: Least cosine between the tangents at both ends of a step, 0.98: where the branch bends more, the
            step is halved. A smaller one cuts corners, and may jump between branches that pass each other closely.
        crowded_step: Length below which several things may happen within one step, 1e-7. A larger one leaves out the
            orbits just before an end, and what happens twice; one that rounding cannot divide loses the branch.
        newton_tolerance: Size of the last Newton correction, 1e-11: the point is then as exact as rounding allows. A
            hundred times as much does where rounding lets it come no nearer. With 1e-4 residuals are up to 1e-8.
        max_corrections: Newton corrections of a step before it is halved, 6. With 2, steps stay as short as with few
            `easy_corrections`.
        max_narrowings: How often the interval that holds an event is narrowed, 40: by false position, with every third
            time a bisection. With 3, events were up to 5e-13 off, with 10 up to 6e-15.
        zero_share: Part of a test function's values at both ends of a step below which it is zero, 1e-3: a pole changes
            sign too, and stays far from zero. Too small a one drops events, ends of the branch among them.
        asymmetry: How far from its mirror image an orbit at a bifurcation is still symmetric, 1e-4 in knots: it decides
            between pitchfork and fold. One that is five times as far off counts if a pitchfork is located beside it. Of
            events of two branches that differ by less, one is not told from the other.
        closing_steps: Steps before a branch can have closed, 20. Too few of them, or too short ones beside `max_step`,
            and it closes before it has left its start.
        max_grazings: Grazes at soft walls that a branch goes through each way, 16. With 0 it ends at the first, as it
            does at rigid walls. Near chaos orbits graze again and again; a larger number follows them to any length.

    Raises:
        ValueError: A value that cannot be, or steps of which the first is not between the shortest and the longest.
    """

    first_step: float = 1e-3
    max_step: float = 0.01
    min_step: float = 1e-9
    growth: float = 1.5
    easy_corrections: int = 3
    easy_bend: float = 0.2
    min_cosine: float = 0.98
    crowded_step: float = 1e-7
    newton_tolerance: float = 1e-11
    max_corrections: int = 6
    max_narrowings: int = 40
    zero_share: float = 1e-3
    asymmetry: float = 1e-4
    closing_steps: int = 20
    max_grazings: int = 16

    def __post_init__(self) -> None:
        for name, (must, holds) in _NUMBERS.items():
            object.__setattr__(self, name, checks.real(name, getattr(self, name), must, holds))
        most = checks.whole("max_grazings", self.max_grazings, 0, _MOST_COUNT)
        object.__setattr__(self, "max_grazings", most)
        for name in _COUNTS:
            object.__setattr__(self, name, checks.whole(name, getattr(self, name), 1, _MOST_COUNT))
        if not self.min_step <= self.first_step <= self.max_step:
            raise ValueError(
                f"first_step must lie between min_step and max_step; got {self.first_step:g} with "
                f"{self.min_step:g} and {self.max_step:g}"
            )


DEFAULT = ContinuationSettings()


def check_settings(settings: ContinuationSettings) -> ContinuationSettings:
    """Return the settings, if they are some; a record of them holds only what can be."""
    return checks.instance("settings", settings, ContinuationSettings, "vijax.ContinuationSettings(...)")
