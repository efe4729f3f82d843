"""What lies around an optimum: the attractors that coexist with it, and the bifurcations on either side."""

import math
from typing import NamedTuple

import jax
import numpy as np

from vijax import branch
from vijax import orbit as orbits
from vijax.attractor import basin_fractions
from vijax.design import Optimum
from vijax.method import whole

_SAME = 1e-6  # relative difference of P within which an attractor is the optimum's own orbit


class Neighbour(NamedTuple):
    """An attractor at the optimum: its name, P [J per half period], share of all starts, and whether it may be."""

    label: str
    P: float
    share: float
    admissible: bool


class Edge(NamedTuple):
    """The first bifurcation that the optimum's orbit meets on one side.

    Attributes:
        kind: "fold", "flip", "pitchfork", "grazing ..." (see `branch.Point`), or "none" as far as was looked.
        omega0: Where [rad/s].
        percent: How far that is from the optimum, in percent of its omega0.
    """

    kind: str
    omega0: float
    percent: float


class Surroundings(NamedTuple):
    """What lies around an optimum.

    Attributes:
        share: Part of all starts that its orbit (and the mirror image) attracts.
        attractors: All that were met there, its own among them, the largest share first.
        below, above: Along omega0, all else of the device as it is.
    """

    share: float
    attractors: tuple[Neighbour, ...]
    below: Edge
    above: Edge


def surroundings(optimum: Optimum, *, starts: int = 2000, reach: float = 0.5, seed: int | None = None) -> Surroundings:
    """Look around an optimum.

    Args:
        optimum: Of `design.optimise`.
        starts: Of balls that show which attractors there are; see `attractor.basin_fractions`.
        reach: How far along omega0 to look for bifurcations, in parts of it, below 1.
        seed: Of starts drawn at random.

    Raises:
        ValueError: reach outside (0, 1), or starts that cannot be.
    """
    if not 0 < reach < 1:
        raise ValueError(f"reach must lie between 0 and 1; got {reach}")
    attractors = _attractors(optimum, whole("starts", starts, 1), seed)
    own = float(orbits.power(optimum.orbit, optimum.device)[0])
    share = sum(one.share for one in attractors if math.isclose(one.P, own, rel_tol=_SAME))
    kappa = float(optimum.device.omega0 * math.pi / optimum.device.omega)
    edges = [_edge(optimum, kappa, way, reach) for way in ("down", "up")]
    return Surroundings(share, attractors, *edges)


def _attractors(optimum: Optimum, starts: int, seed: int | None) -> tuple[Neighbour, ...]:
    d, kappa, r, gamma = (float(x[0]) for x in jax.tree.leaves(optimum.orbit.pair))
    found = basin_fractions(
        d=d, kappa=kappa, r=r, gamma=gamma, starts=starts, seed=seed, device=optimum.device, merge_mirrors=gamma == 0
    ).squeeze()
    columns = [np.atleast_1d(found[name].values) for name in ("label", "P", "fraction", "admissible")]
    rows = [Neighbour(str(a), float(b), float(c), bool(e)) for a, b, c, e in zip(*columns, strict=True) if c > 0]
    return tuple(sorted(rows, key=lambda one: -one.share))


def _edge(optimum: Optimum, kappa: float, way: str, reach: float) -> Edge:
    within = ((1 - reach) * kappa, (1 + reach) * kappa)
    (followed,) = branch.follow(optimum.orbit, "kappa", within, direction=way)
    kind, at = followed.points[0][:2] if followed.points else ("none", within[way == "up"])
    omega0 = float(optimum.device.omega0) * at / kappa
    return Edge(kind, omega0, 100 * (at / kappa - 1))
