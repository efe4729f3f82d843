"""Tolerances of a device's constants as quadrature nodes: factors on the constants, and their weights."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vijax.model.device import CONSTANTS, WALLS_OWN
from vijax.model.quantities import SIDES
from vijax.model.variables import ALIASES, LINEAR, constant
from vijax.runtime import checks

_MOST_SAMPLES = 10**5  # random devices: at 1/sqrt(10**5) noise is 0.3 % of the scatter
_NODES = {1: 17, 2: 9, 3: 5}  # how many nodes a constant has, by the number of constants


# beta and gamma, often zero, have no relative tolerance.
SCATTERED = tuple(name for name in (*CONSTANTS, *ALIASES) if name not in LINEAR)
SCATTERED += tuple(f"{name}_{side}" for name in WALLS_OWN for side in SIDES)


@dataclass(frozen=True)
class Tolerance:
    """The scatter of a constant of the device about its nominal value.

    Attributes:
        name: A field of `Harvester` or another name of one, as k; of one wall alone, as omega0_left.
        spread: Relative: half width of a uniform distribution, standard deviation of the logarithm of a log-normal one.
        kind: "uniform" or "lognormal".

    Raises:
        ValueError: Which field, what must hold, what was given.
    """

    name: str
    spread: float
    kind: str = "uniform"

    def __post_init__(self) -> None:
        checks.choice("name", self.name, SCATTERED)
        checks.choice("kind", self.kind, ("uniform", "lognormal"))
        must = f"a number between 0 and 1, a part of {self.name}"
        object.__setattr__(self, "spread", checks.real("spread", self.spread, must, lambda x: 0 < x < 1))


def check_tolerances(tolerances: Iterable[Tolerance], bounded: bool = False) -> tuple[Tolerance, ...]:
    """Pass the tolerances, if they can be.

    Args:
        tolerances: Of several constants.
        bounded: Whether the distribution must end: that of a worst case.
    """
    found = tuple(checks.sequence("tolerances", tolerances, Tolerance, "vijax.design.tolerance.Tolerance records"))
    for one in found:
        if bounded and one.kind != "uniform":
            raise ValueError(f"tolerances of a worst case must be uniform; got {one.kind} of {one.name}")
    names = [one.name for one in found]
    if len(set(map(constant, names))) < len(names):
        raise ValueError(f"tolerances must name a constant once; got {', '.join(names)}")
    return found


def check_samples(samples: Any) -> int:
    """Take the number of random devices, if there may be so many."""
    return checks.whole("samples", samples, 1, _MOST_SAMPLES)


class Nodes(NamedTuple):
    """Devices about a nominal one: factors [node, constant] and weights [node]; the first node is the nominal one."""

    names: tuple[str, ...]
    factors: np.ndarray
    weights: np.ndarray


def nodes(tolerances: tuple[Tolerance, ...], samples: int | None = None, seed: int = 0) -> Nodes:
    """Lay out nodes of the tolerances together.

    Args:
        tolerances: None for the nominal device alone.
        samples: Random devices in place of a quadrature.
        seed: Of the samples.

    Returns:
        Clenshaw and Curtis's rule for uniform constants, whose ends are among its nodes; Gauss and Hermite's for
        log-normal ones; their products. The nominal device comes first, with weight 0 unless it is alone.
    """
    tolerances = check_tolerances(tolerances)
    seed = checks.whole("seed", seed, 0, checks.MOST_SEED)
    names = tuple(one.name for one in tolerances)
    if not tolerances:
        return Nodes(names, np.ones((1, 0)), np.ones(1))
    if samples is not None:
        samples = check_samples(samples)
        factors, weights = drawn(tolerances, samples, seed)[1], np.full(samples, 1 / samples)
    else:
        rules = [_rule(one, _NODES.get(len(tolerances), 3)) for one in tolerances]
        columns = [_factors(one, x) for one, (x, _) in zip(tolerances, rules, strict=True)]
        factors = np.array(list(itertools.product(*columns)))
        weights = np.array([np.prod(ws) for ws in itertools.product(*(w for _, w in rules))])
    return Nodes(names, np.vstack([np.ones(len(names)), factors]), np.append(0.0, weights))


class Spread(NamedTuple):
    """P of a design over tolerances, each device on the design's motion.

    Attributes:
        mean: A device whose motion is lost, or inadmissible, counting nothing [J].
        worst: The least; 0 if the motion of one is lost [J].
        lost, inadmissible: Shares of devices.
    """

    mean: float
    worst: float
    lost: float
    inadmissible: float


def drawn(tolerances: tuple[Tolerance, ...], count: int, seed: int = 0) -> tuple[tuple[str, ...], np.ndarray]:
    """Draw so many random devices: names of the constants, and factors [device, constant]."""
    draw = np.random.default_rng(seed)
    columns = [_factors(one, _drawn(one, draw, count)) for one in tolerances]
    return tuple(one.name for one in tolerances), np.stack(columns, axis=1)


def _factors(one: Tolerance, x: np.ndarray) -> np.ndarray:
    return 1 + one.spread * x if one.kind == "uniform" else np.exp(one.spread * x)


def _drawn(one: Tolerance, draw: np.random.Generator, count: int) -> np.ndarray:
    return draw.uniform(-1, 1, count) if one.kind == "uniform" else draw.standard_normal(count)


def _rule(one: Tolerance, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute nodes and weights of one constant, in units of its spread."""
    if one.kind == "lognormal":
        x, w = np.polynomial.hermite_e.hermegauss(count)
        return x, w / w.sum()
    x = np.cos(np.pi * np.arange(count) / (count - 1))
    # The weights that integrate the Chebyshev polynomials through the nodes.
    moments = [0.0 if k % 2 else 1 / (1 - k * k) for k in range(count)]
    return x, np.linalg.solve(np.polynomial.chebyshev.chebvander(x, count - 1).T, np.array(moments))
