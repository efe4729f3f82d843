"""The steady state on an attracting orbit, as a differentiable function of the device or of the pair.

The derivatives of the orbit by parameters p follow from the implicit function theorem on the shooting equations F(x, p)
= 0: dx/dp = -(dF/dx)^-1 dF/dp, where x contains three unknowns per impact. Elimination of all unknowns but one state
would give (I - DP) dx = dP/dp of the impact map P. If the orbit does not exist, passes through a wall or does not
attract, values and derivatives are NaN.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from vijax.model import energy, flow
from vijax.model.choices import Walls
from vijax.model.device import Harvester, check_scalar_constants
from vijax.model.forcing.waves import Waves
from vijax.model.pair import ImpactPair, check_single_cell
from vijax.model.records import Status, WithStatus
from vijax.model.walls.membrane import (
    Laws,
    Linear,
    check_laws,
    check_pair_units,
    describe_law,
    has_units,
    nondimensional,
    of_device,
    representative_law,
)
from vijax.model.walls.sides import at_wall
from vijax.orbits import contacts, shooting
from vijax.orbits.clearances import Clearance, InteriorMotion
from vijax.orbits.periodic import Orbit
from vijax.orbits.shooting import ContactExits, ImpactUnknowns, Sequence
from vijax.orbits.validity import Validity, validity
from vijax.runtime import validation
from vijax.runtime.compilation.xla import map_lanes
from vijax.runtime.doc_pages import see
from vijax.runtime.numerics import linear_solve
from vijax.runtime.numerics.derivatives import differentiable, materialise_with_slopes
from vijax.runtime.public_api import public_api

_MAPPED = "map several by jax.vmap"  # Remedy in errors about several devices or cells.


class Steady(WithStatus):
    """The steady state on an attracting periodic orbit, impact by impact, and its validity.

    Values are NaN, as are their derivatives, unless `status` is OK. Padded impacts hold 0 (`work`: inf).

    Attributes:
        P: Energy harvested per half forcing period [J].
        power: P omega/pi [W].
        speed: Largest speed into a wall [m/s].
        depth, energy, work: Largest penetration [m], harvested energy [J], and energy given to the membrane [J] of each
            impact.
        multiplier: Largest modulus of the Floquet multipliers of the full orbit.
        condition: Condition number of I - DP in the Frobenius norm, with the monodromy matrix DP.
        clearance: Distances of the orbit from grazing.
        residual: Largest absolute residual of the shooting equations.
        status: A `Status`; its `advice` names a remedy. OK; UNSTABLE: the orbit repels, or is at a bifurcation;
            VIRTUAL: the ball would hit a wall between two impacts; NO_ORBIT: Newton's method did not converge.
        left, right, period: Label of the orbit: impacts on either wall, and number of forcing periods.
        impact_unknowns: Unknowns of the impacts; see `shooting`.
    """

    P: Float[Array, ""]
    power: Float[Array, ""]
    speed: Float[Array, ""]
    depth: Float[Array, " impact"]
    energy: Float[Array, " impact"]
    work: Float[Array, " impact"]
    multiplier: Float[Array, ""]
    condition: Float[Array, ""]
    clearance: Clearance
    residual: Float[Array, ""]
    status: Int[Array, ""]
    left: Int[Array, ""]
    right: Int[Array, ""]
    period: Int[Array, ""]
    impact_unknowns: ImpactUnknowns


Out = Float[Array, "impact"]
"""Speed after each contact, away from the wall."""


@jax.custom_jvp
def _follows(
    pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns, out: Out
) -> tuple[ImpactUnknowns, Out]:
    """Return impact unknowns and exit speeds unchanged, with the derivatives that the equations of the orbit imply.

    Derivatives of any order are correct. Exit speeds are included because they are by-products of the equations.
    """
    return impact_unknowns, out


@_follows.defjvp
def _follows_jvp(primals, tangents):
    pair, sequence, impact_unknowns, out = primals
    # The rule calls `_follows` itself, so that second derivatives include the dependence of the unknowns on the pair.
    impact_unknowns, out = _follows(pair, sequence, impact_unknowns, out)

    def equations(pair):
        linear = shooting.linearise(pair, sequence, impact_unknowns)
        return (linear.residuals, linear.rate), (linear.slope, linear.rate_slope)

    _, (residuals, rate), (slope, rate_slope) = jax.jvp(equations, (pair,), (tangents[0],), has_aux=True)
    # Implicit function theorem: slope @ step = -dF/dp; `residuals` and `rate` are tangents here.
    step = -linear_solve.solve(slope, residuals).reshape(impact_unknowns.shape)
    return (impact_unknowns, out), (step, -rate - (rate_slope * step).sum(axis=1))


@public_api
def steady(device: Harvester, orbit: Orbit, *, pair: ImpactPair | None = None, membrane: Laws | None = None) -> Steady:
    """Find the steady state of a device near a known orbit; supports jit, vmap, grad, jacfwd and hessian.

    Args:
        device: The device, with scalar constants; traced inside a transformation of JAX.
        orbit: One element of a `periodic.Orbit` (`found[0]`) of the device or of a similar one. It specifies the walls
            of the impacts, and the guess for Newton's method. Parameters come from `device`, not from `orbit.pair`.
        pair: Nondimensional parameters d, kappa, r, gamma as independent variables. Default: the pair of the device.
            Its walls must be soft or rigid as in the orbit. If it has no harmonics, the harmonics of the orbit apply.
        membrane: Membrane law of the same class as in the orbit; its parameters may be traced. They are in units of
            `pair` if `pair` is specified, else in SI. Default: the law of `pair`, else the law of the orbit. If the law
            of the orbit has dimensional parameters and `pair` is None, the membrane must be specified.

    Returns:
        The steady state; NaN, with a `status` that gives the reason, if there is no attracting orbit.

    Raises:
        ValueError: With the argument, the requirement and the value.
    """
    _check(device, orbit, pair)
    law = _law(device, orbit, pair, membrane)
    if orbit.impact_unknowns.dtype != np.float64:
        raise ValueError(
            f"orbit must hold 64 bits; got {orbit.impact_unknowns.dtype}; take it as `vijax.orbits.periodic` found it"
        )
    # All numbers get one dtype, because every further dtype would compile a separate program.
    waves = orbit.pair.waves if pair is None or pair.waves is None else pair.waves
    arguments = jax.tree.map(lambda x: jnp.asarray(x, orbit.impact_unknowns.dtype), (device, pair, law, waves))
    return _near(arguments, (orbit.sequence, orbit.impact_unknowns), kind=orbit.pair.walls)


class VerifiedOrbit(NamedTuple):
    """An orbit, solved and verified before its properties are computed; its fields are constants under differentiation.

    Attributes:
        impact_unknowns: Unknowns of the impacts.
        out: Speed after each contact, away from the wall.
        residual: Largest absolute residual of the shooting equations.
        validity: Whether the solution is an attracting orbit, and the numbers that determine this.
    """

    impact_unknowns: ImpactUnknowns
    out: Out
    residual: Float[Array, ""]
    validity: Validity


SteadyArguments = tuple[Harvester, ImpactPair | None, Laws | None, Waves | None]
"""Arguments of a steady state: device, its pair if varied directly, membrane law and harmonics."""


def _pair_of(arguments: SteadyArguments, kind: Walls) -> ImpactPair:
    device, pair, law, waves = arguments
    if pair is None:
        pair = device.pair(kind)
        law = None if law is None else nondimensional(law, device)
    return replace(pair, law=law, waves=waves)


def _solve_and_verify(
    arguments: SteadyArguments, about: tuple[Sequence, ImpactUnknowns], *, kind: Walls
) -> VerifiedOrbit:
    """Solve for the orbit near a guess, and verify it."""
    (sequence, guess), pair = about, _pair_of(arguments, kind)
    return _verify_orbit(pair, sequence, *solve_orbit(pair, sequence, guess))


def _orbit_template(about: tuple[Sequence, ImpactUnknowns]) -> VerifiedOrbit:
    """Make a `VerifiedOrbit` with the shapes and dtypes of the solution near a guess."""
    # NumPy placeholders: only shapes and dtypes matter.
    guess: Any = np.asarray(about[1])
    zero: Any = np.zeros((), guess.dtype)
    status: Any = np.int32(Status.OK)
    motion = InteriorMotion(Clearance(zero, zero, zero, zero), guess[:, 0])
    return VerifiedOrbit(guess, guess[:, 0], zero, Validity(status, zero, zero, motion))


def _respond(
    arguments: SteadyArguments, about: tuple[Sequence, ImpactUnknowns], orbit: VerifiedOrbit, *, kind: Walls
) -> Steady:
    """Compute the steady state on a verified orbit."""
    return _steady_on_verified_orbit(arguments[0], _pair_of(arguments, kind), about[0], orbit)


# `differentiable` compiles the function, its derivatives and its batches once each, because JAX caches compiled
# programs by the identity of the function. A JAX loop over a batch around `_near` would be compiled at every call,
# because each call would create a new function as the body of the loop.
_near = differentiable(_respond, _solve_and_verify, _orbit_template)


def _check(device: Any, orbit: Any, pair: Any) -> None:
    """Raise ValueError unless these are records of the right kind; traced values are not inspected."""
    check_scalar_constants(device, _MAPPED)
    if not all(hasattr(orbit, name) for name in ("pair", "sequence", "impact_unknowns")):
        raise ValueError(
            f"orbit must be one of a vijax.orbits.periodic.Orbit; got {validation.value_text(orbit)}; take found[0]"
        )
    if jnp.ndim(orbit.impact_unknowns) != 2:
        raise ValueError(f"orbit must be a single one; got shape {jnp.shape(orbit.impact_unknowns)}; take found[0]")
    specified_pair = orbit.pair if pair is None else check_single_cell(pair, _MAPPED, of_orbit=True)
    # Rigid walls change the structure of the equations, so that the kinds must agree.
    walls = [(walled.rigid, walled.rigid_side) for walled in (specified_pair, orbit.pair)]
    if walls[0] != walls[1]:
        raise ValueError("pair must have walls of the orbit's kinds, soft or rigid; got others")


def _law(device: Harvester, orbit: Orbit, pair: ImpactPair | None, membrane: Any) -> Laws | None:
    """Return the specified membrane law, or the law of the pair or the orbit; None is the linear membrane."""
    if membrane is None:
        chosen_law: Any = orbit.pair.law if pair is None or pair.law is None else pair.law
        if pair is None and chosen_law is not None and has_units(chosen_law):
            raise ValueError(
                see(
                    "methods",
                    "membrane must be given, in SI units, where device moves; got none, and those of the orbit "
                    f"are {describe_law(chosen_law)} in units of its pair",
                )
            )
        return chosen_law
    orbit_law: Any = Linear() if orbit.pair.law is None else orbit.pair.law
    kind, orbit_kind = (type(representative_law(law)) for law in (check_laws(membrane), orbit_law))
    if kind is not orbit_kind:
        raise ValueError(
            see("methods", f"membrane must be of the orbit's kind, {orbit_kind.__name__}; got {kind.__name__}")
        )
    if kind is Linear:
        return None
    return of_device(membrane, device) if pair is None else check_pair_units(membrane)


def solve_orbit(pair: ImpactPair, sequence: Sequence, guess: ImpactUnknowns) -> shooting.Solution:
    """Solve for the orbit near a guess by Newton's method; the result is a constant under differentiation."""
    # Derivatives come from `_follows`; Newton's iterations are not differentiated.
    batch = jax.tree.map(lambda x: lax.stop_gradient(x)[None], (pair, sequence, guess))
    return jax.tree.map(lambda x: lax.stop_gradient(x[0]), shooting.newton(*batch))


