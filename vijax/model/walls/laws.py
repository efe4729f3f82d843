"""Nonlinear membrane laws of vijax: Hunt and Crossley's contact law, and a stretched hyperelastic rubber membrane.

    Hunt-Crossley:  w'' = -kappa^2 w (w/depth)^(n-1) (1 + chi w') + forcing
    hyperelastic:   w'' = -kappa^2 w f(w) - mu w' + forcing, f(0) = 1, Mooney-Rivlin or Gent

w is the penetration, w' its rate. The numbers of a law are in SI units if the law is used with a device, and in the
units of the pair if it is used with a pair.
"""

import math
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from vijax.model import units
from vijax.model.device import Harvester, check_device
from vijax.model.pair import ImpactPair, Real
from vijax.model.walls.membrane import ShippedLaw, checked_cell
from vijax.runtime import validation
from vijax.runtime.arrays import Values


def _number(quantity: str, value: Any, argument: str, must: str, holds: Callable[[float], bool]) -> Any:
    """Return a number of a law as a plain float; a traced number is not checked."""
    value = units.plain_number(quantity, value, argument)
    return validation.validate_real(argument, value, must, holds) if validation.is_concrete(value) else value


def _at_least(least: float, quantity: str, value: Any, argument: str) -> Any:
    must = f"one finite number of at least {least}"
    return _number(quantity, value, argument, must, lambda x: least <= x < math.inf)


def _above(least: float, quantity: str, value: Any, argument: str) -> Any:
    return _number(quantity, value, argument, f"one finite number above {least}", lambda x: least < x < math.inf)


