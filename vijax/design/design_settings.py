"""How the best device is sought: what a user may set, and what breaks when it moves."""

import dataclasses
from collections.abc import Callable
from typing import Any

from vijax.runtime import checks

_MOST_COUNT = 10**6  # larger ones are mistyped
_MOST_PERIOD = 1000  # forcing periods of an orbit

Rule = tuple[str, Callable[[float], bool]]
_SHARE: Rule = ("a number between 0 and 1", lambda x: 0 < x < 1)
_NUMBERS: dict[str, Rule] = {
    "min_promise": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "min_rival": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "max_excess": ("a positive number of at most 100", lambda x: 0 < x <= 100),
    "max_step": ("a positive number of at most 10", lambda x: 0 < x <= 10),
    "max_approach": _SHARE,
    "first_barrier": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "last_barrier": ("a positive number of at most 1e-6", lambda x: 0 < x <= 1e-6),
    "barrier_factor": _SHARE,
    "barrier_power": ("a number from 1 to 2", lambda x: 1 <= x <= 2),
    "same_optimum": _SHARE,
    "active_margin": _SHARE,
    "min_chaos": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "places_apart": ("a positive number of at most 1000", lambda x: 0 < x <= 1000),
    "ensemble_radius": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "last_radius": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "min_gain": _SHARE,
    "limit_price": ("a positive number of at most 100", lambda x: 0 < x <= 100),
    "limit_room": _SHARE,
}
_COUNTS = (
    "survey_levels",
    "max_hills",
    "max_sure_impacts",
    "max_wide_starts",
    "max_turns",
    "max_ascents",
    "max_excess_steps",
    "first_periods",
    "survey_refinement",
    "curvature_pairs",
    "max_places",
    "ensemble_balls",
    "ensemble_periods",
    "max_ensembles",
    "confirm_balls",
    "confirm_periods",
    "expected_balls",
    "max_confirmations",
)