def _verify_orbit(
    pair: ImpactPair,
    sequence: Sequence,
    impact_unknowns: ImpactUnknowns,
    residual: Float[Array, ""],
    exits: ContactExits | None = None,
) -> VerifiedOrbit:
    """Verify the orbit with these impact unknowns; the result is a constant under differentiation."""
    inputs = pair, sequence, impact_unknowns, residual, exits
    pair, sequence, impact_unknowns, residual, exits = jax.tree.map(lax.stop_gradient, inputs)
    contact_exits = shooting.contact_exits(pair, sequence, impact_unknowns) if exits is None else exits
    return VerifiedOrbit(
        impact_unknowns,
        contact_exits.speed,
        residual,
        validity(pair, sequence, impact_unknowns, residual, contact_exits),
    )


def steady_on_orbit(
    device: Harvester, pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns, residual: Float[Array, ""]
) -> Steady:
    """Compute the steady state on the orbit with these impact unknowns.

    Derivatives include the dependence of the impact unknowns on device and pair.
    """
    return _steady_on_verified_orbit(device, pair, sequence, _verify_orbit(pair, sequence, impact_unknowns, residual))


def _steady_on_verified_orbit(device: Harvester, pair: ImpactPair, sequence: Sequence, orbit: VerifiedOrbit) -> Steady:
    impact_unknowns, out, residual, (status, multiplier, condition, (clearance, deepest)) = orbit
    # If there is no orbit, finite placeholders keep NaN out of the computation; `valid` masks the results.
    absent = (status == Status.NO_ORBIT) | ~sequence.real
    impact_unknowns = jnp.where(absent[:, None], jnp.array(_HARMLESS, impact_unknowns.dtype), impact_unknowns)
    impact_unknowns, out = materialise_with_slopes(
        _follows(pair, sequence, impact_unknowns, jnp.where(absent, 1.0, out))
    )
    # A factor of NaN also makes the derivatives NaN.
    valid = jnp.where(status == Status.OK, 1.0, jnp.nan)
    depth, harvested, work = (valid * x for x in impact_energies(device, pair, sequence, impact_unknowns, out, deepest))
    # If half of a symmetric orbit is stored, each impact alternates with its mirror image at the other wall, where the
    # harvested energy may differ.
    mean = (
        0.5 * (harvested + image_energy(device, sequence, depth, harvested)) if device.has_unequal_walls else harvested
    )
    # The span counts half forcing periods: P is the energy per half period, Eq. (36) corrected.
    P = jnp.where(sequence.real, mean, 0.0).sum() / sequence.span
    left, right = ((sequence.side == wall).sum(dtype=jnp.int32) for wall in (-1, 1))
    # If half of a symmetric orbit is stored, its mirror image follows, so that each wall has the impacts of both.
    left, right = (jnp.where(sequence.mirrored, left + right, side) for side in (left, right))
    return Steady(
        P=P,
        power=P * device.omega / flow.PI,
        speed=valid * jnp.where(sequence.real, impact_unknowns[:, 1], 0.0).max() * device.speed_unit,
        depth=depth,
        energy=harvested,
        work=work,
        multiplier=multiplier,
        condition=condition,
        clearance=clearance,
        residual=residual,
        status=status,
        left=left,
        right=right,
        period=jnp.round(sequence.span * jnp.where(sequence.mirrored, 1.0, 0.5)).astype(jnp.int32),
        impact_unknowns=impact_unknowns,
    )


