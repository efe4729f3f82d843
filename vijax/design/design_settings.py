"""Settings of `optimise`, with the effect of each setting on results and cost."""

import dataclasses
from collections.abc import Callable
from typing import Any

from vijax.runtime import validation

_LARGEST_COUNT = 10**6  # a larger count is taken for a typing error
_LONGEST_PERIOD = 1000  # longest orbit that may be requested [forcing periods]

Rule = tuple[str, Callable[[float], bool]]
# A rule is a pair: the requirement as text for the error message, and the test of a value.
_SHARE: Rule = ("a number between 0 and 1", lambda x: 0 < x < 1)
_NUMBERS: dict[str, Rule] = {
    "min_score_share": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "min_competitive_share": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "max_violation": ("a positive number of at most 100", lambda x: 0 < x <= 100),
    "max_step": ("a positive number of at most 10", lambda x: 0 < x <= 10),
    "max_approach": _SHARE,
    "first_barrier": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "last_barrier": ("a positive number of at most 1e-6", lambda x: 0 < x <= 1e-6),
    "barrier_factor": _SHARE,
    "barrier_power": ("a number from 1 to 2", lambda x: 1 <= x <= 2),
    "same_optimum": _SHARE,
    "active_margin": _SHARE,
    "min_aperiodic_share": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "place_spacing": ("a positive number of at most 1000", lambda x: 0 < x <= 1000),
    "ensemble_radius": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "last_radius": ("a positive number of at most 1", lambda x: 0 < x <= 1),
    "min_gain": _SHARE,
    "violation_exponent": ("a positive number of at most 100", lambda x: 0 < x <= 100),
    "limit_reserve": _SHARE,
}
# Settings that are positive integers.
_COUNTS = (
    "survey_levels",
    "max_local_maxima",
    "max_unconditional_impacts",
    "max_wide_start_factor",
    "max_rounds",
    "max_ascents",
    "max_violation_steps",
    "first_periods",
    "survey_refinement",
    "curvature_pairs",
    "max_places",
    "ensemble_samples",
    "ensemble_periods",
    "max_ensembles",
    "confirm_samples",
    "confirm_periods",
    "expected_samples",
    "max_confirmations",
)


