"""Tolerances of a device's constants, and their quadrature nodes: factors on the constants with weights.

The mean of f over the tolerances is sum_i w_i f(factors_i). The nodes are products of one-dimensional rules.
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vijax.model.device import CONSTANTS, PER_WALL_CONSTANTS
from vijax.model.quantities import SIDES
from vijax.model.tuned_quantities import ALIASES, LINEAR, constant
from vijax.runtime import validation

# largest number of random devices; the standard error of a mean is then 0.3 % of the scatter
_MAX_SAMPLES = 10**5
_NODES = {1: 17, 2: 9, 3: 5}  # nodes per constant, by the number of constants; 3 nodes for four or more constants


# Inclinations (beta, gamma) are excluded, because they are often zero and tolerances are relative.
SCATTERED = tuple(name for name in (*CONSTANTS, *ALIASES) if name not in LINEAR)
SCATTERED += tuple(f"{name}_{side}" for name in PER_WALL_CONSTANTS for side in SIDES)


@dataclass(frozen=True)
class Tolerance:
    """The scatter of a constant of the device about its nominal value.

    Attributes:
        name: Name of a constant of `Harvester`, for example omega0; another name of it, for example k; or the constant
            of one wall, for example omega0_left.
        spread: Relative spread, between 0 and 1: half width of a uniform distribution, or standard deviation of the
            logarithm for a log-normal distribution.
        kind: Distribution, "uniform" or "lognormal".

    Raises:
        ValueError: A field is invalid; the message states the field, the requirement and the value.
    """

    name: str
    spread: float
    kind: str = "uniform"

    def __post_init__(self) -> None:
        validation.validate_choice("name", self.name, SCATTERED)
        validation.validate_choice("kind", self.kind, ("uniform", "lognormal"))
        requirement = f"a number between 0 and 1, a part of {self.name}"
        object.__setattr__(
            self, "spread", validation.validate_real("spread", self.spread, requirement, lambda x: 0 < x < 1)
        )


def validate_tolerances(tolerances: Iterable[Tolerance], bounded: bool = False) -> tuple[Tolerance, ...]:
    """Return the tolerances, or raise ValueError if they are invalid.

    Args:
        tolerances: Tolerances of different constants.
        bounded: True if only uniform distributions are allowed, because a worst case needs bounded ones.
    """
    records = tuple(
        validation.validate_records(
            "tolerances", tolerances, Tolerance, "vijax.design.robustness.tolerance.Tolerance records"
        )
    )
    for tolerance in records:
        if bounded and tolerance.kind != "uniform":
            raise ValueError(f"tolerances of a worst case must be uniform; got {tolerance.kind} of {tolerance.name}")
    names = [tolerance.name for tolerance in records]
    # Two names of one constant, for example k and omega0, also raise the error.
    if len(set(map(constant, names))) < len(names):
        raise ValueError(f"tolerances must name a constant once; got {', '.join(names)}")
    return records


def validate_samples(samples: Any) -> int:
    """Return the number of random devices, or raise ValueError if it is invalid."""
    return validation.validate_integer("samples", samples, 1, _MAX_SAMPLES)


class Nodes(NamedTuple):
    """Names of scattered constants, factors on them [node, constant], weights [node]; node 0 is the nominal device."""

    names: tuple[str, ...]
    factors: np.ndarray
    weights: np.ndarray


def nodes(tolerances: tuple[Tolerance, ...], samples: int | None = None, seed: int = 0) -> Nodes:
    """Return the nodes of the joint distribution of tolerances.

    Args:
        tolerances: Tolerances; without any the nominal device is the only node.
        samples: Number of random devices with equal weights; by default quadrature nodes are used.
        seed: Seed of the random devices.

    Returns:
        The nominal device as node 0, with weight 0 unless it is the only node, then random devices or products of
        one-dimensional nodes. The rule is Clenshaw-Curtis for uniform constants, with nodes at both ends of the
        distribution, and Gauss-Hermite for log-normal constants.
    """
    tolerances = validate_tolerances(tolerances)
    seed = validation.validate_integer("seed", seed, 0, validation.MAX_SEED)
    names = tuple(tolerance.name for tolerance in tolerances)
    if not tolerances:
        return Nodes(names, np.ones((1, 0)), np.ones(1))
    if samples is not None:
        samples = validate_samples(samples)
        factors, weights = draw_devices(tolerances, samples, seed)[1], np.full(samples, 1 / samples)
    else:
        rules = [_rule(tolerance, _NODES.get(len(tolerances), 3)) for tolerance in tolerances]
        columns = [_to_factors(tolerance, x) for tolerance, (x, _) in zip(tolerances, rules, strict=True)]
        factors = np.array(list(itertools.product(*columns)))
        # Weights of a product rule are products of the one-dimensional weights.
        weights = np.array([np.prod(ws) for ws in itertools.product(*(w for _, w in rules))])
    return Nodes(names, np.vstack([np.ones(len(names)), factors]), np.append(0.0, weights))


class ToleranceStatistics(NamedTuple):
    """Statistics of P of a design over devices with constants scattered by tolerances.

    Attributes:
        mean: Mean P [J]; a device that loses the motion or is inadmissible counts as 0.
        worst: Smallest P [J]; a device that loses the motion counts as 0, an inadmissible one with its P.
        lost, inadmissible: Shares of the devices that lose the motion, and that keep it but break a limit.
    """

    mean: float
    worst: float
    lost: float
    inadmissible: float


def draw_devices(tolerances: tuple[Tolerance, ...], count: int, seed: int = 0) -> tuple[tuple[str, ...], np.ndarray]:
    """Draw random devices: names of the constants, and factors [device, constant]."""
    # One generator draws all constants in turn, so the factors of different constants are independent.
    draw = np.random.default_rng(seed)
    columns = [_to_factors(tolerance, _draw(tolerance, draw, count)) for tolerance in tolerances]
    return tuple(tolerance.name for tolerance in tolerances), np.stack(columns, axis=1)


def _to_factors(tolerance: Tolerance, x: np.ndarray) -> np.ndarray:
    """Return the factors on a constant for deviations x in units of the spread, which are nodes or random numbers."""
    # Uniform factors are linear in x; log-normal factors are exponential and stay positive.
    return 1 + tolerance.spread * x if tolerance.kind == "uniform" else np.exp(tolerance.spread * x)


def _draw(tolerance: Tolerance, generator: np.random.Generator, count: int) -> np.ndarray:
    """Draw random deviations of one constant in units of its spread."""
    return generator.uniform(-1, 1, count) if tolerance.kind == "uniform" else generator.standard_normal(count)


def _rule(tolerance: Tolerance, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return quadrature nodes of one constant in units of its spread, and their weights, which sum to 1."""
    if tolerance.kind == "lognormal":
        # Hermite rule for the weight exp(-x^2/2). Its weights sum to sqrt(2 pi), so they are divided by their sum.
        x, w = np.polynomial.hermite_e.hermegauss(count)
        return x, w / w.sum()
    x = np.cos(np.pi * np.arange(count) / (count - 1))
    # The weights reproduce the mean over [-1, 1] of every Chebyshev polynomial T_k with k < count. For even k this mean
    # is 1/(1 - k^2), for odd k it is 0.
    moments = [0.0 if k % 2 else 1 / (1 - k * k) for k in range(count)]
    return x, np.linalg.solve(np.polynomial.chebyshev.chebvander(x, count - 1).T, np.array(moments))
