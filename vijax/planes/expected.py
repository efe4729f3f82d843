"""What a cell harvests whatever its start: of many starts the expected power, and the attractors that share them.

ManyStarts run one after another and are folded as they end, so that a map of them takes the memory of one start.
"""

from collections.abc import Mapping

import numpy as np

from vijax.model.label import FAILED
from vijax.planes.attractor_marks import ENDED, INVARIANTS, SAME, invariants, kinds

# Names of the marks, where a `Summary` has others: its speeds have no unit.
_FIELDS = {"max_impact_speed": "fastest"}
NEEDS = frozenset({"P", "deepest", "energy_ratio", *ENDED, *(_FIELDS.get(name, name) for name in INVARIANTS)})
"""Fields of the `Summary` of every start."""

_DEEPEST = "deepest", "deepest_left", "deepest_right"


class _Attractor:
    """An attractor of every cell: how many starts ended there, what marks it, the mean power of these starts."""

    def __init__(self, cells: int, variants: int):
        self.count = np.zeros(cells, np.int64)
        self.kind = np.zeros(cells, np.int64)
        self.marks = np.zeros((len(INVARIANTS), cells))
        self.period = np.zeros(cells, np.int64)
        self.status = np.zeros(cells, np.int32)
        self.power = np.zeros((cells, variants))

    def alike(self, kind: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """Say in which cells a start with these marks ended there."""
        return (self.count > 0) & (self.kind == kind) & (np.abs(self.marks - marks) <= SAME).all(axis=0)

    def begin(
        self, where: np.ndarray, kind: np.ndarray, marks: np.ndarray, period: np.ndarray, status: np.ndarray
    ) -> None:
        """Take over what marks a start, in some cells."""
        self.kind[where], self.period[where], self.status[where] = kind[where], period[where], status[where]
        self.marks[:, where] = marks[:, where]

    def take(self, where: np.ndarray, power: np.ndarray) -> None:
        """Count a start in some cells."""
        self.count[where] += 1
        self.power[where] += (power[where] - self.power[where]) / self.count[where, None]


class ManyStarts:
    """The starts of some cells, folded one after another.

    Args:
        level: Which cells are level: there mirror images harvest alike, and are one attractor.
    """

    def __init__(self, level: np.ndarray):
        self._level = level
        self._number = 0
        self._attractors: list[_Attractor] = []

    def add(self, found: Mapping[str, np.ndarray]) -> None:
        """Fold the fields `NEEDS` of one start of every cell in."""
        power = found["P"]
        if not self._number:
            self._mean, self._square = np.zeros_like(power), np.zeros_like(power)
            self._deepest = {name: np.zeros_like(found[name]) for name in _DEEPEST if name in found}
            self._ratio = np.zeros_like(found["energy_ratio"])
        self._number += 1
        # Welford's way: where all starts harvest alike, nothing is left of their spread.
        off = power - self._mean
        self._mean += off / self._number
        self._square += off * (power - self._mean)
        for name, depth in self._deepest.items():
            self._deepest[name] = np.maximum(depth, found[name])
        self._ratio = np.maximum(self._ratio, found["energy_ratio"])
        self._match(found)

    def _match(self, found: Mapping[str, np.ndarray]) -> None:
        """Count the start at its attractor, in every cell."""
        named = {name: found[_FIELDS.get(name, name)] for name in (*ENDED, *INVARIANTS)}
        kind, period = kinds(named, self._level)
        marks = np.stack(invariants(named, period, self._level))
        left = np.ones(kind.shape, bool)
        for one in self._attractors:
            here = left & one.alike(kind, marks)
            one.take(here, found["P"])
            left &= ~here
        # What is left ended on an attractor that is new to its cell.
        blank = _Attractor(*found["P"].shape)
        for one in (*self._attractors, blank):
            here = left & (one.count == 0)
            one.begin(here, kind, marks, period, found["status"])
            one.take(here, found["P"])
            left &= ~here
        if blank.count.any():
            self._attractors.append(blank)

    def fields(self) -> dict[str, np.ndarray]:
        """Give the fields of a map of expected power, [cell] or [cell, variant]; see `outputs.EXPECTED`."""
        number, each = self._number, self._attractors
        count, period, status = (
            np.stack([getattr(one, name) for one in each]) for name in ("count", "period", "status")
        )
        power = np.stack([np.where(one.count[:, None] > 0, one.power, np.nan) for one in each])
        best = np.where(np.isnan(power), -np.inf, power).argmax(axis=0)
        cell = np.arange(len(best))
        share = count[best, cell[:, None]] / number
        failed = np.isin(status, FAILED) & (count > 0)
        # A failure of any start is one of the cell; otherwise it ended as most of them did.
        ended = np.where(failed.any(axis=0), failed.argmax(axis=0), count.argmax(axis=0))
        return {
            "P": self._mean,
            "P_stderr": np.sqrt(self._square / max(number * (number - 1), 1)),
            "P_least": np.fmin.reduce(power),
            "P_greatest": np.fmax.reduce(power),
            "best_share": share,
            "best_share_stderr": np.sqrt(share * (1 - share) / number),
            "attractors": ((period >= 0) & (count > 0)).sum(axis=0).astype(np.int32),
            "undecided": np.where(period < 0, count, 0).sum(axis=0) / number,
            **self._deepest,
            "energy_ratio": self._ratio,
            "status": status[ended, cell],
        }
