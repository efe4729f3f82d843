"""Motions that a survey met, and what they promise: the objective, and what each lacks to the limits."""

from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.design.averages import Averages
from vijax.design.design_settings import DesignSettings
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair


class Promise(NamedTuple):
    """Of every motion the logarithm of the objective, and what is lacking to the worst constraint: 0 if nothing."""

    value: np.ndarray
    lacks: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Compute what may be left where no constraint is broken any more."""
        return self.value + self.lacks


def promise(found: Averages, device: Harvester, objective: str) -> Promise:
    """Judge motions in devices of their own: what they gave, and what they lacked."""
    with np.errstate(divide="ignore"):
        value = np.log(np.nan_to_num(found.value(objective, device)))
    return Promise(value, np.nanmin(found.margins(), axis=1, initial=0.0))


class Met(NamedTuple):
    """Motions that were met, [motion]: what each gave and promises, how it ended, in which device, where it was.

    Attributes:
        hope: What it promises of the objective that is sought.
        pair, ended: Parameters, and the `Summary`.
        z: Variables of its device.
        owner: Which of the devices given.
        level, step: Of the survey's values of the other quantities together, and of the first one.
    """

    found: Averages
    hope: Promise
    pair: ImpactPair
    ended: Any
    device: Harvester
    z: np.ndarray
    owner: np.ndarray
    level: np.ndarray
    step: np.ndarray

    def some(self, index: np.ndarray) -> "Met":
        """Pick those with the given indices."""
        return jax.tree.map(lambda x: x[index], self)


def at_places(met: Met) -> Met:
    """Return motions that each promise the mean of all of them at their values of the tuned quantities.

    The average of a single start over a short flight is a matter of chance, and the highest of many promises too much.
    """
    which, count = _places(met)
    with np.errstate(divide="ignore"):
        mean = np.log(np.bincount(which, np.exp(met.hope.value)) / count)
    least = np.full(count.size, np.inf)
    np.minimum.at(least, which, met.hope.lacks)
    return met._replace(hope=Promise(mean[which], least[which]))


def beside(some: np.ndarray, met: Met) -> np.ndarray:
    """Return which motions are at values of the tuned quantities where one of some, given by a mask, is."""
    which, count = _places(met)
    there = np.zeros(count.size, bool)
    there[which[some]] = True
    return there[which]


def _places(met: Met) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the place, device and tuned quantities, of each motion; the motions at each place."""
    _, which, count = np.unique(np.column_stack([met.owner, met.z]), axis=0, return_inverse=True, return_counts=True)
    return which.ravel(), count


def highest_promise(devices: int, *met: Met) -> np.ndarray:
    """Find what the best motion of every device promises that breaks no limit; -inf where there is none."""
    most = np.full(devices, -np.inf)
    for some in met:
        np.maximum.at(most, some.owner, np.where(some.hope.lacks < 0, -np.inf, some.hope.value))
    return most


def near_limits(met: Met, where: Met, settings: DesignSettings) -> np.ndarray:
    """Say which motions are at a step, or beside one, where one of some exceeds no limit by far."""
    good = np.flatnonzero(met.hope.lacks >= -settings.max_excess)
    shape = [1 + int(x.max(initial=0)) for x in (where.owner, where.level)]
    near = np.zeros((*shape, 3 + int(where.step.max(initial=0))), bool)
    for beside in range(3):
        near[met.owner[good], met.level[good], met.step[good] + beside] = True
    return near[where.owner, where.level, where.step + 1]
