"""Adaptive refinement of a plane: selection of the cells to compute, and interpolation of the others.

The cells of a coarse lattice are computed first: every 2^levels-th point along each axis, and the last point. A block
is the part of the plane between neighbouring points of a lattice, borders included. To split a block means to compute
the points of the next finer lattice in it. A block is split in three cases: its corners differ in their kind of motion;
it shares a face with such a block; a cell computed in it differs from the interpolation of its corners. Therefore no
computed cell contradicts the interpolation. A border between kinds of motion can stay undetected only between computed
cells of the same kind.
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vijax.model.label import order_counts
from vijax.model.records import Status

# Accepted relative error of P by interpolation between computed cells. With a smaller tolerance more cells are
# computed.
P_RTOL = 0.01
# Accepted error in addition to `P_RTOL`, in standard errors of the interpolated and of the computed P. With fewer,
# cells would be refined to resolve the statistical noise of aperiodic motions.
N_STDERR = 3.0
# Fields of `Summary` that determine the cells of the next round.
FIELDS = ("P", "P_stderr", "period", "impacts_left", "impacts_right", "restitution_left", "restitution_right", "status")
# For each field: the field of a motion that holds the value of its mirror image, and the sign. Fields that are not
# listed are equal for both.
_MIRROR = {
    "restitution_left": ("restitution_right", 1),
    "restitution_right": ("restitution_left", 1),
    "asymmetry": ("asymmetry", -1),
}
# Least number of steps of the coarsest lattice along an axis: with fewer, no computed cell could reveal a wrong
# interpolation.
_FEWEST_STEPS = 4
# Number of cells that are interpolated at once: few enough to stay in cache.
_CELLS_PER_INTERPOLATION = 1 << 16

Cells = np.ndarray
"""Flat indices of cells."""
CellFields = Mapping[str, np.ndarray]
"""Fields of `Summary` over all cells, [cell] or [cell, variant]; values not computed yet are arbitrary."""


def max_levels(longest: int) -> int:
    """Return the greatest number of levels for an axis of this many points; 0 if it cannot be coarsened."""
    # The greatest n with 2^n steps of the finest lattice per coarse step, and at least `_FEWEST_STEPS` coarse steps.
    return max((longest - 1) // _FEWEST_STEPS, 1).bit_length() - 1


@dataclass(frozen=True)
class Mesh:
    """The nested lattices of a plane, level 0 with all of its cells, and the blocks between their points.

    An axis too short for all levels is coarsened by fewer levels, so that every lattice has at least four steps along
    it. Points are ranked by their values, whatever the order of the axis.

    Attributes:
        axes: Values of the axes that the motion depends on, without axes of a single value.
        levels: Number of times that the step of the coarsest lattice is halved to reach every cell.
    """

    axes: tuple[np.ndarray, ...]
    levels: int

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Number of cells along each axis."""
        return tuple(axis.size for axis in self.axes)

    @cached_property
    def _values(self) -> list[np.ndarray]:
        # Logarithms, because quantities depend on a stiffness or a gap approximately as a power law.
        return [np.log(axis) if (axis > 0).all() else axis for axis in self.axes]

    @cached_property
    def _orders(self) -> list[np.ndarray]:
        return [np.argsort(axis, kind="stable") for axis in self.axes]

    @cached_property
    def _ranks(self) -> list[np.ndarray]:
        return [np.argsort(order) for order in self._orders]

    def _shift(self, axis: int, level: int) -> int:
        """Return log2 of the step along an axis at a level.

        Level `levels + 1` is one level above the coarsest lattice. Blocks of that size are used to compare the points
        of the coarsest lattice with an interpolation.
        """
        coarsest = min(max_levels(self.shape[axis]), self.levels)
        return min(level, coarsest) + (level > self.levels)

    def ranks(self, axis: int, level: int) -> np.ndarray:
        """Return the ranks along an axis of the points of a lattice."""
        last = self.shape[axis] - 1
        return np.append(np.arange(0, last, 1 << self._shift(axis, level)), last)

    def ranks_of(self, cells: Cells) -> list[np.ndarray]:
        """Return the ranks of cells along each axis."""
        return [ranks[i] for ranks, i in zip(self._ranks, np.unravel_index(cells, self.shape), strict=True)]

    def lattice(self, level: int) -> Cells:
        """Return the points of a lattice, as an array over the axes."""
        points = (order[self.ranks(axis, level)] for axis, order in enumerate(self._orders))
        return np.asarray(np.ravel_multi_index(np.ix_(*points), self.shape))

    def blocks(self, axis: int, level: int, ranks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper block along an axis that contain each rank; equal except on a border."""
        shift = self._shift(axis, level)
        # A lattice always contains the last point: the last block may be narrower than the step.
        last = (self.shape[axis] - 2) >> shift
        # A point of rank r has the steps r - 1 to r and r to r + 1 on its two sides; at an end of the axis there is
        # one.
        return np.maximum(ranks - 1, 0) >> shift, np.minimum(ranks >> shift, last)

    def corners(self, cells: Cells, level: int) -> tuple[np.ndarray, np.ndarray, Cells]:
        """Return the corners [corner, cell] of the blocks around cells, their weights, and the nearest corner.

        Weights are linear in the logarithm of an axis, or in its value unless all values are positive. For a cell on
        the border of its block, only the corners on that border have a positive weight; in place of the other corners
        the nearest corner is returned.
        """
        ends, weights = [], []
        for axis, rank in enumerate(self.ranks_of(cells)):
            order, values = self._orders[axis], self._values[axis]
            points = order[self.ranks(axis, level)]
            # On a border the upper block is chosen; its corners off the border get the weight 0.
            _, block = self.blocks(axis, level, rank)
            low, high = points[block], points[block + 1]
            width = values[high] - values[low]
            # A block has no width where an axis repeats a value.
            part = (values[order[rank]] - values[low]) / np.where(width > 0, width, 1.0)
            ends.append((low, high))
            weights.append((1 - part, part))
        corners = np.stack([np.ravel_multi_index(corner, self.shape) for corner in itertools.product(*ends)])
        # Multilinear interpolation: the weight of a corner is the product over the axes.
        weight = np.stack([math.prod(parts) for parts in itertools.product(*weights)])
        nearest = np.take_along_axis(corners, weight.argmax(0)[None], 0)[0]
        return np.where(weight > 0, corners, nearest), weight, nearest


def cells_by_round(mesh: Mesh, fields: CellFields, level_ground: np.ndarray) -> Iterator[Cells]:
    """Yield cells to compute, round by round, each cell once.

    The caller stores the fields of a round in `fields` before it requests the next round.

    Args:
        mesh: The plane.
        fields: Fields over all cells, by name, at least the ones in `FIELDS`.
        level_ground: Mask of the symmetric cells (gamma = 0, equal walls), where a motion and its mirror image count as
            one kind of motion.
    """
    fronts = {level: _Front(mesh, level) for level in range(1, mesh.levels + 1)}
    # All blocks of the coarsest lattice exist from the start; finer blocks are made by splits.
    fronts[mesh.levels].exists[...] = True
    computed = np.zeros(math.prod(mesh.shape), bool)
    new = mesh.lattice(mesh.levels).ravel()
    while new.size:
        yield new
        computed[new] = True
        # Every new cell is tested against its block at every level: it may contradict a coarse block that would
        # otherwise be interpolated.
        for level in range(1, mesh.levels + 2):
            unlike, missed = _contradictions(mesh, fields, level_ground, new, level)
            if level in fronts:
                fronts[level].mark(new[unlike | missed])
            # The children of a contradicted block may be wrong too, and no cell has been computed in them yet.
            if level - 1 in fronts:
                fronts[level - 1].mark(new[missed])
        for front in fronts.values():
            front.add_enclosed(computed)
        to_compute = np.zeros(computed.size, bool)
        # The finest level comes first, so that the children of a block split now are compared in the next round, when
        # their corners have been computed.
        for level, front in fronts.items():
            split = front.split(fields, level_ground)
            if split.any():
                to_compute[mesh.lattice(level - 1)[_closure(mesh, split, level)]] = True
                if level - 1 in fronts:
                    fronts[level - 1].exists |= _children(mesh, split, level)
        new = np.flatnonzero(to_compute & ~computed)


class _Front:
    """The blocks of one level and their state, boolean arrays over the blocks.

    Attributes:
        exists: Blocks that exist: within the first lattice, or made by a split of the coarser level.
        compared: Existing blocks after the comparison of their corners.
        unlike: Blocks with corners of different kinds of motion.
        contradicted: Blocks that contain a computed cell that contradicts the interpolation.
        was_split: Blocks that have been split.
    """

    def __init__(self, mesh: Mesh, level: int) -> None:
        self.mesh, self.level = mesh, level
        # An array of points has one more point than blocks along each axis.
        self.points = mesh.lattice(level)
        blocks = tuple(size - 1 for size in self.points.shape)
        self.exists, self.compared, self.unlike, self.contradicted, self.was_split = (
            np.zeros(blocks, bool) for _ in range(5)
        )

    def mark(self, cells: Cells) -> None:
        """Mark the blocks that contain these cells as contradicted, whether they exist yet or not."""
        sides = [self.mesh.blocks(axis, self.level, rank) for axis, rank in enumerate(self.mesh.ranks_of(cells))]
        for block in itertools.product(*sides):
            self.contradicted[block] = True

    def add_enclosed(self, computed: np.ndarray) -> None:
        """Add blocks that no split has made although all their corners are computed.

        Without this, such blocks would be interpolated without a comparison of their corners. They lie at the end of an
        axis, are too narrow to contain a point of the finer lattice, and share their corners with blocks that were
        split.
        """
        size = self.exists.shape
        corners = (
            tuple(slice(i, i + n) for i, n in zip(place, size, strict=True))
            for place in itertools.product((0, 1), repeat=len(size))
        )
        self.exists |= np.all([computed[self.points[corner]] for corner in corners], axis=0)

    def split(self, fields: CellFields, level_ground: np.ndarray) -> np.ndarray:
        """Return the blocks to split now: blocks on a border, their neighbours, and contradicted blocks."""
        new = np.nonzero(self.exists & ~self.compared)
        self.compared |= self.exists
        # Corners [corner, block] of all blocks to compare: block indices plus 0 or 1 along each axis.
        corners = np.stack([self.points[place] for place in itertools.product(*((i, i + 1) for i in new))])
        kind = _kind(fields, level_ground, corners)
        self.unlike[new] = (kind != kind[0]).any((0, -1))
        split = (self.contradicted | _with_neighbours(self.unlike)) & self.exists & ~self.was_split
        self.was_split |= split
        return split


def _kind(fields: CellFields, level_ground: np.ndarray, cells: Cells) -> np.ndarray:
    """Return the kind of motion of cells as numbers along a last dimension; all are equal where motions are alike."""
    period, count_left, count_right, status = (
        fields[name][cells] for name in ("period", "impacts_left", "impacts_right", "status")
    )
    # CONVERGING and FEW_IMPACTS concern the accuracy of a cell and not its kind of motion.
    status = np.where(np.isin(status, (Status.CONVERGING, Status.FEW_IMPACTS)), Status.OK, status)
    few, many = order_counts(count_left, count_right, level_ground[cells])
    # Whether any energy is harvested is part of the kind, as a logarithm of P cannot be interpolated to 0.
    return np.stack([period, few, many, status, fields["P"][cells, 0] > 0], axis=-1)


def _contradictions(
    mesh: Mesh, fields: CellFields, level_ground: np.ndarray, cells: Cells, level: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return two masks: cells of another kind than a corner of their block; other cells with a wrong interpolated P."""
    corners, weights, _ = mesh.corners(cells, level)
    unlike = (_kind(fields, level_ground, corners) != _kind(fields, level_ground, cells)).any((0, -1))

    def power_and_error(cells: Cells) -> tuple[np.ndarray, np.ndarray]:
        power, error = fields["P"][cells], fields["P_stderr"][cells]
        positive = np.where(power > 0, power, 1.0)
        return np.log(positive), np.where(error > 0, error, 0.0) / positive

    (logs, errors), (log, error) = power_and_error(corners), power_and_error(cells)
    predicted, predicted_error = ((weights[..., None] * values).sum(0) for values in (logs, errors))
    misses_power = (np.abs(predicted - log) > P_RTOL + N_STDERR * (predicted_error + error)).any(-1)
    return unlike, misses_power & ~unlike


def _with_neighbours(blocks: np.ndarray) -> np.ndarray:
    """Return these blocks and all blocks that share a face with one of them."""
    result = blocks.copy()
    for axis in range(blocks.ndim):
        here, grown = np.moveaxis(blocks, axis, 0), np.moveaxis(result, axis, 0)
        grown[1:] |= here[:-1]
        grown[:-1] |= here[1:]
    return result


def _closure(mesh: Mesh, blocks: np.ndarray, level: int) -> np.ndarray:
    """Return the points of the next finer lattice in these blocks or on their borders."""
    for axis in range(blocks.ndim):
        # Along each axis in turn: a point belongs to the result if the block below or above it does.
        below, above = mesh.blocks(axis, level, mesh.ranks(axis, level - 1))
        blocks = blocks.take(below, axis) | blocks.take(above, axis)
    return blocks


def _children(mesh: Mesh, blocks: np.ndarray, level: int) -> np.ndarray:
    """Return the blocks of the next finer level within these blocks."""
    for axis in range(blocks.ndim):
        _, above = mesh.blocks(axis, level, mesh.ranks(axis, level - 1)[:-1])
        blocks = blocks.take(above, axis)
    return blocks


def interpolate_missing(
    mesh: Mesh, fields: dict[str, np.ndarray], computed: np.ndarray, level_ground: np.ndarray
) -> None:
    """Interpolate the cells that were not computed from the corners of the smallest unsplit block around each.

    Counts and codes are copied from the nearest corner; all corners agree, or are mirror images. All other fields are
    interpolated, in their logarithm where the values at all corners are positive. `periods_run` is set to 0.

    Args:
        mesh: The plane.
        fields: All fields, filled in place.
        computed: Cells that were computed, in any round.
        level_ground: As in `cells_by_round`.
    """
    missing = np.flatnonzero(~computed)
    for pending in np.array_split(missing, math.ceil(missing.size / _CELLS_PER_INTERPOLATION) or 1):
        for level in range(1, mesh.levels + 1):
            corners, weights, nearest = mesh.corners(pending, level)
            surrounded = computed[corners].all(0)
            _interpolate(
                fields,
                level_ground,
                pending[surrounded],
                corners[:, surrounded],
                weights[:, surrounded],
                nearest[surrounded],
            )
            pending = pending[~surrounded]
    if "periods_run" in fields:
        fields["periods_run"][~computed] = 0


def _interpolate(
    fields: dict[str, np.ndarray],
    level_ground: np.ndarray,
    cells: Cells,
    corners: np.ndarray,
    weights: np.ndarray,
    nearest: Cells,
) -> None:
    """Interpolate cells from corners [corner, cell] that are all computed."""
    # The motions at two corners may be mirror images of each other. They are mirrored to agree with the nearest corner.
    is_mirrored = _more_impacts_left(fields, level_ground, corners) != _more_impacts_left(fields, level_ground, nearest)
    filled = {}
    for name, values in fields.items():
        # Counts and codes cannot be interpolated.
        if values.dtype.kind != "f":
            filled[name] = values[nearest]
            continue
        at_corners = values[corners]
        if name in _MIRROR:
            other, sign = _MIRROR[name]
            at_corners = np.where(is_mirrored, sign * fields[other][corners], at_corners)
        filled[name] = _blend(at_corners, weights)
    for name, values in filled.items():
        fields[name][cells] = values


def _more_impacts_left(fields: CellFields, level_ground: np.ndarray, cells: Cells) -> np.ndarray:
    """Return True where a motion has more impacts on the left or, at equal counts, more restitution on the left."""
    excess_left = fields["impacts_left"][cells] - fields["impacts_right"][cells]
    higher_restitution_left = fields["restitution_left"][cells] > fields["restitution_right"][cells]
    return level_ground[cells] & ((excess_left > 0) | ((excess_left == 0) & higher_restitution_left))


def _blend(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the weighted mean over corners of values [corner, cell, ...], by logarithm where all are positive."""
    weights = weights.reshape(weights.shape + (1,) * (values.ndim - 2))
    positive = (values > 0).all(0)
    logs = np.log(np.where(positive, values, 1.0))
    # Weighted geometric mean of positive values, so that a power law in an axis is reproduced; else the arithmetic
    # mean.
    return np.where(positive, np.exp((weights * logs).sum(0)), (weights * values).sum(0))
