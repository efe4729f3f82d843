"""Cells of a sweep: the quantities that the dynamics and the energies of each depend on, as its axes give them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vijax.model.choices import Walls
from vijax.model.device import WALLS_OWN, Harvester, check_fits
from vijax.model.pair import RIGID_ON, ImpactPair, pair_of
from vijax.model.quantities import AXES, SIDES, START, START_REACH, of_both_walls, synonyms, whole
from vijax.model.sides import Sides
from vijax.planes.axes import check_axis, dimension
from vijax.runtime import checks

if TYPE_CHECKING:
    import xarray as xr

# The most cells of a plane, whose store would be some 80 TB then.
_MOST_CELLS = 10**12
_BYTES = 8  # Of a number, as quantities of cells are held.


class Places(NamedTuple):
    """Where some cells are.

    Attributes:
        shape: Of the array of their flat indices.
        along: Their places along every dimension that the dynamics depend on; None of all cells in order.
    """

    shape: tuple[int, ...]
    along: dict[str, np.ndarray] | None


@dataclass(frozen=True)
class Cells:
    """The cells of a sweep: which dimensions the dynamics see, and what each cell and each variant of it is.

    Attributes:
        given: The axes as they were given, over their dimensions; several axes may share one.
        labels: Coordinates of dimensions that are no axes; numbers from 0 unless given.
        sizes: Length of every dimension, in the order given.
        dynamic: Dimensions that the dynamics depend on: one simulation for each of their points.
        variant: The other dimensions, which enter the energies alone.
        quantities: d, kappa, r, gamma, u0, v0, omega [rad/s] and A [m/s^2], each over the dimensions it depends on;
            where the walls may differ, kappa_left, kappa_right, r_left and r_right.
        length: Metres per unit of displacement (rigid wall: of speed over omega0, the engine's depth).
        speed: Metres per second per unit of velocity.
    """

    given: "dict[str, xr.Variable]"
    labels: "dict[str, xr.Variable]"
    sizes: dict[str, int]
    dynamic: tuple[str, ...]
    variant: tuple[str, ...]
    quantities: "dict[str, xr.Variable]"
    length: "xr.Variable"
    speed: "xr.Variable"

    @property
    def pair_names(self) -> tuple[str, ...]:
        """Name the quantities of the pair."""
        return tuple(name for name in self.quantities if whole(name) in ("d", "kappa", "r", "gamma"))

    @property
    def unequal(self) -> bool:
        """Say whether the walls may differ."""
        return "r_left" in self.quantities

    def pair(self, cells: "np.ndarray | Places", wall: Walls) -> ImpactPair:
        """Make the pair of some cells, of NumPy's arrays."""
        places = self.places(cells)
        return pair_of({name: self.flat(self.quantities[name], places) for name in self.pair_names}, wall)

    @property
    def count(self) -> int:
        """Count the simulations."""
        return math.prod(self.sizes[dim] for dim in self.dynamic)

    def places(self, cells: "np.ndarray | Places") -> "Places":
        """Find where the cells with the given flat indices are; once for all quantities, as it takes the longest."""
        if isinstance(cells, Places):
            return cells
        if np.array_equal(cells, np.arange(self.count)):
            return Places(cells.shape, None)
        along = np.unravel_index(cells, [self.sizes[dim] for dim in self.dynamic]) if self.dynamic else ()
        return Places(cells.shape, dict(zip(self.dynamic, along, strict=True)))

    def flat(self, quantity: "xr.Variable", cells: "np.ndarray | Places") -> np.ndarray:
        """Take a quantity's values in the cells with the given flat indices; variants at their first point."""
        first = quantity.isel({dim: 0 for dim in self.variant if dim in quantity.dims})
        if not first.dims:
            return np.broadcast_to(first.values, cells.shape)
        places = self.places(cells)
        if places.along is None:
            sizes = {dim: self.sizes[dim] if dim in first.dims else 1 for dim in self.dynamic}
            laid = first.transpose(*(dim for dim in self.dynamic if dim in first.dims)).values.reshape(
                [*sizes.values()]
            )
            return np.broadcast_to(laid, [self.sizes[dim] for dim in self.dynamic]).reshape(-1)
        # A quantity is never laid out over all dimensions at once, as a plane may be larger than memory.
        return np.broadcast_to(first.values[tuple(places.along[str(dim)] for dim in first.dims)], places.shape)

    def cut(self, block: Mapping[str, slice]) -> "Cells":
        """Cut a block out of the cells, the other dimensions whole."""

        def within(variable: "xr.Variable") -> "xr.Variable":
            return variable.isel({dim: part for dim, part in block.items() if dim in variable.dims})

        return replace(
            self,
            given={name: within(values) for name, values in self.given.items()},
            labels={name: within(values) for name, values in self.labels.items()},
            sizes={dim: len(range(size)[block.get(dim, slice(None))]) for dim, size in self.sizes.items()},
            quantities={name: within(values) for name, values in self.quantities.items()},
            length=within(self.length),
            speed=within(self.speed),
        )

    def factors(self, scale: "xr.Variable") -> np.ndarray:
        """Find by which factors variants change a scale: the same in every cell, as scales are products over axes."""
        first = scale.isel({dim: 0 for dim in self.dynamic if dim in scale.dims})
        full = first.set_dims({dim: self.sizes[dim] for dim in self.variant}).transpose(*self.variant)
        return np.ravel(full.values / full.values.flat[0])


def cells(
    given: Mapping[str, Any], device: Harvester, wall: str, *, restitution: bool = True, dimensional: bool = False
) -> Cells:
    """Lay out the cells of a sweep over the given axes; a quantity that no axis gives is the device's.

    Args:
        given: The axes.
        device: The device.
        wall: What the walls are.
        restitution: Whether the membrane has a restitution r. If not, there is no axis r, and r is NaN.
        dimensional: Whether the membrane has numbers with a dimension: its motion depends on omega and A themselves.

    Raises:
        ValueError: If a value is not allowed, two axes give one quantity, or a start lies outside a rigid gap.
        TypeError: If there is no axis of a given name.
    """
    import xarray as xr  # here, as importing vijax must not load it

    for name in given:
        if name not in AXES:
            raise TypeError(f"there is no axis {name!r}; the axes are {', '.join(AXES)}")
    for several in dict.fromkeys(map(synonyms, AXES)):
        rivals = [name for name in several if name in given]
        if len(rivals) > 1:
            raise ValueError(f"{' and '.join(rivals)} give the same quantity; give one of them")
    for name in given:
        both = of_both_walls(name)
        for rival in synonyms(both) if both else ():
            if rival in given:
                raise ValueError(f"{rival} and {name} give the same quantity; give one for both walls, or one for each")
        if whole(name) == "r" and not restitution:
            raise ValueError(
                f"{name} must be left out with a membrane that has no restitution; got {checks.shown(given[name])}"
            )
    values, labels, sizes = _laid_out(given)
    _check_sizes(values, sizes)
    quantities = _quantities(values, device, wall, xr)
    if not restitution:
        quantities |= {name: xr.Variable((), np.nan) for name in quantities if whole(name) == "r"}
    if wall != "soft":
        _check_start(quantities["d"], quantities["u0"], wall)
    stiff = [name for name in quantities if whole(name) == "kappa"]
    energies = {*(() if dimensional else ("omega", "A")), *(stiff if wall == "rigid" else ())}
    motion = [quantity for name, quantity in quantities.items() if name not in energies]
    dynamic = tuple(dim for dim in sizes if any(dim in quantity.dims for quantity in motion))
    length = quantities["A"] * math.pi**2 / quantities["omega"] ** 2
    return Cells(
        given=values,
        labels=labels,
        sizes=sizes,
        dynamic=dynamic,
        variant=tuple(dim for dim in sizes if dim not in dynamic),
        quantities=quantities,
        length=length / quantities[stiff[0]] if wall == "rigid" else length,
        speed=quantities["A"] * math.pi / quantities["omega"],
    )


def _laid_out(
    given: Mapping[str, Any],
) -> "tuple[dict[str, xr.Variable], dict[str, xr.Variable], dict[str, int]]":
    """Lay the axes along their dimensions: the axes, labels of dimensions that are no axes, lengths of dimensions.

    An array has a dimension of its own, named as its axis. Axes that are `xarray.DataArray`s with the same dimension
    share it: their values belong together one by one.

    Raises:
        ValueError: If a value is not allowed, or axes that share a dimension do not agree about it.
    """
    import xarray as xr

    values: dict[str, xr.Variable] = {}
    labels: dict[str, xr.Variable] = {}
    sizes: dict[str, int] = {}
    first: dict[str, str] = {}
    for name, axis in given.items():
        array, (dim, label) = check_axis(name, axis), dimension(name, axis)
        values[name] = xr.Variable((dim,) * array.ndim, array)
        if not array.ndim:
            continue
        other = first.setdefault(dim, name)
        if sizes.setdefault(dim, array.size) != array.size:
            raise ValueError(
                f"{other} and {name} must be of one length, as both have the dimension {dim}; "
                f"got {sizes[dim]} and {array.size}"
            )
        if dim in AXES and dim not in given:
            raise ValueError(f"{name} must not have the dimension {dim}, an axis that is not given; rename it")
        if label is not None and not labels.setdefault(dim, label).equals(label):
            raise ValueError(f"{other} and {name} must have the same coordinates along {dim}; got others; align them")
    for dim in [dim for dim in labels if dim in values]:
        if not np.array_equal(values[dim].values, labels.pop(dim).values):
            raise ValueError(f"{first[dim]} must have the values of {dim} along it; got other coordinates; align them")
    for dim in [dim for dim in sizes if dim not in values]:
        labels.setdefault(dim, xr.Variable(dim, np.arange(sizes[dim]), {"long_name": "number along the dimension"}))
    return values, labels, sizes


def _check_sizes(values: "dict[str, xr.Variable]", sizes: dict[str, int]) -> None:
    """Raise unless there is room for the quantities that follow from several axes, and for the indices of cells."""
    stiff = [(f"omega0_{side}", f"k_{side}", "omega") for side in SIDES]
    for rows in (("s", "distance", "omega", "A"), ("omega0", "k", "omega"), *stiff, ("beta", "A")):
        along = [name for name in rows if name in values and values[name].dims]
        dims = {dim for name in along for dim in values[name].dims}
        checks.fits(along, _BYTES * math.prod(sizes[str(dim)] for dim in dims), "the quantities of cells")
    if (count := math.prod(sizes.values())) > _MOST_CELLS:
        names = checks.joined(name for name, size in sizes.items() if size > 1)
        raise ValueError(
            f"{names} must make at most {_MOST_CELLS:.0e} cells; got {count:.1e}; cut the plane into several"
        )


def _quantities(values: "dict[str, xr.Variable]", device: Harvester, wall: str, xr: Any) -> "dict[str, xr.Variable]":
    def own(name: str) -> "xr.Variable":
        if name in values:
            return values[name]
        return xr.Variable((), check_axis(name, getattr(device, name)))

    omega, amplitude, beta = own("omega"), own("A"), own("beta")
    travel = None if "d" in values else own("s")
    if "distance" in values:
        check_fits(values["distance"].values, device.r_b)
        travel = values["distance"] - 2 * float(device.r_b)
    d = values["d"] if travel is None else travel * omega**2 / (amplitude * math.pi**2)
    # A level tube has gamma = 0 whatever A is: dividing would make an energy-only axis a dynamic one.
    tilt = float(device.g) * np.sin(beta)
    gamma = values["gamma"] if "gamma" in values else (tilt / amplitude if tilt.values.any() else tilt)
    return {
        "d": d,
        **_of_walls(values, device, omega, wall, xr),
        "gamma": gamma,
        "u0": values["u0"] if "u0" in values else np.minimum(START[0], START_REACH * d),
        "v0": values["v0"] if "v0" in values else xr.Variable((), START[1]),
        "omega": omega,
        "A": amplitude,
    }


def _of_walls(
    values: "dict[str, xr.Variable]", device: Harvester, omega: "xr.Variable", wall: str, xr: Any
) -> "dict[str, xr.Variable]":
    """Give kappa and r: of both walls, or of each where anything may differ."""
    if wall == "rigid":
        _check_rigid(values, device)
    if wall in RIGID_ON:
        _check_rigid_side(values, wall)
    unequal = device.unequal or wall in RIGID_ON or any(map(of_both_walls, values))
    table = {}
    for side, end in ((-1, "_left"), (1, "_right")) if unequal else ((1, ""),):
        own = device.at(side)

        def given(name: str, end: str = end) -> "xr.Variable | None":
            return values.get(name + end, values.get(name))

        def constant(name: str, value: Any, end: str = end) -> "xr.Variable":
            return xr.Variable((), check_axis(name + end, value, name))

        r, kappa, omega0, k = (given(name) for name in ("r", "kappa", "omega0", "k"))
        if kappa is None:
            natural = np.sqrt(k / float(device.m_b)) if k is not None else omega0
            kappa = (constant("omega0", own.omega0) if natural is None else natural) * math.pi / omega
        table["kappa" + end] = xr.Variable((), np.inf) if end and wall == f"rigid{end}" else kappa
        table["r" + end] = constant("r", own.r) if r is None else r
    return dict(sorted(table.items()))


def _check_rigid_side(values: "dict[str, xr.Variable]", wall: str) -> None:
    """Raise ValueError where a rigid wall beside a soft one is given a membrane, which it has not."""
    side = wall.removeprefix("rigid_")
    for name in values:
        if name.endswith(f"_{side}") and of_both_walls(name) in synonyms("kappa"):
            raise ValueError(
                f'{name} must be left out with wall="{wall}", whose {side} wall has no membrane; '
                f"got {checks.shown(values[name].values)}"
            )


def _check_rigid(values: "dict[str, xr.Variable]", device: Harvester) -> None:
    """Raise ValueError where two rigid walls are given two membranes: they are lent the depth of one."""
    for name in values:
        if of_both_walls(name) not in ("", "r"):
            raise ValueError(
                f"{name} must be left out of rigid walls, which are lent the depth of one membrane; "
                f"got {checks.shown(values[name].values)}; give {of_both_walls(name)}"
            )
    for name in WALLS_OWN:
        if name != "r" and isinstance(getattr(device, name), Sides):
            raise ValueError(f"device.{name} must be one number for rigid walls, lent one membrane; got Sides")


def _check_start(d: "xr.Variable", u0: "xr.Variable", wall: str) -> None:
    beyond = {"rigid_left": -u0, "rigid_right": u0}.get(wall, abs(u0))
    room = 0.5 * d - beyond
    first = np.argmin(room.values >= 0)
    if room.values.flat[first] < 0:
        got = [float((0 * room + value).values.flat[first]) for value in (u0, d)]
        raise ValueError(f"u0 must lie in the gap of a rigid wall, |u0| <= d/2; got {got[0]:g} where d = {got[1]:g}")
