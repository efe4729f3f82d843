"""A branch of periodic orbits as a path in the space of impact unknowns and one parameter.

The unknowns of a point are y = (onset time, speed into the wall, contact duration of each impact; parameter divided by
its range). The equations are the multiple-shooting equations of the orbit (`shooting`). Beyond a graze they still have
smooth solutions, but these are no real orbits: the ball cannot follow them. Smooth test functions along the branch mark
bifurcations and the ends of the real orbits:

    det(M - 1) = 1 - tr M + det M  vanishes where a Floquet multiplier is +1,
    det(M + 1) = 1 + tr M + det M  vanishes where a multiplier is -1,

with M the monodromy matrix (Kuznetsov, Elements of Applied Bifurcation Theory, chapter 10).
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vijax.continuation.arclength_step import PathEquations, PathPoints, generic_direction, predict_and_correct
from vijax.continuation.continuation_parameter import Values, set_parameter
from vijax.model.pair import ImpactPair
from vijax.orbits import clearances, multipliers, shooting
from vijax.orbits.shooting import Sequence
from vijax.runtime import tiles
from vijax.runtime.arrays import AnyArray


class BranchTests(NamedTuple):
    """Test functions of a branch: a change of sign marks an event. All from `speed` on are positive on real orbits."""

    fold: Float[Array, ""]  # d(parameter)/ds, divided by the least impact speed at a soft wall: a fold
    plus: Float[Array, ""]  # det(M - 1): a multiplier passes +1
    minus: Float[Array, ""]  # det(M + 1): a multiplier passes -1
    speed: Float[Array, ""]  # least speed into a wall: an impact vanishes
    flight: Float[Array, ""]  # least clearance at a turning point in flight: an impact appears
    contact: Float[Array, ""]  # least penetration at a turning point in contact: the contact splits in two
    exit: Float[Array, ""]  # least ratio of the speeds away from a wall and into it: the ball stays in contact
    low: Float[Array, ""]  # distances of the parameter to its bounds
    high: Float[Array, ""]


FOLD, PLUS = BranchTests._fields.index("fold"), BranchTests._fields.index("plus")
FIRST_END_TEST = BranchTests._fields.index("speed")


class BranchPath(eqx.Module):
    """The continuation problem of one branch.

    Attributes:
        pair: Parameters of the orbit at the start.
        sequence: Walls of its impacts.
        start: Value of the parameter at the start.
        vertical_gamma: g/A of the device, which is gamma of a vertical tube (used along "beta" only).
        low, high: Bounds of the parameter; the arclength counts the parameter in units of high - low.
        along: Name of the parameter.
        newton_tolerance, max_corrections: See `ContinuationSettings`. Static, because the compiled loop reads them
            before each correction.
    """

    test_names: ClassVar[tuple[str, ...]] = BranchTests._fields
    first_end: ClassVar[int] = FIRST_END_TEST

    pair: ImpactPair
    sequence: Sequence
    start: Values
    vertical_gamma: Values
    low: Values
    high: Values
    along: str = eqx.field(static=True)
    newton_tolerance: float = eqx.field(static=True)
    max_corrections: int = eqx.field(static=True)

    def at(self, x: Values) -> ImpactPair:
        """Return the pair at a value of the parameter."""
        return set_parameter(self.pair, self.along, x, self.start, self.vertical_gamma)

    def unpack(self, y):
        """Split points y, one or many along leading axes, into impact unknowns [impact, 3] and parameter value."""
        return y[..., :-1].reshape(*y.shape[:-1], -1, 3), y[..., -1] * (self.high - self.low)

    def pair_and_unknowns(self, y) -> tuple[ImpactPair, Float[AnyArray, "*orbit impact 3"]]:
        """Return the pair and the impact unknowns at one point y, or at many points along a leading axis."""
        impact_unknowns, x = self.unpack(y)
        return self.at(x), impact_unknowns

    def equations(self, y) -> PathEquations:
        """Compute the residual and its derivatives in the impact unknowns and the parameter."""
        impact_unknowns, x = self.unpack(y)
        # The unit of the parameter in y is its range, so that d(parameter)/dy = high - low.
        pair, pair_tangent = jax.jvp(self.at, (x,), (self.high - self.low,))
        residual, ring, *_ = shooting.linearise(pair, self.sequence, impact_unknowns, pair_tangent)
        return PathEquations(residual, jnp.zeros(0, y.dtype), ring)

    def tests(self, y, tangent, previous_tangent) -> BranchTests:
        """Compute the test functions at a point with its tangent; `previous_tangent` is not used."""
        impact_unknowns, x = self.unpack(y)
        pair = self.at(x)
        monodromy = multipliers.monodromy(pair, self.sequence, impact_unknowns)
        trace = monodromy[0, 0] + monodromy[1, 1]
        determinant = monodromy[0, 0] * monodromy[1, 1] - monodromy[0, 1] * monodromy[1, 0]
        clearance = clearances.interior_motion(pair, self.sequence, impact_unknowns).clearance
        # If an impact at a soft wall fades, the parameter changes as the square of its speed v. So d(parameter)/ds
        # vanishes as v at this graze, although there is no fold. Divided by the least speed, it does not vanish, and on
        # real orbits (v > 0) its sign is unchanged.
        soft = self.sequence.real & ~pair.is_rigid_at(self.sequence.side)
        return BranchTests(
            fold=tangent[-1] / jnp.where(soft, impact_unknowns[:, 1], 1.0).min(),
            plus=1 - trace + determinant,
            minus=1 + trace + determinant,
            speed=clearance.speed,
            flight=clearance.flight,
            contact=clearance.contact,
            exit=clearance.exit,
            low=x - self.low,
            high=self.high - x,
        )

    def count_events(self, before, after) -> Int[Array, ""]:
        """Count the events between two points; a fold and the multiplier that passes +1 at it are one event."""
        # Of the end tests only the first to change sign matters, so that all of them count as one event.
        changes = BranchTests(*(jnp.sign(before) * jnp.sign(after) < 0))
        events = [changes.fold | changes.plus, changes.minus, jnp.stack(changes[FIRST_END_TEST:]).any()]
        return jnp.stack(events).sum(dtype=jnp.int32)


def start_points(paths: BranchPath, y: np.ndarray) -> PathPoints:
    """Compute the start points of branches, one row each, with tangents along which the parameter increases.

    The tangent of a point is found by a step of length zero.
    """
    zero_length, parameter_direction = np.zeros(len(y)), np.zeros_like(y)
    # With the unit vector of the parameter as tangent and a step of length zero, Newton's method keeps the parameter
    # and corrects the orbit.
    parameter_direction[:, -1] = 1.0
    first = predict_and_correct(paths, y, parameter_direction, zero_length)
    lost = np.flatnonzero(~first.converged)
    if not lost.size:
        return first
    # At a fold the equations at a fixed parameter are singular. Correct normal to a generic direction instead, and
    # orient the tangent afterwards.
    corrected = predict_and_correct(paths, y, generic_direction(y), zero_length)
    corrected = orient(corrected, np.where(corrected.tangent[:, -1] < 0, -1.0, 1.0))
    return jax.tree.map(
        lambda leaf, replacement: tiles.with_replaced_rows(lost, leaf, replacement[lost]), first, corrected
    )


def orient(points: PathPoints, sign: float | np.ndarray) -> PathPoints:
    """Reverse the direction of points where the sign is negative; their fold test function changes sign, too."""
    tests = points.tests.copy()
    tests[:, FOLD] *= sign
    return points._replace(tangent=np.atleast_1d(sign)[:, None] * points.tangent, tests=tests)
