"""Refinement: which cells of a plane are computed next, and what the others are filled with.

A plane starts coarse, on every 2^levels-th point along each axis and the last one. A block is what lies between
neighbouring points of such a lattice, its borders included. It is split, and the points of the next lattice within it
are computed, if its corners differ in their kind of motion, if it lies beside such a block, or if a cell computed in it
is not what its corners would fill there. So nothing that was computed contradicts what is filled: a border can lie
unseen only between computed cells that are alike.
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vijax.model.label import ordered
from vijax.model.records import Status

# Relative error that P may have by interpolation between computed cells. A smaller one computes more of them.
TOLERANCE = 0.01
# Standard errors of both that are forgiven besides: with fewer, noise of aperiodic cells is refined.
SURE = 3.0
# Fields of `Summary` that decide what is computed next.
NEEDS = ("P", "P_stderr", "period", "impacts_left", "impacts_right", "restitution_left", "restitution_right", "status")
# The mirror image of a field is another field, with a sign; one that is not here is the same in both.
_MIRROR = {
    "restitution_left": ("restitution_right", 1),
    "restitution_right": ("restitution_left", 1),
    "asymmetry": ("asymmetry", -1),
}
# Steps that the coarsest lattice has along an axis, at least: with fewer, nothing would tell that interpolation misses.
_FEWEST_STEPS = 4
# Cells that are filled together: few enough to stay in cache.
_AT_ONCE = 1 << 16

Cells = np.ndarray
"""Flat indices of cells."""
Found = Mapping[str, np.ndarray]
"""Fields of `Summary` over all cells, [cell] or [cell, variant]; those not computed yet hold anything."""


def most_levels(longest: int) -> int:
    """Find to how many levels an axis of so many points can be coarsened; 0 if it cannot be."""
    return max((longest - 1) // _FEWEST_STEPS, 1).bit_length() - 1


@dataclass(frozen=True)
class Mesh:
    """The nested lattices of a plane, level 0 being all of its cells, and the blocks between their points.

    An axis too short for all levels is coarsened by fewer, so that no lattice has less than four steps along it. Points
    count in the order of their values, whatever the order of the axis.

    Attributes:
        axes: Values of the axes that the motion depends on, those of one value left out.
        levels: How often the coarsest lattice is halved.
    """

    axes: tuple[np.ndarray, ...]
    levels: int

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Count the cells along each axis."""
        return tuple(axis.size for axis in self.axes)

    @cached_property
    def _values(self) -> list[np.ndarray]:
        # Most of what depends on a stiffness or a gap does so about as a power.
        return [np.log(axis) if (axis > 0).all() else axis for axis in self.axes]

    @cached_property
    def _orders(self) -> list[np.ndarray]:
        return [np.argsort(axis, kind="stable") for axis in self.axes]

    @cached_property
    def _ranks(self) -> list[np.ndarray]:
        return [np.argsort(order) for order in self._orders]

    def _shift(self, axis: int, level: int) -> int:
        """Find the step along an axis as a power of two; level `levels + 1` is coarser than what comes first."""
        coarsest = min(most_levels(self.shape[axis]), self.levels)
        return min(level, coarsest) + (level > self.levels)

    def ranks(self, axis: int, level: int) -> np.ndarray:
        """Find the ranks along an axis of the points of a lattice."""
        last = self.shape[axis] - 1
        return np.append(np.arange(0, last, 1 << self._shift(axis, level)), last)

    def ranks_of(self, cells: Cells) -> list[np.ndarray]:
        """Find the ranks of cells along each axis."""
        return [ranks[i] for ranks, i in zip(self._ranks, np.unravel_index(cells, self.shape), strict=True)]

    def lattice(self, level: int) -> Cells:
        """Find the points of a lattice, as an array over the axes."""
        points = (order[self.ranks(axis, level)] for axis, order in enumerate(self._orders))
        return np.asarray(np.ravel_multi_index(np.ix_(*points), self.shape))

    def blocks(self, axis: int, level: int, ranks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the blocks along an axis that a point belongs to: two where it is between them, else one twice."""
        shift = self._shift(axis, level)
        last = (self.shape[axis] - 2) >> shift
        return np.maximum(ranks - 1, 0) >> shift, np.minimum(ranks >> shift, last)

    def corners(self, cells: Cells, level: int) -> tuple[np.ndarray, np.ndarray, Cells]:
        """Find the corners [corner, cell] of the blocks that cells lie in, their weights there, the nearest corner.

        Weights are linear in the logarithms of an axis, or in its values unless all are positive. On a block's border
        only corners of that border have a weight; the nearest stands for the others.
        """
        ends, weights = [], []
        for axis, rank in enumerate(self.ranks_of(cells)):
            order, values = self._orders[axis], self._values[axis]
            points = order[self.ranks(axis, level)]
            _, block = self.blocks(axis, level, rank)
            low, high = points[block], points[block + 1]
            width = values[high] - values[low]
            # Where a value is given more than once a block may have no width.
            part = (values[order[rank]] - values[low]) / np.where(width > 0, width, 1.0)
            ends.append((low, high))
            weights.append((1 - part, part))
        corners = np.stack([np.ravel_multi_index(corner, self.shape) for corner in itertools.product(*ends)])
        weight = np.stack([math.prod(parts) for parts in itertools.product(*weights)])
        nearest = np.take_along_axis(corners, weight.argmax(0)[None], 0)[0]
        return np.where(weight > 0, corners, nearest), weight, nearest


def rounds(mesh: Mesh, found: Found, level_ground: np.ndarray) -> Iterator[Cells]:
    """Yield cells to compute, round by round, each once; those of a round are in `found` when the next is asked for.

    Args:
        mesh: The plane.
        found: The fields of `NEEDS`, and any others.
        level_ground: Cells where gamma is 0, so that mirror images are one kind of motion.
    """
    fronts = {level: _Front(mesh, level) for level in range(1, mesh.levels + 1)}
    fronts[mesh.levels].there[...] = True
    known = np.zeros(math.prod(mesh.shape), bool)
    new = mesh.lattice(mesh.levels).ravel()
    while new.size:
        yield new
        known[new] = True
        for level in range(1, mesh.levels + 2):
            unlike, missed = _surprises(mesh, found, level_ground, new, level)
            if level in fronts:
                fronts[level].mark(new[unlike | missed])
            # Blocks that a missed one is split into may miss too, and nothing has been computed in them yet.
            if level - 1 in fronts:
                fronts[level - 1].mark(new[missed])
        for front in fronts.values():
            front.surrounded(known)
        wanted = np.zeros(known.size, bool)
        # The finest first: children are looked at a round later, when their corners are known.
        for level, front in fronts.items():
            split = front.split(found, level_ground)
            if split.any():
                wanted[mesh.lattice(level - 1)[_closure(mesh, split, level)]] = True
                if level - 1 in fronts:
                    fronts[level - 1].there |= _children(mesh, split, level)
        new = np.flatnonzero(wanted & ~known)


class _Front:
    """The blocks of a level: those there, looked at, with corners of two kinds, contradicted within, and split."""

    def __init__(self, mesh: Mesh, level: int) -> None:
        self.mesh, self.level = mesh, level
        self.points = mesh.lattice(level)
        blocks = tuple(size - 1 for size in self.points.shape)
        self.there, self.seen, self.unlike, self.bad, self.done = (np.zeros(blocks, bool) for _ in range(5))

    def mark(self, cells: Cells) -> None:
        """Mark the blocks that these cells belong to as ones that must be split, be they there yet or not."""
        sides = [self.mesh.blocks(axis, self.level, rank) for axis, rank in enumerate(self.mesh.ranks_of(cells))]
        for block in itertools.product(*sides):
            self.bad[block] = True

    def surrounded(self, known: np.ndarray) -> None:
        """Take blocks as there whose corners are known though none was split into them: they would be filled unjudged.

        So it is with blocks at the end of an axis that are too narrow to have a point within: others asked for theirs.
        """
        size = self.there.shape
        corners = (
            tuple(slice(i, i + n) for i, n in zip(place, size, strict=True))
            for place in itertools.product((0, 1), repeat=len(size))
        )
        self.there |= np.all([known[self.points[corner]] for corner in corners], axis=0)

    def split(self, found: Found, level_ground: np.ndarray) -> np.ndarray:
        """Find the blocks to split now: those on a border and their neighbours, and those that a cell contradicts."""
        fresh = np.nonzero(self.there & ~self.seen)
        self.seen |= self.there
        corners = np.stack([self.points[place] for place in itertools.product(*((i, i + 1) for i in fresh))])
        kind = _kind(found, level_ground, corners)
        self.unlike[fresh] = (kind != kind[0]).any((0, -1))
        split = (self.bad | _with_neighbours(self.unlike)) & self.there & ~self.done
        self.done |= split
        return split


def _kind(found: Found, level_ground: np.ndarray, cells: Cells) -> np.ndarray:
    """Tell the kind of motion of cells: numbers along a last dimension, all equal where motions are alike."""
    period, left, right, status = (found[name][cells] for name in ("period", "impacts_left", "impacts_right", "status"))
    status = np.where(np.isin(status, (Status.CONVERGING, Status.FEW_IMPACTS)), Status.OK, status)
    few, many = ordered(left, right, level_ground[cells])
    return np.stack([period, few, many, status, found["P"][cells, 0] > 0], axis=-1)


def _surprises(
    mesh: Mesh, found: Found, level_ground: np.ndarray, cells: Cells, level: int
) -> tuple[np.ndarray, np.ndarray]:
    """Find cells of another kind than a corner of their block, and those of the others where P is missed."""
    corners, weights, _ = mesh.corners(cells, level)
    unlike = (_kind(found, level_ground, corners) != _kind(found, level_ground, cells)).any((0, -1))

    def told(cells: Cells) -> tuple[np.ndarray, np.ndarray]:
        power, error = found["P"][cells], found["P_stderr"][cells]
        some = np.where(power > 0, power, 1.0)
        return np.log(some), np.where(error > 0, error, 0.0) / some

    (logs, errors), (log, error) = told(corners), told(cells)
    guess, doubt = ((weights[..., None] * values).sum(0) for values in (logs, errors))
    missed = (np.abs(guess - log) > TOLERANCE + SURE * (doubt + error)).any(-1)
    return unlike, missed & ~unlike


def _with_neighbours(blocks: np.ndarray) -> np.ndarray:
    """Add to blocks those that share a face with one."""
    found = blocks.copy()
    for axis in range(blocks.ndim):
        here, grown = np.moveaxis(blocks, axis, 0), np.moveaxis(found, axis, 0)
        grown[1:] |= here[:-1]
        grown[:-1] |= here[1:]
    return found


def _closure(mesh: Mesh, blocks: np.ndarray, level: int) -> np.ndarray:
    """Find which points of the next lattice lie in these blocks or on their borders."""
    for axis in range(blocks.ndim):
        below, above = mesh.blocks(axis, level, mesh.ranks(axis, level - 1))
        blocks = blocks.take(below, axis) | blocks.take(above, axis)
    return blocks


def _children(mesh: Mesh, blocks: np.ndarray, level: int) -> np.ndarray:
    """Find which blocks of the next level lie in these."""
    for axis in range(blocks.ndim):
        _, above = mesh.blocks(axis, level, mesh.ranks(axis, level - 1)[:-1])
        blocks = blocks.take(above, axis)
    return blocks


def fill(mesh: Mesh, found: dict[str, np.ndarray], known: np.ndarray, level_ground: np.ndarray) -> None:
    """Fill the cells that are not known from the corners of the smallest block around each that was not split.

    Counts and codes are those of the corners, which agree; between mirror images, those of the nearest. All else is
    interpolated, by its logarithm where all corners are positive. No periods were run.

    Args:
        mesh: The plane.
        found: All fields, filled in place.
        known: The cells that were computed: all rounds'.
        level_ground: As in `rounds`.
    """
    missing = np.flatnonzero(~known)
    for rest in np.array_split(missing, math.ceil(missing.size / _AT_ONCE) or 1):
        for level in range(1, mesh.levels + 1):
            corners, weights, nearest = mesh.corners(rest, level)
            told = known[corners].all(0)
            _fill(found, level_ground, rest[told], corners[:, told], weights[:, told], nearest[told])
            rest = rest[~told]
    if "periods_run" in found:
        found["periods_run"][~known] = 0


def _fill(
    found: dict[str, np.ndarray],
    level_ground: np.ndarray,
    cells: Cells,
    corners: np.ndarray,
    weights: np.ndarray,
    nearest: Cells,
) -> None:
    # Corners may be mirror images of one another: they are turned as the nearest one is.
    turn = _turned(found, level_ground, corners) != _turned(found, level_ground, nearest)
    filled = {}
    for name, values in found.items():
        if values.dtype.kind != "f":
            filled[name] = values[nearest]
            continue
        at_corners = values[corners]
        if name in _MIRROR:
            other, sign = _MIRROR[name]
            at_corners = np.where(turn, sign * found[other][corners], at_corners)
        filled[name] = _blend(at_corners, weights)
    for name, values in filled.items():
        found[name][cells] = values


def _turned(found: Found, level_ground: np.ndarray, cells: Cells) -> np.ndarray:
    """Tell which cells hold the one of two mirror images that counts as the other one turned."""
    more_left = found["impacts_left"][cells] - found["impacts_right"][cells]
    harder_left = found["restitution_left"][cells] > found["restitution_right"][cells]
    return level_ground[cells] & ((more_left > 0) | ((more_left == 0) & harder_left))


def _blend(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Blend values [corner, cell, ...] by their weights, by logarithm where all are positive."""
    weights = weights.reshape(weights.shape + (1,) * (values.ndim - 2))
    positive = (values > 0).all(0)
    logs = np.log(np.where(positive, values, 1.0))
    return np.where(positive, np.exp((weights * logs).sum(0)), (weights * values).sum(0))