_HARMLESS = (0.0, 1.0, 0.5)  # onset time, speed and contact duration


def impact_energies(
    device: Harvester, pair: ImpactPair, sequence: Sequence, impact_unknowns: ImpactUnknowns, out: Out, deepest
):
    """Compute depth [m], harvested energy [J] and energy given to the membrane [J] of every impact.

    Padded impacts have depth 0, energy 0 and infinite work. `materialise_with_slopes` shares derivatives between the
    three results, which halves the code that XLA compiles; XLA would otherwise compute them for each result.
    """
    real, side = sequence.real, jnp.where(sequence.real, sequence.side, 1)
    wall, _, joined = shooting.joined_unknowns(sequence, impact_unknowns)
    depth_and_work = map_lanes(partial(contacts.depth_and_work, pair))(
        wall, joined[:, :3], -wall * out, jnp.nan_to_num(deepest)
    )
    depth, work = materialise_with_slopes(depth_and_work)
    if pair.rigid:
        depth = depth * device.omega / (flow.PI * at_wall(device.omega0, side))
    depth = jnp.where(real, depth, 0.0) * device.length_unit
    work = jnp.where(real, work, jnp.inf) * (device.m_b * device.speed_unit**2)
    return depth, energy.harvested_energy(device.at(side), depth), work


def image_energy(device: Harvester, sequence: Sequence, depth, harvested) -> Float[Array, " impact"]:
    """Compute the energy harvested by the mirror image of each impact, at the other wall.

    If half of a symmetric orbit is stored (`mirrored`), the images are its other half. For a full orbit, which needs no
    images, the result is the energy of the impact itself.
    """
    other_wall = energy.harvested_energy(device.at(-sequence.side), depth)
    return jnp.where(sequence.mirrored, other_wall, harvested)
