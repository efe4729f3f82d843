"""The laws of membranes that are shipped beside the linear one: Hunt and Crossley's, and that of stretched rubber."""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from vijax.model.membrane import ShippedLaw
from vijax.model.pair import ImpactPair, Real
from vijax.runtime import checks
from vijax.runtime.arrays import Values


class Hertz(eqx.Module):
    """-kappa^2 w^n (1 + chi w') for w > 0, else 0."""

    square: Values
    chi: Values
    exponent: Values

    def __call__(self, w: Values, z: Values) -> Values:
        """Compute the acceleration at penetration w and rate z."""
        inside = w > 0  # a stage of a step may look beyond the exit
        spring = jnp.where(inside, jnp.where(inside, w, 1.0) ** self.exponent, 0.0)
        return -self.square * spring * (1 + self.chi * z)


class HuntCrossley(ShippedLaw):
    """Hunt and Crossley's membrane, w'' = -kappa^2 w^n (1 + chi w') + forcing: no restitution r is given to it.

    The loss grows with the speed, so that the restitution is a result: -v_out/v_in is near 1 - 2 chi v_in/3 for slow
    impacts, whatever n is.

    Attributes:
        chi: Damping over stiffness, in units of time over length (1/u'), >= 0.
        exponent: n >= 1; 1.5 is Hertz's contact of a sphere.

    Raises:
        ValueError: A number that cannot be (traced values are not looked at).
    """

    chi: Real
    exponent: Real = 1.5
    restitution: ClassVar[bool] = False

    def __check_init__(self):
        for name, least in (("chi", 0), ("exponent", 1)):
            value = getattr(self, name)
            if checks.is_concrete(value):
                must = f"one finite number of at least {least}"
                checks.real(name, value, must, lambda x, least=least: least <= x < math.inf)

    def wall(self, pair: ImpactPair) -> Hertz:
        """Give the law the numbers of a pair."""
        kappa = pair._soft_kappa()
        return Hertz(kappa * kappa, jnp.asarray(self.chi, kappa.dtype), jnp.asarray(self.exponent, kappa.dtype))

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Give what the membrane has stored at penetration w >= 0, per mass of the ball."""
        return pair._soft_kappa() ** 2 * jnp.asarray(w) ** (self.exponent + 1) / (self.exponent + 1)

    def __str__(self) -> str:
        """Name it as `--membrane` does."""
        return f"hunt-crossley with chi {float(self.chi):g}, exponent {float(self.exponent):g}"


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

    Attributes:
        prestretch: L > 1, of both directions, without the ball.
        radius: Of the membrane, > 0, in units of displacement.
        stretch_limit: Gent's J_m, > J at w = 0; inf for Mooney and Rivlin.

    Raises:
        ValueError: A number that cannot be (traced values are not looked at).
    """

    prestretch: Real
    radius: Real
    stretch_limit: Real = math.inf

    def __check_init__(self):
        for name, least in (("prestretch", 1), ("radius", 0)):
            value = getattr(self, name)
            if checks.is_concrete(value):
                must = f"one finite number above {least}"
                checks.real(name, value, must, lambda x, least=least: least < x < math.inf)
        if checks.is_concrete((self.prestretch, self.stretch_limit)):
            least = 2 * float(self.prestretch) ** 2 + float(self.prestretch) ** -4 - 3
            must = f"one number above {least:.4g}, which this prestretch takes"
            checks.real("stretch_limit", self.stretch_limit, must, lambda x: x > least)

    def wall(self, pair: ImpactPair) -> Cone:
        """Give the law the numbers of a pair."""
        kappa = pair._soft_kappa()
        square, radius, limit = (
            jnp.asarray(x, kappa.dtype) for x in (self.prestretch**2, self.radius, self.stretch_limit)
        )
        slack = square**-3
        rest = 1 - (2 * square + 1 / (square * square) - 3) / limit
        return Cone(kappa * kappa, pair.mu, radius, rest, slack, square / limit)

    def energy(self, pair: ImpactPair, w: Any) -> Any:
        """Give what the membrane has stored at penetration w, per mass of the ball."""
        return self.wall(pair).energy(jnp.asarray(w))

    def __str__(self) -> str:
        """Name it as `--membrane` does."""
        limit = f", stretch_limit {float(self.stretch_limit):g}" if self.stretch_limit != math.inf else ""
        return f"hyperelastic with prestretch {float(self.prestretch):g}, radius {float(self.radius):g}{limit}"