@dataclasses.dataclass(frozen=True)
class DesignSettings:
    """What decides where ascents begin, how they climb, and which of their ends are told.

    Variables are logarithms of the tuned quantities (an inclination itself); heights are logarithms of the objective.

    Attributes:
        max_period: Forcing periods of an orbit, at most, 8, in a wide gap as many times more as balls take to cross it.
            Longer ones live in windows that few starts meet.
        max_wide_starts: A survey takes up to so many times as many starts in a gap that is wide, 8: twice as many from
            d = 1.2 on, four times from 2.4 on. More attractors coexist there, and each has fewer of the starts.
        survey_levels: Values of all tuned quantities but the first, taken together, at which a survey looks along the
            first, spread evenly over their bounds, 16. They multiply the cells of a survey. With 3, designs in
            (kappa, d) missed motions that live between them and beyond: of 12 random devices one lost a third of its P.
        max_hills: Of a kind along the first quantity's bounds, about, that are climbed, 256: the best attractor of a
            kind climbs as far as one part of so many away. With fewer, kinds that have two hills may lose one; with
            more, many climb one hill.
        max_sure_impacts: Impacts of an orbit up to which it climbs whatever it promises, 8. Orbits of more live in
            narrow windows, where no climb leads far.
        min_promise: Share of the best that an orbit of more impacts has to promise to be climbed from, and chaos to be
            looked at closer, 0.8. A smaller one spends time on what cannot win.
        min_rival: Share of the best that an orbit has to promise to be climbed from at all, where any motion may win,
            0.7. Of 200 random devices none lost more than 0.3 % of its P by that, with 0.5 an eighth more would climb.
        max_excess: Nor is one climbed there that exceeds a limit by more, as a logarithm, 0.3; nor is motion that does
            looked at closer, unless what is one step of the survey aside does not. Of 60 random devices none lost its
            best motion by these two; four fifths of the ascents are saved, and of 200 half of the closer look.
        max_excess_steps: Nor, where the first quantity alone moves the ball, by more than so many steps of the survey
            along its logarithm, 3. Further on the survey meets the same orbit within its limits. Of 60 random devices
            half of the ascents are saved; the best orbit that began beyond a limit did so by a fifth of a step.
        first_periods: Forcing periods after which a survey, where any motion may win, gives up what has not settled and
            promises no share `min_rival` of the best, or exceeds a limit by more than `max_excess`, 40. With fewer, the
            largest depths are not met, and less is given up; with more, that costs more.
        survey_refinement: Times as many cells as before about a step that is looked at closer, 8. With fewer, narrow
            windows of periodic motion in chaos are missed.
        max_turns: Turns of a search, at most, 3. Each turn after the first takes the candidates that promise more than
            the best design verified by then, where that is not what the turn before promised.
        max_ascents: Orbits that such a turn climbs from, at most, 32, the most promising ones.
        max_step: Longest step of an ascent, 0.2. Longer ones leave the branch of their orbit, and are halved until they
            do not.
        max_approach: Share of the way to a constraint that one step may go, 0.95.
        curvature_pairs: Pairs of points from which L-BFGS knows the curvature, 8.
        first_barrier: Weight of the logarithmic barrier at first, 0.03. With less, ascents run into constraints early
            and crawl along them.
        last_barrier: Weight at last, 1e-9: about how far below the maximum an end at a constraint stays.
        barrier_factor: The weight falls at least by this factor, 0.1.
        barrier_power: And to this power, 1.5, as the path is smoother near its end. With 2, steps overshoot more.
        same_optimum: Two optima nearer than this are one, 1e-4. Much less, and ends of one hill count as several.
        active_margin: A constraint is told as active whose margin's logarithm is below, 1e-6.
        min_chaos: Share of the best orbit that aperiodic motion has to promise to be climbed, 0.9. From one step of a
            survey to the next it changes by some 5 %.
        max_places: Places of a device at which the averages of aperiodic motion are climbed, 4.
        places_apart: They are so many radii of the first ensemble apart, 2.
        limit_price: A place beyond a limit is worth less by this power of what it exceeds the limit by, 2.5. An energy
            grows about so with the depth.
        ensemble_balls: Balls of an ensemble about a place, 64. Noise falls with their square root.
        ensemble_periods: Forcing periods that each is flown, 400, of which the first quarter is left out. With fewer,
            the largest depths are not met.
        ensemble_radius: How far the first balls are spread about a place, 0.02; a step leads as far.
        last_radius: How far the last ones are, 0.002. A wider one averages over more than the design.
        max_ensembles: Ensembles about a place, at most, 10.
        min_gain: A place has arrived where a step promises less, as a logarithm, or less than the noise, 2e-4.
        confirm_balls: Balls of the long flight at the end, 64.
        confirm_periods: Forcing periods that each of them is flown, 5,000. Together they meet what happens once in
            320,000.
        expected_balls: Balls of an ensemble for the objective "expected", which starts and tolerances scatter, 1024;
            four times as many are flown at the end, for `ensemble_periods`.
        limit_room: How far below a limit the fitted extremes are kept, as a logarithm, 2e-4.
        max_confirmations: Long flights about one place, at most, 6.

    Raises:
        ValueError: A value that cannot be.
    """

    max_period: int = 8
    max_wide_starts: int = 8
    survey_levels: int = 16
    max_hills: int = 256
    max_sure_impacts: int = 8
    min_promise: float = 0.8
    min_rival: float = 0.7
    max_excess: float = 0.3
    max_excess_steps: int = 3
    first_periods: int = 40
    survey_refinement: int = 8
    max_turns: int = 3
    max_ascents: int = 32
    max_step: float = 0.2
    max_approach: float = 0.95
    curvature_pairs: int = 8
    first_barrier: float = 0.03
    last_barrier: float = 1e-9
    barrier_factor: float = 0.1
    barrier_power: float = 1.5
    same_optimum: float = 1e-4
    active_margin: float = 1e-6
    min_chaos: float = 0.9
    max_places: int = 4
    places_apart: float = 2.0
    limit_price: float = 2.5
    ensemble_balls: int = 64
    ensemble_periods: int = 400
    ensemble_radius: float = 0.02
    last_radius: float = 0.002
    max_ensembles: int = 10
    min_gain: float = 2e-4
    confirm_balls: int = 64
    confirm_periods: int = 5000
    expected_balls: int = 1024
    limit_room: float = 2e-4
    max_confirmations: int = 6

    def __post_init__(self) -> None:
        self._set("max_period", checks.whole("max_period", self.max_period, 1, _MOST_PERIOD))
        for name, (must, holds) in _NUMBERS.items():
            self._set(name, checks.real(name, getattr(self, name), must, holds))
        for name in _COUNTS:
            self._set(name, checks.whole(name, getattr(self, name), 1, _MOST_COUNT))

    def _set(self, name: str, value: Any) -> None:
        """Put the plain value in place of the one given, as a frozen record lets only itself do."""
        object.__setattr__(self, name, value)


DEFAULT = DesignSettings()


def check_settings(settings: DesignSettings) -> DesignSettings:
    """Return the settings, if they are some; a record of them holds only what can be."""
    return checks.instance("settings", settings, DesignSettings, "vijax.DesignSettings(...)")
