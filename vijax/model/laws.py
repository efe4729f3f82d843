"""The laws of membranes that are shipped beside the linear one: Hunt and Crossley's, and that of stretched rubber."""

import math
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from vijax.model import units
from vijax.model.device import Harvester, check_device
from vijax.model.membrane import ShippedLaw, checked_cell
from vijax.model.pair import ImpactPair, Real
from vijax.runtime import checks
from vijax.runtime.arrays import Values


def _number(quantity: str, value: Any, argument: str, must: str, holds: Callable[[float], bool]) -> Any:
    """Return a number of a law as a plain floating-point one; a traced number is not looked at."""
    value = units.plain(quantity, value, argument)
    return checks.real(argument, value, must, holds) if checks.is_concrete(value) else value


def _at_least(least: float, quantity: str, value: Any, argument: str) -> Any:
    must = f"one finite number of at least {least}"
    return _number(quantity, value, argument, must, lambda x: least <= x < math.inf)


def _above(least: float, quantity: str, value: Any, argument: str) -> Any:
    return _number(quantity, value, argument, f"one finite number above {least}", lambda x: least < x < math.inf)


class Hertz(eqx.Module):
    """-square w^n (1 + chi w') for w > 0, else 0."""

    square: Values
    chi: Values
    exponent: Values

    def __call__(self, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        inside = w > 0  # a stage of a step may look beyond the exit
        spring = jnp.where(inside, jnp.where(inside, w, 1.0) ** self.exponent, 0.0)
        return -self.square * spring * (1 + self.chi * z)


class HuntCrossley(ShippedLaw):
    """Hunt and Crossley's membrane, w'' = -kappa^2 w (w/depth)^(n-1) (1 + chi w') + forcing; it takes no restitution r.

    The loss grows with the speed, so that the restitution is a result: -v_out/v_in is near 1 - 2 chi v_in/3 for slow
    impacts, whatever n is.

    With a device, as in `sweep`, its numbers are in SI; with a pair, as in `trajectory`, they are in the units of the
    pair: `nondimensional` converts them.

    Attributes:
        chi: Damping over stiffness [s/m], >= 0.
        exponent: n >= 1; 1.5 is Hertz's contact of a sphere.
        depth: Penetration [m] at which a ball at rest feels the force of the linear membrane, > 0. At 1 m the stiffness
            k = m_b omega0^2 is the number of newtons per metre^n.

    Raises:
        ValueError: A number that cannot be (traced values are not looked at).
    """

    chi: Real
    exponent: Real = 1.5
    depth: Real = 1.0
    in_si: bool = eqx.field(static=True, init=False, default=False)
    restitution: ClassVar[bool] = False

    def __post_init__(self):
        self.in_si = checks.has_unit(self.chi) or checks.has_unit(self.depth)
        self.chi = _at_least(0, "damping", self.chi, "chi")
        self.exponent = _at_least(1, "exponent", self.exponent, "exponent")
        self.depth = _above(0, "length", self.depth, "depth")

    def in_units(self, length: Any, speed: Any) -> "HuntCrossley":
        """Return the law with its numbers in other units of length and speed."""
        return eqx.tree_at(lambda law: (law.chi, law.depth), self, (self.chi * speed, self.depth / length))

    def wall(self, pair: ImpactPair) -> Hertz:
        """Return the acceleration of a cell."""
        kappa = checked_cell(pair)[0]._soft_kappa()
        chi, exponent, depth = (jnp.asarray(x, kappa.dtype) for x in (self.chi, self.exponent, self.depth))
        return Hertz(kappa * kappa * depth ** (1 - exponent), chi, exponent)

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Return the energy stored at penetration w >= 0, per mass of the ball."""
        pair, w = checked_cell(pair, w)
        more = self.exponent + 1
        return pair._soft_kappa() ** 2 * self.depth ** (1 - self.exponent) * jnp.asarray(w) ** more / more

    def __str__(self) -> str:
        """Name it as `--membrane` does."""
        depth = f", depth {float(self.depth):g}" if self.depth != 1 else ""
        return f"hunt-crossley with chi {float(self.chi):g}, exponent {float(self.exponent):g}{depth}"


_STRAIGHT = 1e-9  # the least part of their limit that is left to chains: beyond, the push is held there


class Cone(eqx.Module):
    """The wall of a `Hyperelastic` membrane, a cone: -(kappa^2 w f(w) + mu w'), where f(0) = 1.

    Attributes:
        square, mu: Of the pair.
        radius: Of the membrane.
        rest: What is left at prestretch of how far the chains stretch, as a part of that.
        slack: prestretch^-6, the part of the tension that thinning takes at w = 0.
        spread: How much faster than (w/radius)^2 the chains are stretched, as a part of how far they do.
    """

    square: Values
    mu: Values
    radius: Values
    rest: Values
    slack: Values
    spread: Values

    def _stretched(self, w: Values) -> tuple[Values, Values]:
        """Compute (w/radius)^2, and how far the chains are stretched beyond prestretch, as a part of what is left."""
        more = (w / self.radius) ** 2
        return more, self.spread * more * (1 - self.slack / (1 + more)) / self.rest

    def __call__(self, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        more, used = self._stretched(w)
        tension = (1 - self.slack / (1 + more) ** 2) / (1 - self.slack)
        # Beyond the limit nothing goes: a stage of a step that looks there is thrown back.
        return -(self.square * w * tension / jnp.maximum(1 - used, _STRAIGHT) + self.mu * z)

    def energy(self, w: Values) -> Values:
        """Compute the stored energy, per mass of the ball."""
        more, used = self._stretched(w)
        some = used > 0
        part = jnp.where(some, used, 0.5)
        # -log(1 - x)/x, which is 1 without a limit.
        growth = jnp.where(some, -jnp.log1p(-part) / part, 1.0)
        linear = more * (1 - self.slack / (1 + more)) / (1 - self.slack)
        return 0.5 * self.square * self.radius**2 * linear * growth


class Hyperelastic(ShippedLaw):
    """A stretched circular membrane of rubber, which the ball makes a cone of; a spring at small w, stiffer at large.

    Its points move along the capsule alone, so that the hoops keep their prestretch L and the stretch along the cone is
    L sqrt(1 + (w/radius)^2); the volume stays. The force is the derivative of the elastic energy. With that of Mooney
    and Rivlin (Treloar, The Physics of Rubber Elasticity, 1975), of any ratio of its two constants,

        w'' = -kappa^2 w (1 - L^-6 (1 + (w/radius)^2)^-2) / (1 - L^-6) - mu w' + forcing,

    and with that of Gent (Rubber Chem. Technol. 69, 1996, 59-61) more, as its chains come to their limit:
    J = L^2 (1 + (w/radius)^2) + L^2 + L^-4/(1 + (w/radius)^2) - 3 stays below `stretch_limit`.

    kappa is the frequency at small w, and r the restitution of a free contact there. The ball is taken for a point.

    With a device, as in `sweep`, its radius is in metres; with a pair, as in `trajectory`, it is in the units of the
    pair: `nondimensional` converts it.

    Attributes:
        prestretch: L > 1, of both directions, without the ball.
        radius: Radius of the membrane [m], > 0; None for R0 of the device.
        stretch_limit: Gent's J_m, > J at w = 0; inf for Mooney and Rivlin.

    Raises:
        ValueError: A number that cannot be (traced values are not looked at).
    """

    prestretch: Real
    radius: Real | None = None
    stretch_limit: Real = math.inf
    in_si: bool = eqx.field(static=True, init=False, default=False)

    def __post_init__(self):
        self.in_si = self.radius is None or checks.has_unit(self.radius)
        self.prestretch = _above(1, "prestretch", self.prestretch, "prestretch")
        if self.radius is not None:
            self.radius = _above(0, "R0", self.radius, "radius")
        limit = checks.pure("stretch_limit", self.stretch_limit)
        if checks.is_concrete((self.prestretch, limit)):
            least = 2 * float(self.prestretch) ** 2 + float(self.prestretch) ** -4 - 3
            must = f"one number above {least:.4g}, which this prestretch takes"
            limit = checks.real("stretch_limit", limit, must, lambda x: x > least)
        self.stretch_limit = limit

    def of_device(self, device: Harvester) -> "Hyperelastic":
        """Return the law of a device, with the device's R0 for a radius that was not given."""
        R0 = check_device(device).R0
        radius: Any = R0 if self.radius is None else self.radius
        return Hyperelastic(self.prestretch, radius, self.stretch_limit)

    def in_units(self, length: Any, speed: Any) -> "Hyperelastic":
        """Return the law with its radius in another unit of length."""
        return eqx.tree_at(lambda law: law.radius, self, self._own_radius() / length)

    def _own_radius(self) -> Any:
        if self.radius is None:
            raise ValueError("radius must be given without a device; got None, which is R0 of a device")
        return self.radius

    def wall(self, pair: ImpactPair) -> Cone:
        """Return the acceleration of a cell."""
        kappa = checked_cell(pair)[0]._soft_kappa()
        square, radius, limit = (
            jnp.asarray(x, kappa.dtype) for x in (self.prestretch**2, self._own_radius(), self.stretch_limit)
        )
        slack = square**-3
        rest = 1 - (2 * square + 1 / (square * square) - 3) / limit
        return Cone(kappa * kappa, pair.mu, radius, rest, slack, square / limit)

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Give what the membrane has stored at penetration w, per mass of the ball."""
        pair, w = checked_cell(pair, w)
        return self.wall(pair).energy(jnp.asarray(w))

    def __str__(self) -> str:
        """Name it as `--membrane` does."""
        radius = "R0" if self.radius is None else f"{float(self.radius):g}"
        limit = f", stretch_limit {float(self.stretch_limit):g}" if self.stretch_limit != math.inf else ""
        return f"hyperelastic with prestretch {float(self.prestretch):g}, radius {radius}{limit}"
