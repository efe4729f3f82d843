"""The result of a fit: a device, its errors, and tests of the model."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from vijax.fitting.unknowns import unit_of
from vijax.model.device import Harvester
from vijax.runtime import validation


@dataclass(frozen=True)
class ConstancyTest:
    """Test for equal restitution at all speeds: the best-fitting slope of r over the impact speed.

    Attributes:
        slope: Change of r per impact speed [1/(m/s)]; NaN if all impacts have the same speed.
        stderr: Standard error of the slope; infinite if all impacts have the same speed.
    """

    slope: float
    stderr: float

    @property
    def p_value(self) -> float:
        """Return the probability of such a slope or a steeper one by chance; below 0.01, r is hardly constant."""
        return math.erfc(abs(self.slope) / self.stderr / math.sqrt(2)) if math.isfinite(self.stderr) else math.nan


@dataclass(frozen=True)
class Misfit:
    """Agreement of a device with its impacts.

    Attributes:
        chi2: Sum of the squares of residuals, in stated errors.
        degrees_of_freedom: Number of equations minus number of unknowns: the expected value of `chi2`.
    """

    chi2: float
    degrees_of_freedom: int

    @property
    def size(self) -> float:
        """Return the root mean square of residuals over stated errors; NaN without degrees of freedom."""
        return math.sqrt(self.chi2 / self.degrees_of_freedom) if self.degrees_of_freedom > 0 else math.nan

    @property
    def p_value(self) -> float:
        """Return the probability of such a misfit or a larger one with errors as stated, if the model is right."""
        from scipy.special import gammaincc  # imported here, because `import vijax` must not load SciPy

        return float(gammaincc(self.degrees_of_freedom / 2, self.chi2 / 2)) if self.degrees_of_freedom > 0 else math.nan


@dataclass(frozen=True)
class Fit:
    """A device fitted to its impacts.

    Attributes:
        device: The device with the fitted values.
        values: Value of every unknown, in SI units.
        stderr: Standard errors of the values, which include the distances to `alternatives`; infinite where the data do
            not determine the value.
        correlation: Correlation of the errors of two values [unknown, unknown]; NaN where a standard error is infinite.
        undetermined: Combinations of unknowns that the data do not determine, each as a tuple of names. The unknowns of
            a combination can be determined only if some of them are fixed.
        alternatives: Other values of all unknowns that fit equally well.
        misfit: Ratio of residuals to the stated errors; if its p value is below 0.001, `stderr` is scaled by it.
        constancy: Test of a dependence of restitution on speed.
        residuals: Measured minus adjusted times, in standard errors; NaN for false impacts [impact].
        speeds: Impact speeds [m/s]; NaN for false impacts [impact].
        excluded: Impacts that the fit does not use: they are false, the bench missed an impact before or after them, or
            the contact was too long for the time of the next impact to depend on them [impact].
        false: Detections that are not impacts of the ball: the motions before and after them agree only without them
            [impact].
        decisive: Impacts with a large effect on a value: the standard error of the value more than doubles if such an
            impact is left out. If a decisive impact is false, no other impact contradicts the values; `stderr` is
            therefore computed without all decisive impacts [impact].
        converged: Whether a device was found that explains at least two thirds of the impacts, to five times the stated
            errors, with at most 12 faults of the bench, or a tenth of the impacts if that is more.
    """

    device: Harvester
    values: dict[str, float]
    stderr: dict[str, float]
    correlation: np.ndarray
    undetermined: tuple[tuple[str, ...], ...]
    alternatives: tuple[dict[str, float], ...]
    misfit: Misfit
    constancy: ConstancyTest
    residuals: np.ndarray
    speeds: np.ndarray
    excluded: np.ndarray
    false: np.ndarray
    decisive: np.ndarray
    converged: bool

    def report(self) -> dict[str, Any]:
        """Return nested dicts and lists of all numbers, as `vijax fit` writes them."""
        constancy = self.constancy
        fields = {
            name: getattr(self, name) for name in ("values", "stderr", "correlation", "undetermined", "alternatives")
        }
        misfit = self.misfit
        fields["misfit"] = {name: getattr(misfit, name) for name in ("size", "chi2", "degrees_of_freedom", "p_value")}
        fields["converged"] = self.converged
        fields["units"] = {name: unit_of(name) for name in self.values}
        fields["constancy"] = {"slope": constancy.slope, "stderr": constancy.stderr, "p_value": constancy.p_value}
        return fields | {name: getattr(self, name) for name in ("residuals", "speeds", "excluded", "false", "decisive")}

    def __str__(self) -> str:
        """Describe the result, one item per line."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        if not self.converged:
            yield "no device was found that explains these impacts; values are those where the search stopped"
        for name, value in self.values.items():
            error, unit = self.stderr[name], unit_of(name)
            error_text = f"+- {error:.2g}" if math.isfinite(error) else "is not determined by the data"
            yield f"{name} = {value:.6g} {error_text} {unit}".rstrip()
        for names in self.undetermined:
            yield (
                f"{validation.join_names(names)} cannot be determined separately"
                if len(names) > 1
                else f"{names[0]} cannot be determined"
            ) + " from these data"
        for other in self.alternatives:
            yield "as good: " + ", ".join(f"{name} = {value:.6g}" for name, value in other.items())
        misfit = self.misfit
        yield (
            f"misfit: {misfit.size:.3g} of the stated errors "
            f"({misfit.degrees_of_freedom} degrees, p = {misfit.p_value:.2g})"
        )
        yield f"impacts left out: {int(self.excluded.sum())} of {self.excluded.size}" + _listed("; false", self.false)
        if self.decisive.any():
            yield "values depend on single impacts; errors are computed without them" + _listed("", self.decisive)
        yield self._on_restitution()

    def _on_restitution(self) -> str:
        test = self.constancy
        if not math.isfinite(test.stderr):
            return "the dependence of restitution on speed is not determined: all impacts have the same speed"
        conclusion = "depends on speed" if test.p_value < 0.01 else "constant within its error"
        return (
            f"restitution: {conclusion}, dr/dv = {test.slope:.2g} +- {test.stderr:.2g} per m/s (p = {test.p_value:.2g})"
        )


def _listed(text: str, impacts: np.ndarray) -> str:
    """Return a text with a list of impacts, or an empty one if there are none."""
    return f"{text}: {', '.join(map(str, np.flatnonzero(impacts)))}" if impacts.any() else ""
