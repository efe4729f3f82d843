"""Cells of a sweep: the quantities that the motion and the energies of each cell depend on, computed from the axes.

With a length unit of A pi^2/omega^2 metres: d = s omega^2/(A pi^2), kappa = omega0 pi/omega, gamma = g sin(beta)/A. A
dimension is dynamic if any of d, kappa, r, gamma, u0, v0 varies along it; the motion is simulated once per point of the
dynamic dimensions. Along a variant dimension (omega or A at fixed dimensionless values, kappa of rigid walls) only the
energies vary. The scaling is the paper's first one, with half a forcing period as the unit of time.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vijax.maps.axes import check_axis, dimension
from vijax.model.choices import Walls
from vijax.model.device import PER_WALL_CONSTANTS, Harvester, check_fits
from vijax.model.pair import ONE_RIGID_WALL, ImpactPair, pair_of
from vijax.model.quantities import AXES, SIDES, START, START_REACH, both_walls_name, synonyms, without_wall
from vijax.model.walls.sides import Sides
from vijax.runtime import validation

if TYPE_CHECKING:
    import xarray as xr

# Maximum number of cells of a plane; a store of so many would take some 80 TB.
_MOST_CELLS = 10**12
_BYTES_PER_NUMBER = 8  # float64, the dtype of the quantities of cells


class CellPositions(NamedTuple):
    """Positions of selected cells in the plane.

    Attributes:
        shape: Shape of the array of flat indices that selects the cells.
        along: Indices of the cells along every dynamic dimension; None if all cells are selected in order.
    """

    shape: tuple[int, ...]
    along: dict[str, np.ndarray] | None


@dataclass(frozen=True)
class Cells:
    """The cells of a sweep, and the quantities of each.

    Attributes:
        axes: The axes as specified, over their dimensions; several axes may share one.
        labels: Coordinates along dimensions that no axis is named after (dimensions of `xarray.DataArray`s); 0, 1, 2,
            ... by default.
        sizes: Length of every dimension, in the order specified.
        dynamic: Dimensions that the motion depends on: one simulation for each of their points.
        variant: The other dimensions, along which only energies and SI scales vary.
        quantities: d, kappa, r, gamma, u0, v0, omega [rad/s] and A [m/s^2], each over the dimensions it depends on;
            where the walls may differ, kappa_left, kappa_right, r_left and r_right.
        length: Metres per unit of displacement; with rigid walls, metres per unit of the penetration of Eq. (35), which
            the engine computes for kappa = 1.
        speed: Metres per second per unit of velocity.
    """

    axes: "dict[str, xr.Variable]"
    labels: "dict[str, xr.Variable]"
    sizes: dict[str, int]
    dynamic: tuple[str, ...]
    variant: tuple[str, ...]
    quantities: "dict[str, xr.Variable]"
    length: "xr.Variable"
    speed: "xr.Variable"

    @property
    def pair_names(self) -> tuple[str, ...]:
        """Names of the quantities of the impact pair: d, kappa, r, gamma, or the values per wall."""
        return tuple(name for name in self.quantities if without_wall(name) in ("d", "kappa", "r", "gamma"))

    @property
    def has_unequal_walls(self) -> bool:
        """Whether the walls may differ; kappa and r are then given per wall."""
        return "r_left" in self.quantities

    def pair(self, cells: "np.ndarray | CellPositions", wall: Walls) -> ImpactPair:
        """Return the impact pair of selected cells; its fields are NumPy arrays [cell]."""
        positions = self.positions(cells)
        return pair_of({name: self.flat(self.quantities[name], positions) for name in self.pair_names}, wall)

    @property
    def count(self) -> int:
        """Number of simulations."""
        return math.prod(self.sizes[dim] for dim in self.dynamic)

    def positions(self, cells: "np.ndarray | CellPositions") -> "CellPositions":
        """Return the positions of the cells with these flat indices.

        This is the slowest step of `flat`, so a caller that needs several quantities calls it once and passes the
        result to `flat`.
        """
        if isinstance(cells, CellPositions):
            return cells
        # All cells in order is the usual case: `flat` then broadcasts values without index arrays, which is much
        # faster.
        if np.array_equal(cells, np.arange(self.count)):
            return CellPositions(cells.shape, None)
        along = np.unravel_index(cells, [self.sizes[dim] for dim in self.dynamic]) if self.dynamic else ()
        return CellPositions(cells.shape, dict(zip(self.dynamic, along, strict=True)))

    def flat(self, quantity: "xr.Variable", cells: "np.ndarray | CellPositions") -> np.ndarray:
        """Return a quantity in the cells with these flat indices, at the first point of every variant dimension."""
        at_first_variant = quantity.isel({dim: 0 for dim in self.variant if dim in quantity.dims})
        if not at_first_variant.dims:
            return np.broadcast_to(at_first_variant.values, cells.shape)
        positions = self.positions(cells)
        if positions.along is None:
            sizes = {dim: self.sizes[dim] if dim in at_first_variant.dims else 1 for dim in self.dynamic}
            ordered = at_first_variant.transpose(
                *(dim for dim in self.dynamic if dim in at_first_variant.dims)
            ).values.reshape([*sizes.values()])
            return np.broadcast_to(ordered, [self.sizes[dim] for dim in self.dynamic]).reshape(-1)
        # A quantity is not broadcast over all dimensions at once, because a plane may be larger than memory.
        return np.broadcast_to(
            at_first_variant.values[tuple(positions.along[str(dim)] for dim in at_first_variant.dims)], positions.shape
        )

    def cut(self, block: Mapping[str, slice]) -> "Cells":
        """Return a block of the cells; dimensions that `block` does not name are complete."""

        def within(variable: "xr.Variable") -> "xr.Variable":
            return variable.isel({dim: part for dim, part in block.items() if dim in variable.dims})

        return replace(
            self,
            axes={name: within(values) for name, values in self.axes.items()},
            labels={name: within(values) for name, values in self.labels.items()},
            sizes={dim: len(range(size)[block.get(dim, slice(None))]) for dim, size in self.sizes.items()},
            quantities={name: within(values) for name, values in self.quantities.items()},
            length=within(self.length),
            speed=within(self.speed),
        )

    def factors(self, scale: "xr.Variable") -> np.ndarray:
        """Return a scale (length or speed) in every variant, divided by its value in the first variant, [variant].

        A scale is a product of functions of one axis each, so these ratios are the same in every cell.
        """
        at_first_cell = scale.isel({dim: 0 for dim in self.dynamic if dim in scale.dims})
        over_variants = at_first_cell.set_dims({dim: self.sizes[dim] for dim in self.variant}).transpose(*self.variant)
        return np.ravel(over_variants.values / over_variants.values.flat[0])


def cells(
    axes: Mapping[str, Any], device: Harvester, wall: str, *, restitution: bool = True, dimensional: bool = False
) -> Cells:
    """Lay out the cells of a sweep over its axes; a quantity without an axis is taken from the device.

    Args:
        axes: Value or values of each axis.
        device: The device.
        wall: Kind of the walls.
        restitution: Whether the membrane has a restitution r. If not, there is no axis r, and r is NaN.
        dimensional: Whether the law of the membrane has constants with a dimension. The motion then depends on omega
            and A themselves, not only on d, kappa, r and gamma.

    Raises:
        ValueError: If a value is not allowed, two axes specify one quantity, or a start lies outside a rigid gap.
        TypeError: If a name in `axes` is not the name of an axis.
    """
    import xarray as xr  # here, as importing vijax must not load it

    for name in axes:
        if name not in AXES:
            raise TypeError(f"there is no axis {name!r}; the axes are {', '.join(AXES)}")
    for names in dict.fromkeys(map(synonyms, AXES)):
        conflicting = [name for name in names if name in axes]
        if len(conflicting) > 1:
            raise ValueError(f"{' and '.join(conflicting)} give the same quantity; give one of them")
    for name in axes:
        # An axis of one wall conflicts with an axis of both walls for the same quantity, also if the two have different
        # names, as omega0_left and k. `both` is empty for an axis that does not belong to one wall.
        both = both_walls_name(name)
        for other in synonyms(both) if both else ():
            if other in axes:
                raise ValueError(f"{other} and {name} give the same quantity; give one for both walls, or one for each")
        if without_wall(name) == "r" and not restitution:
            raise ValueError(
                f"{name} must be left out with a membrane that has no restitution; "
                f"got {validation.value_text(axes[name])}"
            )
    values, labels, sizes = _lay_out_axes(axes)
    _check_sizes(values, sizes)
    quantities = _quantities(values, device, wall, xr)
    if not restitution:
        quantities |= {name: xr.Variable((), np.nan) for name in quantities if without_wall(name) == "r"}
    if wall != "soft":
        _check_start(quantities["d"], quantities["u0"], wall)
    kappas = [name for name in quantities if without_wall(name) == "kappa"]
    # Quantities that do not change the dimensionless motion: omega and A, unless the law of the membrane has constants
    # with a dimension; and kappa of two rigid walls.
    energy_only = {*(() if dimensional else ("omega", "A")), *(kappas if wall == "rigid" else ())}
    motion = [quantity for name, quantity in quantities.items() if name not in energy_only]
    dynamic = tuple(dim for dim in sizes if any(dim in quantity.dims for quantity in motion))
    # One unit of displacement is A pi^2/omega^2 metres, one unit of velocity A pi/omega metres per second. With rigid
    # walls the penetration of Eq. (35) is proportional to 1/kappa; the engine returns it for kappa = 1.
    length = quantities["A"] * math.pi**2 / quantities["omega"] ** 2
    return Cells(
        axes=values,
        labels=labels,
        sizes=sizes,
        dynamic=dynamic,
        variant=tuple(dim for dim in sizes if dim not in dynamic),
        quantities=quantities,
        length=length / quantities[kappas[0]] if wall == "rigid" else length,
        speed=quantities["A"] * math.pi / quantities["omega"],
    )


def _lay_out_axes(
    axes: Mapping[str, Any],
) -> "tuple[dict[str, xr.Variable], dict[str, xr.Variable], dict[str, int]]":
    """Return the axes over their dimensions, labels of dimensions that are no axes, and lengths of all dimensions.

    An array has a dimension of its own, named like its axis. Axes that are `xarray.DataArray`s with the same dimension
    share it: their values belong together one by one.

    Raises:
        ValueError: If a value is not allowed, or axes that share a dimension differ in its length or its labels.
    """
    import xarray as xr

    values: dict[str, xr.Variable] = {}
    labels: dict[str, xr.Variable] = {}
    sizes: dict[str, int] = {}
    first: dict[str, str] = {}
    for name, axis in axes.items():
        array, (dim, label) = check_axis(name, axis), dimension(name, axis)
        values[name] = xr.Variable((dim,) * array.ndim, array)
        if not array.ndim:
            continue
        # The first axis with a dimension sets its length and its labels; later ones must agree.
        other = first.setdefault(dim, name)
        if sizes.setdefault(dim, array.size) != array.size:
            raise ValueError(
                f"{other} and {name} must be of one length, as both have the dimension {dim}; "
                f"got {sizes[dim]} and {array.size}"
            )
        if dim in AXES and dim not in axes:
            raise ValueError(f"{name} must not have the dimension {dim}, an axis that is not given; rename it")
        if label is not None and not labels.setdefault(dim, label).equals(label):
            raise ValueError(f"{other} and {name} must have the same coordinates along {dim}; got others; align them")
    # Labels along a dimension that is itself an axis must equal the values of that axis, and are then redundant.
    for dim in [dim for dim in labels if dim in values]:
        if not np.array_equal(values[dim].values, labels.pop(dim).values):
            raise ValueError(f"{first[dim]} must have the values of {dim} along it; got other coordinates; align them")
    for dim in [dim for dim in sizes if dim not in values]:
        labels.setdefault(dim, xr.Variable(dim, np.arange(sizes[dim]), {"long_name": "number along the dimension"}))
    return values, labels, sizes


def _check_sizes(values: "dict[str, xr.Variable]", sizes: dict[str, int]) -> None:
    """Raise ValueError unless the derived quantities fit in memory and the number of cells can be indexed."""
    # Each tuple lists axes that are broadcast against one another in one derived quantity. Its number of values is the
    # product of the lengths of their dimensions.
    stiff = [(f"omega0_{side}", f"k_{side}", "omega") for side in SIDES]
    for rows in (("s", "distance", "omega", "A"), ("omega0", "k", "omega"), *stiff, ("beta", "A")):
        along = [name for name in rows if name in values and values[name].dims]
        dims = {dim for name in along for dim in values[name].dims}
        validation.check_memory(
            along, _BYTES_PER_NUMBER * math.prod(sizes[str(dim)] for dim in dims), "the quantities of cells"
        )
    if (count := math.prod(sizes.values())) > _MOST_CELLS:
        names = validation.join_names(name for name, size in sizes.items() if size > 1)
        raise ValueError(
            f"{names} must make at most {_MOST_CELLS:.0e} cells; got {count:.1e}; cut the plane into several"
        )


def _quantities(values: "dict[str, xr.Variable]", device: Harvester, wall: str, xr: Any) -> "dict[str, xr.Variable]":
    """Compute the quantities of `Cells` from the axes, or from the device where no axis specifies them."""

    def axis_or_constant(name: str) -> "xr.Variable":
        if name in values:
            return values[name]
        return xr.Variable((), check_axis(name, getattr(device, name)))

    omega, amplitude, beta = axis_or_constant("omega"), axis_or_constant("A"), axis_or_constant("beta")
    travel = None if "d" in values else axis_or_constant("s")
    # The distance of the walls exceeds the travel s of the ball by the diameter of the ball.
    if "distance" in values:
        check_fits(values["distance"].values, device.r_b)
        travel = values["distance"] - 2 * float(device.r_b)
    d = values["d"] if travel is None else travel * omega**2 / (amplitude * math.pi**2)
    # A level tube has gamma = 0 whatever A is. Without this case gamma would depend on A, so A would be a dynamic
    # dimension, and energies of several A would cost several simulations.
    tilt = float(device.g) * np.sin(beta)
    gamma = values["gamma"] if "gamma" in values else (tilt / amplitude if tilt.values.any() else tilt)
    return {
        "d": d,
        **_wall_quantities(values, device, omega, wall, xr),
        "gamma": gamma,
        "u0": values["u0"] if "u0" in values else np.minimum(START[0], START_REACH * d),
        "v0": values["v0"] if "v0" in values else xr.Variable((), START[1]),
        "omega": omega,
        "A": amplitude,
    }


def _wall_quantities(
    values: "dict[str, xr.Variable]", device: Harvester, omega: "xr.Variable", wall: str, xr: Any
) -> "dict[str, xr.Variable]":
    """Return kappa and r: common to both walls, or per wall where the walls may differ."""
    if wall == "rigid":
        _check_rigid(values, device)
    if wall in ONE_RIGID_WALL:
        _check_rigid_side(values, wall)
    # An axis that belongs to one wall makes the walls differ, whatever its values are.
    unequal = device.has_unequal_walls or wall in ONE_RIGID_WALL or any(map(both_walls_name, values))
    table = {}
    for side, suffix in ((-1, "_left"), (1, "_right")) if unequal else ((1, ""),):
        wall_device = device.at(side)

        # An axis of this wall takes precedence over an axis of both walls.
        def axis_of_wall(name: str, suffix: str = suffix) -> "xr.Variable | None":
            return values.get(name + suffix, values.get(name))

        def constant(name: str, value: Any, suffix: str = suffix) -> "xr.Variable":
            return xr.Variable((), check_axis(name + suffix, value, name))

        r, kappa, omega0, k = (axis_of_wall(name) for name in ("r", "kappa", "omega0", "k"))
        # kappa = omega0 pi/omega with omega0 = sqrt(k/m_b), from the first of kappa, k, omega0 that an axis specifies,
        # else from the device.
        if kappa is None:
            natural = np.sqrt(k / float(device.m_b)) if k is not None else omega0
            kappa = (constant("omega0", wall_device.omega0) if natural is None else natural) * math.pi / omega
        # An infinite kappa marks the rigid wall of a pair with one soft wall.
        table["kappa" + suffix] = xr.Variable((), np.inf) if suffix and wall == f"rigid{suffix}" else kappa
        table["r" + suffix] = constant("r", wall_device.r) if r is None else r
    return dict(sorted(table.items()))


def _check_rigid_side(values: "dict[str, xr.Variable]", wall: str) -> None:
    """Raise ValueError if a membrane is specified for the rigid wall of a pair with one soft wall."""
    side = wall.removeprefix("rigid_")
    for name in values:
        if name.endswith(f"_{side}") and both_walls_name(name) in synonyms("kappa"):
            raise ValueError(
                f'{name} must be left out with wall="{wall}", because the {side} wall has no membrane; '
                f"got {validation.value_text(values[name].values)}"
            )


def _check_rigid(values: "dict[str, xr.Variable]", device: Harvester) -> None:
    """Raise ValueError if two rigid walls get two membranes: their penetration is computed from one kappa, Eq. (35)."""
    for name in values:
        if both_walls_name(name) not in ("", "r"):
            raise ValueError(
                f"{name} must be left out with rigid walls, which share the penetration depth of one membrane; "
                f"got {validation.value_text(values[name].values)}; give {both_walls_name(name)}"
            )
    for name in PER_WALL_CONSTANTS:
        if name != "r" and isinstance(getattr(device, name), Sides):
            raise ValueError(f"device.{name} must be one number for rigid walls, which share one membrane; got Sides")


def _check_start(d: "xr.Variable", u0: "xr.Variable", wall: str) -> None:
    """Raise ValueError if a start u0 lies beyond a rigid wall."""
    outward = {"rigid_left": -u0, "rigid_right": u0}.get(wall, abs(u0))
    clearance = 0.5 * d - outward
    # The first cell with a negative clearance; 0 if there is none.
    first = np.argmin(clearance.values >= 0)
    if clearance.values.flat[first] < 0:
        # Adding 0 * clearance broadcasts u0 and d to the dimensions of the clearance.
        got = [float((0 * clearance + value).values.flat[first]) for value in (u0, d)]
        raise ValueError(f"u0 must lie in the gap of a rigid wall, |u0| <= d/2; got {got[0]:g} where d = {got[1]:g}")