@dataclasses.dataclass(frozen=True)
class DesignSettings:
    """Settings that specify where ascents begin, how they climb, and which of their ends are reported.

    The number that ends the first statement of an entry is the default. Variables are logarithms of the tuned
    quantities, except inclinations, which are variables themselves; values are logarithms of the objective. "The first
    quantity" is the first tuned quantity that affects the motion; a survey varies it in steps.

    Attributes:
        max_period: Longest orbit that a survey detects, in forcing periods, 8. In a wide gap it grows by the same
            factor as the time for crossing the gap. Longer orbits exist only in narrow windows that few starts reach.
        max_wide_start_factor: Largest factor on the number of starts of a survey in a wide gap, 8. The factor is 2 from
            d = 1.2 on and 4 from 2.4 on. More attractors coexist in wide gaps, and each one attracts fewer of the
            starts.
        survey_levels: Number of combinations of the tuned quantities other than the first, spread evenly over their
            bounds, 16. At each combination a survey varies the first quantity, so the number of cells is proportional
            to this setting. With 3 combinations, designs in (kappa, d) missed motions: of 12 random devices one lost a
            third of its P.
        max_local_maxima: Approximate number of local maxima along the first quantity that are climbed for each kind of
            orbit, 256. A kind is determined by period and numbers of impacts. An attractor is climbed if no attractor
            of its kind with a higher score lies within 1/256 of the width of the bounds. A smaller setting may miss one
            of two maxima of a kind; with a larger one many ascents end at one maximum.
        max_unconditional_impacts: Largest number of impacts of an orbit that is climbed even if it does not reach
            `min_score_share`, 8. Orbits with more impacts exist only in narrow windows, where ascents are short.
        min_score_share: Share of the best surveyed objective that an orbit with more than `max_unconditional_impacts`
            must reach in the survey to be climbed, and that aperiodic motion must reach for the survey to be refined
            near it, 0.8. A smaller share spends time on candidates that cannot become the best design.
        min_competitive_share: With motion="any", share of the best surveyed objective that any orbit must reach in the
            survey to be climbed, 0.7. Of 200 random devices none lost more than 0.3 % of its P by this rule; with 0.5
            an eighth more orbits would be climbed.
        max_violation: With motion="any", largest violation of a limit by an orbit that is climbed, as ln(value /
            limit), 0.3. The survey is not refined near aperiodic motion with a larger violation, unless motion at a
            neighbouring step has a smaller one. Of 60 random devices none lost its best motion by these two rules. They
            save four fifths of the ascents and, over 200 devices, half of the refinement.
        max_violation_steps: If the first quantity is the only tuned quantity that affects the motion, the largest
            violation is also limited to this number of steps of the survey in the logarithm of the quantity, 3. With a
            larger violation, the survey finds the same orbit within the limits at another step. Over 60 random devices
            this saves half of the ascents; the best orbits that started beyond a limit had violations of at most a
            fifth of a step.
        first_periods: With motion="any", forcing periods of the first stage of a survey, 40. Cells that are undecided
            after it are not continued if they do not reach the share `min_competitive_share` of the best objective, or
            if they exceed a limit by more than `max_violation`. In a shorter stage the largest depths are not reached,
            so fewer cells end; a longer stage costs more.
        survey_refinement: Factor on the number of cells at a step of the survey where it is refined, 8. A smaller
            factor misses narrow windows of periodic motion in chaos.
        max_rounds: Largest number of rounds of a search, 3. A device has another round if its verified objective is
            below its predicted one. The round climbs the remaining candidates with the highest predicted objectives.
        max_ascents: Largest number of orbits of a device in each round after the first, 32. The orbits with the highest
            predicted objective are climbed.
        max_step: Largest change of a variable in one step of an ascent, 0.2. Longer steps leave the branch of the orbit
            and must be halved.
        max_approach: Largest share of the way to a constraint that one step may take, 0.95.
        curvature_pairs: Pairs of points in the curvature estimate of L-BFGS, 8.
        first_barrier: First weight of the logarithmic barrier, 0.03. With a smaller weight, ascents reach constraints
            early and proceed slowly along them.
        last_barrier: Last weight of the barrier, 1e-9. An ascent that ends at a constraint ends below the maximum by
            about this value.
        barrier_factor: Largest ratio of a barrier weight to the previous one, 0.1.
        barrier_power: The next barrier weight is at most the current weight to this power, 1.5, because the maximum
            moves smoothly with the weight when the weight is small. With 2, more steps overshoot.
        same_optimum: Distance below which two optima count as one, 1e-4. With a much smaller distance, ends at one
            maximum count as several optima.
        active_margin: Margin below which a constraint is reported as active, as a logarithm, 1e-6.
        min_aperiodic_share: Share of the best orbit's objective that aperiodic motion must reach in the survey to be
            climbed, 0.9. The objective of aperiodic motion varies by about 5 % from one step of a survey to the next.
        max_places: Largest number of places of a device where averages of aperiodic motion are climbed in one round, 4.
            A place is a combination of values of the tuned quantities.
        place_spacing: Smallest distance between two such places, in units of `ensemble_radius`, 2.
        violation_exponent: Exponent of the penalty on a place that violates a limit, 2.5: value * (limit /
            extreme)**2.5. An energy grows about as this power of the depth.
        ensemble_samples: Number of samples of an ensemble about a place, 64. The noise is proportional to
            1/sqrt(number).
        ensemble_periods: Forcing periods of each sample, 400; the first quarter is left out of the averages. In a
            shorter simulation the largest depths are not reached.
        ensemble_radius: Largest offset of the samples of the first ensemble from a place, and largest step from it,
            0.02.
        last_radius: Largest offset of the samples of the last ensemble, 0.002. With a larger one the averages describe
            more than the design.
        max_ensembles: Largest number of ensembles about a place, 10.
        min_gain: Gain of a step, as a logarithm, below which a place has converged, 2e-4. A place has also converged if
            the gain is below the noise.
        confirm_samples: Number of samples of the long simulation that confirms a design, 64.
        confirm_periods: Forcing periods of each sample of the long simulation, 5,000. All samples together show events
            that occur once in 320,000 periods.
        expected_samples: Number of samples of an ensemble for the objective "expected", with starts anywhere in the gap
            and random tolerances, 1024. The confirming simulation has four times as many, each over `ensemble_periods`.
        limit_reserve: Margin to each limit that a design keeps on the fitted surface, as a logarithm, 2e-4.
        max_confirmations: Largest number of long simulations about one place, 6.

    Raises:
        ValueError: A value is out of its range.
    """

    # Surveys, and the selection of orbits from them.
    max_period: int = 8
    max_wide_start_factor: int = 8
    survey_levels: int = 16
    max_local_maxima: int = 256
    max_unconditional_impacts: int = 8
    min_score_share: float = 0.8
    min_competitive_share: float = 0.7
    max_violation: float = 0.3
    max_violation_steps: int = 3
    first_periods: int = 40
    survey_refinement: int = 8
    # Rounds of a search.
    max_rounds: int = 3
    max_ascents: int = 32
    # Ascents: steps, curvature and the weights of the barrier.
    max_step: float = 0.2
    max_approach: float = 0.95
    curvature_pairs: int = 8
    first_barrier: float = 0.03
    last_barrier: float = 1e-9
    barrier_factor: float = 0.1
    barrier_power: float = 1.5
    # Comparison and report of optima.
    same_optimum: float = 1e-4
    active_margin: float = 1e-6
    # Aperiodic motion: places, ensembles and their confirmation.
    min_aperiodic_share: float = 0.9
    max_places: int = 4
    place_spacing: float = 2.0
    violation_exponent: float = 2.5
    ensemble_samples: int = 64
    ensemble_periods: int = 400
    ensemble_radius: float = 0.02
    last_radius: float = 0.002
    max_ensembles: int = 10
    min_gain: float = 2e-4
    confirm_samples: int = 64
    confirm_periods: int = 5000
    expected_samples: int = 1024
    limit_reserve: float = 2e-4
    max_confirmations: int = 6

    def __post_init__(self) -> None:
        self._set("max_period", validation.validate_integer("max_period", self.max_period, 1, _LONGEST_PERIOD))
        for name, (must, holds) in _NUMBERS.items():
            self._set(name, validation.validate_real(name, getattr(self, name), must, holds))
        for name in _COUNTS:
            self._set(name, validation.validate_integer(name, getattr(self, name), 1, _LARGEST_COUNT))

    def _set(self, name: str, value: Any) -> None:
        """Replace a field by its validated value, with `object.__setattr__` because the dataclass is frozen."""
        object.__setattr__(self, name, value)


DEFAULT = DesignSettings()


def validate_settings(settings: DesignSettings) -> DesignSettings:
    """Return the settings, or raise an error if they are not a `DesignSettings`.

    The values need no test, because `DesignSettings` validates them when it is created.
    """
    return validation.validate_instance("settings", settings, DesignSettings, "vijax.DesignSettings(...)")