class Hertz(eqx.Module):
    """Acceleration by a `HuntCrossley` membrane: -square w^n (1 + chi w') for w > 0, else 0."""

    # square = kappa^2 depth^(1 - n), chi = damping over stiffness, exponent = n.
    square: Values
    chi: Values
    exponent: Values

    def __call__(self, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        # A stage of a Runge-Kutta step may lie beyond the exit, w < 0, where the power is not real; 1 then replaces w.
        inside = w > 0
        spring = jnp.where(inside, jnp.where(inside, w, 1.0) ** self.exponent, 0.0)
        return -self.square * spring * (1 + self.chi * z)


class HuntCrossley(ShippedLaw):
    """Hunt and Crossley's membrane, w'' = -kappa^2 w (w/depth)^(n-1) (1 + chi w') + forcing; it has no restitution r.

    The loss grows with the speed, so the restitution is a result: -v_out/v_in is near 1 - 2 chi v_in/3 for slow
    impacts, for every n.

    With a device, as in `sweep`, its numbers are in SI; with a pair, as in `trajectory`, they are in the units of the
    pair: `nondimensional` converts them.

    Attributes:
        chi: Damping over stiffness [s/m], >= 0.
        exponent: n >= 1; 1.5 is Hertz's contact of a sphere.
        depth: Penetration [m] where the static force equals the force of the linear membrane, > 0. With depth = 1 m,
            the stiffness k = m_b omega0^2 is the number of newtons per metre^n.

    Raises:
        ValueError: If a number is out of its range (traced values are not checked).
    """

    chi: Real
    exponent: Real = 1.5
    depth: Real = 1.0
    # True if a number has a unit or comes from the device: such a law is not in the units of a pair.
    in_si: bool = eqx.field(static=True, init=False, default=False)
    restitution: ClassVar[bool] = False

    def __post_init__(self):
        self.in_si = validation.has_unit(self.chi) or validation.has_unit(self.depth)
        self.chi = _at_least(0, "damping", self.chi, "chi")
        self.exponent = _at_least(1, "exponent", self.exponent, "exponent")
        self.depth = _above(0, "length", self.depth, "depth")

    def in_units(self, length: Any, speed: Any) -> "HuntCrossley":
        """Return the law with its numbers in other units of length and speed."""
        # chi is time over length, an inverse speed; the exponent has no unit.
        return eqx.tree_at(lambda law: (law.chi, law.depth), self, (self.chi * speed, self.depth / length))

    def bind(self, pair: ImpactPair) -> Hertz:
        """Return the acceleration of a cell."""
        kappa = checked_cell(pair)[0]._soft_kappa()
        chi, exponent, depth = (jnp.asarray(x, kappa.dtype) for x in (self.chi, self.exponent, self.depth))
        return Hertz(kappa * kappa * depth ** (1 - exponent), chi, exponent)

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Return the energy stored at penetration w >= 0, per mass of the ball."""
        pair, w = checked_cell(pair, w)
        # Integral of kappa^2 depth^(1-n) w^n.
        power = self.exponent + 1
        return pair._soft_kappa() ** 2 * self.depth ** (1 - self.exponent) * jnp.asarray(w) ** power / power

    def __str__(self) -> str:
        """Return the name of the law as in the option `--membrane`, with the values of its parameters."""
        depth = f", depth {float(self.depth):g}" if self.depth != 1 else ""
        return f"hunt-crossley with chi {float(self.chi):g}, exponent {float(self.exponent):g}{depth}"


# Least remaining fraction of the extensibility of the chains. Beyond it the stiffening factor is constant, so that a
# Runge-Kutta stage outside of the limit remains finite.
_LEAST_REST = 1e-9


class Cone(eqx.Module):
    """Acceleration by a `Hyperelastic` membrane, shaped as a cone: -(kappa^2 w f(w) + mu w'), where f(0) = 1.

    Below, L is the prestretch, x = (w/radius)^2, and J(x) Gent's measure of stretch, which stays below its limit J_m
    (see `Hyperelastic`).

    Attributes:
        square, mu: kappa^2 and damping of the pair.
        radius: Radius of the membrane.
        rest: 1 - J(0)/J_m, the fraction of the limit that the prestretch leaves for the deformation by the ball.
        slack: L^-6, the fraction by which the tension at w = 0 is reduced because the stretched membrane is thinner.
        spread: L^2/J_m, so that (J(x) - J(0))/J_m = spread x (1 - slack/(1 + x)).
    """

    square: Values
    mu: Values
    radius: Values
    rest: Values
    slack: Values
    spread: Values

    def _stretch(self, w: Values) -> tuple[Values, Values]:
        """Compute x = (w/radius)^2 and the used fraction (J(x) - J(0))/(J_m - J(0)) of the remaining stretch."""
        x = (w / self.radius) ** 2
        return x, self.spread * x * (1 - self.slack / (1 + x)) / self.rest

    def __call__(self, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        x, used = self._stretch(w)
        # f(w) without the limit of the chains: the Mooney-Rivlin tension, scaled to 1 at w = 0.
        tension = (1 - self.slack / (1 + x) ** 2) / (1 - self.slack)
        # No motion reaches the limit of Gent's law. The floor keeps a Runge-Kutta stage beyond the limit finite.
        return -(self.square * w * tension / jnp.maximum(1 - used, _LEAST_REST) + self.mu * z)

    def energy(self, w: Values) -> Values:
        """Compute the stored energy, per mass of the ball."""
        x, used = self._stretch(w)
        positive = used > 0
        fraction = jnp.where(positive, used, 0.5)
        # Gent's factor -log(1 - f)/f of the used fraction f, which tends to 1 without a limit.
        growth = jnp.where(positive, -jnp.log1p(-fraction) / fraction, 1.0)
        # Mooney-Rivlin part: integral of the tension over the penetration, scaled.
        linear = x * (1 - self.slack / (1 + x)) / (1 - self.slack)
        return 0.5 * self.square * self.radius**2 * linear * growth


class Hyperelastic(ShippedLaw):
    """A stretched circular membrane of rubber that the ball deforms to a cone; linear at small w, stiffer at large w.

    Its points move along the capsule only, so that the hoop stretch remains the prestretch L and the stretch along the
    cone is L sqrt(1 + (w/radius)^2); the volume is constant. The force is the derivative of the elastic energy. With
    the energy of Mooney and Rivlin (Treloar, The Physics of Rubber Elasticity, 1975), for any ratio of its two
    constants,

        w'' = -kappa^2 w (1 - L^-6 (1 + (w/radius)^2)^-2) / (1 - L^-6) - mu w' + forcing.

    With the energy of Gent (Rubber Chem. Technol. 69, 1996, 59-61) the force is larger, as the chains approach their
    limit: J = L^2 (1 + (w/radius)^2) + L^2 + L^-4/(1 + (w/radius)^2) - 3 stays below `stretch_limit`.

    kappa is the frequency at small w, and r the restitution of a contact without forcing at small w. The ball is
    treated as a point.

    With a device, as in `sweep`, its radius is in metres; with a pair, as in `trajectory`, it is in the units of the
    pair: `nondimensional` converts it.

    Attributes:
        prestretch: L > 1, in both directions, without the ball.
        radius: Radius of the membrane [m], > 0; None for R0 of the device.
        stretch_limit: Gent's J_m, > J at w = 0; inf for Mooney and Rivlin.

    Raises:
        ValueError: If a number is out of its range (traced values are not checked).
    """

    prestretch: Real
    radius: Real | None = None
    stretch_limit: Real = math.inf
    # True if a number has a unit or comes from the device: such a law is not in the units of a pair.
    in_si: bool = eqx.field(static=True, init=False, default=False)

    def __post_init__(self):
        # A missing radius is R0 of the device, in metres.
        self.in_si = self.radius is None or validation.has_unit(self.radius)
        self.prestretch = _above(1, "prestretch", self.prestretch, "prestretch")
        if self.radius is not None:
            self.radius = _above(0, "R0", self.radius, "radius")
        # J is a pure number, hence no unit is accepted.
        limit = validation.without_unit("stretch_limit", self.stretch_limit)
        if validation.is_concrete((self.prestretch, limit)):
            # J at w = 0: the prestretch alone must stay below the limit.
            least = 2 * float(self.prestretch) ** 2 + float(self.prestretch) ** -4 - 3
            must = f"one number above {least:.4g}, which this prestretch takes"
            limit = validation.validate_real("stretch_limit", limit, must, lambda x: x > least)
        self.stretch_limit = limit

    def of_device(self, device: Harvester) -> "Hyperelastic":
        """Return the law of a device, with the device's R0 as radius if none is specified."""
        R0 = check_device(device).R0
        radius: Any = R0 if self.radius is None else self.radius
        return Hyperelastic(self.prestretch, radius, self.stretch_limit)

    def in_units(self, length: Any, speed: Any) -> "Hyperelastic":
        """Return the law with its radius in another unit of length."""
        return eqx.tree_at(lambda law: law.radius, self, self._specified_radius() / length)

    def _specified_radius(self) -> Any:
        if self.radius is None:
            raise ValueError("radius must be given without a device; got None, which is R0 of a device")
        return self.radius

    def bind(self, pair: ImpactPair) -> Cone:
        """Return the acceleration of a cell."""
        kappa = checked_cell(pair)[0]._soft_kappa()
        square, radius, limit = (
            jnp.asarray(x, kappa.dtype) for x in (self.prestretch**2, self._specified_radius(), self.stretch_limit)
        )
        # square = L^2; rest = 1 - J(0)/J_m.
        slack = square**-3
        rest = 1 - (2 * square + 1 / (square * square) - 3) / limit
        return Cone(kappa * kappa, pair.mu, radius, rest, slack, square / limit)

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Return the energy stored at penetration w, per mass of the ball."""
        pair, w = checked_cell(pair, w)
        return self.bind(pair).energy(jnp.asarray(w))

    def __str__(self) -> str:
        """Return the name that `--membrane` uses, with the numbers."""
        radius = "R0" if self.radius is None else f"{float(self.radius):g}"
        limit = f", stretch_limit {float(self.stretch_limit):g}" if self.stretch_limit != math.inf else ""
        return f"hyperelastic with prestretch {float(self.prestretch):g}, radius {radius}{limit}"
