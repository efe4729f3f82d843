"""Harvest of a cell averaged over many starts, and the attractors that these starts reach.

The starts are simulated one after another and accumulated as they complete, so that a map over many starts needs only
the memory of a map with one start. The mean and the variance of P are accumulated by Welford's method. Starts are
matched to attractors by the invariants of `attractor_invariants`.
"""

from collections.abc import Mapping

import numpy as np

from vijax.maps.attractor_invariants import (
    DISCRETE,
    INVARIANT_TOLERANCE,
    INVARIANTS,
    continuous_invariants,
    discrete_invariants,
)
from vijax.model.label import FAILED

# Invariants that have another name in a `Summary`: speeds are dimensionless there.
_SUMMARY_NAMES = {"max_impact_speed": "fastest"}
SUMMARY_FIELDS = frozenset(
    {"P", "deepest", "energy_ratio", *DISCRETE, *(_SUMMARY_NAMES.get(name, name) for name in INVARIANTS)}
)
"""Fields of the `Summary` of every start."""

_DEEPEST = "deepest", "deepest_left", "deepest_right"


class _Attractor:
    """The k-th attractor of every cell: number of starts that end on it, its invariants, and the starts' mean power.

    The invariants are the numbers that identify an attractor, such as its period. The number k is the position in the
    list of attractors of `StartStatistics`; in every cell, attractors are listed in the order of detection.
    """

    def __init__(self, cells: int, variants: int):
        self.count = np.zeros(cells, np.int64)
        self.key = np.zeros(cells, np.int64)
        self.invariants = np.zeros((len(INVARIANTS), cells))
        self.period = np.zeros(cells, np.int64)
        self.status = np.zeros(cells, np.int32)
        self.power = np.zeros((cells, variants))

    def matches(self, key: np.ndarray, invariants: np.ndarray) -> np.ndarray:
        """Return a mask of the cells where a start with these invariants ended on this attractor."""
        return (
            (self.count > 0)
            & (self.key == key)
            & (np.abs(self.invariants - invariants) <= INVARIANT_TOLERANCE).all(axis=0)
        )

    def set_invariants(
        self, where: np.ndarray, key: np.ndarray, invariants: np.ndarray, period: np.ndarray, status: np.ndarray
    ) -> None:
        """Set the invariants from the values of one start, in the cells `where`."""
        self.key[where], self.period[where], self.status[where] = key[where], period[where], status[where]
        self.invariants[:, where] = invariants[:, where]

    def count_start(self, where: np.ndarray, power: np.ndarray) -> None:
        """Count a start, and add its power to the mean, in the cells `where`."""
        self.count[where] += 1
        # Running mean: m += (x - m)/n needs no sum that could lose digits.
        self.power[where] += (power[where] - self.power[where]) / self.count[where, None]


class StartStatistics:
    """Statistics over the starts of some cells, accumulated one start after another.

    Args:
        level: Mask of the symmetric cells [cell], where mirror images harvest alike and count as one attractor.
    """

    def __init__(self, level: np.ndarray):
        self._level = level
        self._number = 0
        self._attractors: list[_Attractor] = []

    def add(self, fields: Mapping[str, np.ndarray]) -> None:
        """Add the results of one more start in every cell.

        Args:
            fields: The results by the names in `SUMMARY_FIELDS`, each [cell] or [cell, variant]; the variants of a cell
                have the same motion but harvest different energies.
        """
        power = fields["P"]
        if not self._number:
            self._mean, self._square = np.zeros_like(power), np.zeros_like(power)
            # Penetrations per wall are present only if each wall has its own penetration limit.
            self._deepest = {name: np.zeros_like(fields[name]) for name in _DEEPEST if name in fields}
            self._ratio = np.zeros_like(fields["energy_ratio"])
        self._number += 1
        # Welford's method, so that the variance is exactly 0 where all starts harvest alike. The difference of two
        # large sums would leave a rounding error there.
        deviation = power - self._mean
        self._mean += deviation / self._number
        self._square += deviation * (power - self._mean)
        for name, depth in self._deepest.items():
            self._deepest[name] = np.maximum(depth, fields[name])
        self._ratio = np.maximum(self._ratio, fields["energy_ratio"])
        self._match(fields)

    def _match(self, fields: Mapping[str, np.ndarray]) -> None:
        """Count the start at its attractor, in every cell."""
        named = {name: fields[_SUMMARY_NAMES.get(name, name)] for name in (*DISCRETE, *INVARIANTS)}
        key, period = discrete_invariants(named, self._level)
        invariants = np.stack(continuous_invariants(named, period, self._level))
        unmatched = np.ones(key.shape, bool)
        # A start matches at most one attractor of its cell, so `unmatched` only shrinks.
        for attractor in self._attractors:
            matched = unmatched & attractor.matches(key, invariants)
            attractor.count_start(matched, fields["P"])
            unmatched &= ~matched
        # The unmatched starts ended on an attractor that is new to their cell. They take the first unused entry of the
        # cell; the spare entry `blank` is appended only if a cell needs it.
        blank = _Attractor(*fields["P"].shape)
        for attractor in (*self._attractors, blank):
            matched = unmatched & (attractor.count == 0)
            attractor.set_invariants(matched, key, invariants, period, fields["status"])
            attractor.count_start(matched, fields["P"])
            unmatched &= ~matched
        if blank.count.any():
            self._attractors.append(blank)

    def fields(self) -> dict[str, np.ndarray]:
        """Return the fields for `outputs.MULTI_START_OUTPUTS`, each [cell] or [cell, variant]."""
        number, attractors = self._number, self._attractors
        count, period, status = (
            np.stack([getattr(attractor, name) for attractor in attractors]) for name in ("count", "period", "status")
        )
        # NaN in cells with fewer attractors than the longest list, so that fmin and fmax skip them.
        power = np.stack([np.where(attractor.count[:, None] > 0, attractor.power, np.nan) for attractor in attractors])
        best = np.where(np.isnan(power), -np.inf, power).argmax(axis=0)
        # best is [cell, variant]: the energy, and so the best attractor, may depend on the variant.
        cell = np.arange(len(best))
        best_share = count[best, cell[:, None]] / number
        failed = np.isin(status, FAILED) & (count > 0)
        # If any start failed the cell has failed; otherwise it has the status of the attractor with most starts.
        dominant = np.where(failed.any(axis=0), failed.argmax(axis=0), count.argmax(axis=0))
        return {
            "P": self._mean,
            "P_stderr": np.sqrt(self._square / max(number * (number - 1), 1)),
            "P_least": np.fmin.reduce(power),
            "P_greatest": np.fmax.reduce(power),
            "best_share": best_share,
            "best_share_stderr": np.sqrt(best_share * (1 - best_share) / number),
            # A period of -1 is undecided, -2 failed: neither counts as an attractor.
            "attractors": ((period >= 0) & (count > 0)).sum(axis=0).astype(np.int32),
            "undecided": np.where(period < 0, count, 0).sum(axis=0) / number,
            **self._deepest,
            "energy_ratio": self._ratio,
            "status": status[dominant, cell],
        }
