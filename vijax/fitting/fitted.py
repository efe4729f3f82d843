"""What a fit returns: a device, how well it is known, and whether its impacts are as the model says."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from vijax.fitting.unknowns import unit_of
from vijax.model.device import Harvester
from vijax.runtime import checks


@dataclass(frozen=True)
class ConstancyTest:
    """Whether restitution is the same at all speeds: the slope of r over the impact speed that fits best.

    Attributes:
        slope: [1/(m/s)]; NaN where all impacts are as fast as each other.
        stderr: Its standard error; infinite there.
    """

    slope: float
    stderr: float

    @property
    def p_value(self) -> float:
        """Compute how often chance alone makes such a slope or a steeper one; below 0.01, r is hardly constant."""
        return math.erfc(abs(self.slope) / self.stderr / math.sqrt(2)) if math.isfinite(self.stderr) else math.nan


@dataclass(frozen=True)
class Misfit:
    """How well a device explains its impacts.

    Attributes:
        chi2: Sum of the squares of residuals, in stated errors.
        freedom: How many equations there are beyond the unknowns: what `chi2` should be.
    """

    chi2: float
    freedom: int

    @property
    def size(self) -> float:
        """Compute by what factor residuals are larger than the stated errors; NaN where nothing is beyond unknowns."""
        return math.sqrt(self.chi2 / self.freedom) if self.freedom > 0 else math.nan

    @property
    def p_value(self) -> float:
        """Compute how often errors as stated make such a misfit or a larger one, if the model is right."""
        from scipy.special import gammaincc  # here, as importing vijax must not load it

        return float(gammaincc(self.freedom / 2, self.chi2 / 2)) if self.freedom > 0 else math.nan


@dataclass(frozen=True)
class Fit:
    """A device as its impacts tell it.

    Attributes:
        device: With the fitted values.
        values: Of every unknown, in SI units.
        stderr: Their standard errors, which include the distances to `alternatives`; infinite where the data do not
            tell the value.
        correlation: Of their errors [unknown, unknown]; NaN where they are infinite.
        untold: Combinations that the data do not tell, the names of each: of these only what is held can be told.
        alternatives: Other values of all unknowns that fit as well.
        misfit: How much larger residuals are than the stated errors; where that is not by chance, `stderr` is as many
            times as large as the stated errors make it.
        constancy: Whether restitution hangs on speed.
        residuals: Measured less adjusted times, in standard errors; NaN for false impacts [impact].
        speeds: Impact speeds [m/s]; NaN for false impacts [impact].
        astray: Impacts that were left out: they are false, or the bench missed one before or after them, or the contact
            was too long for the time of the next impact to depend on them [impact].
        false: Impacts that are not impacts of the ball: the motions before and after agree without them alone [impact].
        decisive: Impacts without one of which the error of a value more than doubles. If such an impact is false, no
            other impact contradicts the values; `stderr` is therefore the error without them [impact].
        converged: Whether a device was found that explains at least two thirds of the impacts, to five times the stated
            errors, with at most 12 faults of the bench, or a tenth of the impacts if that is more.
    """

    device: Harvester
    values: dict[str, float]
    stderr: dict[str, float]
    correlation: np.ndarray
    untold: tuple[tuple[str, ...], ...]
    alternatives: tuple[dict[str, float], ...]
    misfit: Misfit
    constancy: ConstancyTest
    residuals: np.ndarray
    speeds: np.ndarray
    astray: np.ndarray
    false: np.ndarray
    decisive: np.ndarray
    converged: bool

    def report(self) -> dict[str, Any]:
        """Make nested dicts and lists of all numbers, as `vijax fit` writes them."""
        test = self.constancy
        own = {name: getattr(self, name) for name in ("values", "stderr", "correlation", "untold", "alternatives")}
        misfit = self.misfit
        own["misfit"] = {name: getattr(misfit, name) for name in ("size", "chi2", "freedom", "p_value")}
        own["converged"] = self.converged
        own["units"] = {name: unit_of(name) for name in self.values}
        own["constancy"] = {"slope": test.slope, "stderr": test.stderr, "p_value": test.p_value}
        return own | {name: getattr(self, name) for name in ("residuals", "speeds", "astray", "false", "decisive")}

    def __str__(self) -> str:
        """Say what was found, a line each."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        if not self.converged:
            yield "no device was found that explains these impacts; values are those where the search stopped"
        for name, value in self.values.items():
            error, unit = self.stderr[name], unit_of(name)
            told = f"+- {error:.2g}" if math.isfinite(error) else "is not told by the data"
            yield f"{name} = {value:.6g} {told} {unit}".rstrip()
        for names in self.untold:
            yield (
                f"{checks.joined(names)} cannot be told apart" if len(names) > 1 else f"{names[0]} cannot be told"
            ) + " from these data"
        for other in self.alternatives:
            yield "as good: " + ", ".join(f"{name} = {value:.6g}" for name, value in other.items())
        misfit = self.misfit
        yield f"misfit: {misfit.size:.3g} of the stated errors ({misfit.freedom} degrees, p = {misfit.p_value:.2g})"
        yield f"impacts left out: {int(self.astray.sum())} of {self.astray.size}" + _listed("; false", self.false)
        if self.decisive.any():
            yield "values rest on single impacts, and errors are those without them" + _listed("", self.decisive)
        yield self._on_restitution()

    def _on_restitution(self) -> str:
        test = self.constancy
        if not math.isfinite(test.stderr):
            return "whether restitution hangs on speed is not told: all impacts are as fast as each other"
        told = "hangs on speed" if test.p_value < 0.01 else "constant as far as is told"
        return f"restitution: {told}, dr/dv = {test.slope:.2g} +- {test.stderr:.2g} per m/s (p = {test.p_value:.2g})"


def _listed(text: str, impacts: np.ndarray) -> str:
    """List impacts after a text, or nothing if there are none."""
    return f"{text}: {', '.join(map(str, np.flatnonzero(impacts)))}" if impacts.any() else ""
