"""The steady state that an attracting orbit keeps up, as a differentiable function of the device or of the pair.

The orbit follows its parameters by the implicit function theorem on the shooting equations, (I - DP) dx = dP/dp
with every impact's own unknowns kept. Where that derivative means nothing, values and derivatives are NaN.
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
from vijax.model.device import Harvester, check_each_constant
from vijax.model.membrane import Laws, Linear, check_laws, has_units, nondimensional, of_device, of_pair, one_of, said
from vijax.model.pair import ImpactPair, check_one_pair
from vijax.model.records import Status, WithStatus
from vijax.model.sides import at
from vijax.model.waves import Waves
from vijax.orbits import contacts, shooting
from vijax.orbits.grazing import Between, Clearance
from vijax.orbits.periodic import Orbit
from vijax.orbits.shooting import Departure, Knots, Sequence
from vijax.orbits.validity import Validity, validity
from vijax.runtime import checks, linear_solve
from vijax.runtime.context import door
from vijax.runtime.derivatives import differentiable, shared_slopes
from vijax.runtime.pages import see
from vijax.runtime.xla import each

_MAPPED = "map several by jax.vmap"  # What an error says to do about several devices or cells.


class Steady(WithStatus):
    """What an attracting periodic orbit yields, impact by impact, and how far that can be trusted.

    Values are NaN, as are their derivatives, unless `status` is OK. Padded impacts hold 0 (`work`: inf).

    Attributes:
        P: Energy harvested per half forcing period [J].
        power: P omega/pi [W].
        speed: Largest speed into a wall [m/s].
        depth, energy, work: Largest penetration [m], harvested energy [J], and energy given to the membrane [J] of each
            impact.
        multiplier: Largest modulus of the Floquet multipliers of the full orbit.
        condition: Condition number of I - DP, Frobenius.
        clearance: How far the orbit is from grazing.
        residual: Largest violation of the equations.
        status: A `Status`, whose `advice` says what to do. OK; UNSTABLE: it repels, or is at a bifurcation;
            VIRTUAL: the ball would meet a wall in between; NO_ORBIT: Newton found none.
        left, right, period: Label of the orbit: impacts on either wall, in so many forcing periods.
        knots: The orbit; see `shooting`.
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
    knots: Knots


Out = Float[Array, "impact"]
"""Speed after each contact, away from the wall."""


@jax.custom_jvp
def _follows(pair: ImpactPair, sequence: Sequence, knots: Knots, out: Out) -> tuple[Knots, Out]:
    """Make an orbit a function of the pair by its equations: values unchanged, derivatives of any order right.

    Speeds after contacts move with it, as what the equations are made of holds them.
    """
    return knots, out


@_follows.defjvp
def _follows_jvp(primals, tangents):
    pair, sequence, knots, out = primals
    # The rule calls itself on the knots, so that second derivatives see them move too.
    knots, out = _follows(pair, sequence, knots, out)

    def equations(pair):
        linear = shooting.linearise(pair, sequence, knots)
        return (linear.gap, linear.rate), (linear.slope, linear.rate_slope)

    _, (gap, rate), (slope, rate_slope) = jax.jvp(equations, (pair,), (tangents[0],), has_aux=True)
    step = -linear_solve.solve(slope, gap).reshape(knots.shape)
    return (knots, out), (step, -rate - (rate_slope * step).sum(axis=1))


@door
def steady(device: Harvester, orbit: Orbit, *, pair: ImpactPair | None = None, membrane: Laws | None = None) -> Steady:
    """Find the steady state of a device near a known orbit; under jit, vmap, grad (both modes) and hessian.

    Args:
        device: Constants, scalars; those under differentiation traced.
        orbit: One element of a `periodic.Orbit` (`found[0]`) of the device or of a near one: its walls, and
            where Newton begins. Values come from `device`, not from `orbit.pair`.
        pair: d, kappa, r, gamma to move directly; those of the device unless given. Its wall is the orbit's. What
            shakes it is what shakes the orbit, unless it has harmonics of its own.
        membrane: Numbers of the membrane to move, of the orbit's kind; with `pair` in its units, else in SI. Those of
            the orbit unless given, which are in the units of the orbit's pair: numbers with a dimension must be given
            where `pair` is not.

    Returns:
        The record; NaN with a `status` where there is no attracting orbit.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    _check(device, orbit, pair)
    law = _law(device, orbit, pair, membrane)
    if orbit.knots.dtype != np.float64:
        raise ValueError(
            f"orbit must hold 64 bits; got {orbit.knots.dtype}; take it as `vijax.orbits.periodic` found it"
        )
    # Numbers of one kind, however they are given: each kind would be a program of its own.
    waves = orbit.pair.waves if pair is None or pair.waves is None else pair.waves
    moved = jax.tree.map(lambda x: jnp.asarray(x, orbit.knots.dtype), (device, pair, law, waves))
    return _near(moved, (orbit.sequence, orbit.knots), kind=orbit.pair.walls)


class Found(NamedTuple):
    """An orbit, which is found and judged before anything is computed of it: constants of differentiation.

    Attributes:
        knots: Of the orbit.
        out: Speed after each contact, away from the wall.
        residual: Largest violation of the equations.
        validity: Whether it is one that attracts, and by how much.
    """

    knots: Knots
    out: Out
    residual: Float[Array, ""]
    validity: Validity


Moved = tuple[Harvester, ImpactPair | None, Laws | None, Waves | None]
"""What a steady state is a function of: a device, its pair where that is moved directly, membrane and harmonics."""


def _pair_of(moved: Moved, kind: Walls) -> ImpactPair:
    device, pair, law, waves = moved
    if pair is None:
        pair = device.pair(kind)
        law = None if law is None else nondimensional(law, device)
    return replace(pair, law=law, waves=waves)


def _found(moved: Moved, about: tuple[Sequence, Knots], *, kind: Walls) -> Found:
    """Find the orbit near a guess."""
    (sequence, guess), pair = about, _pair_of(moved, kind)
    return _judged(pair, sequence, *find(pair, sequence, guess))


def _like_found(about: tuple[Sequence, Knots]) -> Found:
    """Make what has the shapes of an orbit that is found near a guess."""
    guess: Any = np.asarray(about[1])
    zero: Any = np.zeros((), guess.dtype)
    status: Any = np.int32(Status.OK)
    motion = Between(Clearance(zero, zero, zero, zero), guess[:, 0])
    return Found(guess, guess[:, 0], zero, Validity(status, zero, zero, motion))


def _respond(moved: Moved, about: tuple[Sequence, Knots], found: Found, *, kind: Walls) -> Steady:
    """Compute what the orbit yields that was found."""
    return _response(moved[0], _pair_of(moved, kind), about[0], found)


# Compiled once, and so are its derivatives and batches: as one call it is known by its identity, while loops run one by
# one would be compiled for every call, as each makes their bodies anew.
_near = differentiable(_respond, _found, _like_found)


def _check(device: Any, orbit: Any, pair: Any) -> None:
    """Raise ValueError unless these are records of the right kind; what is traced passes unseen."""
    check_each_constant(device, _MAPPED)
    if not all(hasattr(orbit, name) for name in ("pair", "sequence", "knots")):
        raise ValueError(
            f"orbit must be one of a vijax.orbits.periodic.Orbit; got {checks.shown(orbit)}; take found[0]"
        )
    if jnp.ndim(orbit.knots) != 2:
        raise ValueError(f"orbit must be a single one; got knots of shape {jnp.shape(orbit.knots)}; take found[0]")
    own = orbit.pair if pair is None else check_one_pair(pair, _MAPPED, of_orbit=True)
    walls = [(one.rigid, one.hard_wall) for one in (own, orbit.pair)]
    if walls[0] != walls[1]:
        raise ValueError("pair must have the walls of the orbit, soft or rigid; got the others")


def _law(device: Harvester, orbit: Orbit, pair: ImpactPair | None, membrane: Any) -> Laws | None:
    """Return the membrane that is given, or that of the pair or the orbit; None is the linear one."""
    if membrane is None:
        own: Any = orbit.pair.law if pair is None or pair.law is None else pair.law
        if pair is None and own is not None and has_units(own):
            raise ValueError(
                see(
                    "methods",
                    "membrane must be given, in SI units, where device moves; got none, and those of the orbit "
                    f"are {said(own)} in units of its pair",
                )
            )
        return own
    known_law: Any = Linear() if orbit.pair.law is None else orbit.pair.law
    given, known = (type(one_of(law)) for law in (check_laws(membrane), known_law))
    if given is not known:
        raise ValueError(
            see("methods", f"membrane must be of the orbit's kind, {known.__name__}; got {given.__name__}")
        )
    if given is Linear:
        return None
    return of_device(membrane, device) if pair is None else of_pair(membrane)


def find(pair: ImpactPair, sequence: Sequence, guess: Knots) -> shooting.Solution:
    """Find the orbit near a guess, a constant of differentiation."""
    batch = jax.tree.map(lambda x: lax.stop_gradient(x)[None], (pair, sequence, guess))
    return jax.tree.map(lambda x: lax.stop_gradient(x[0]), shooting.newton(*batch))


def _judged(
    pair: ImpactPair, sequence: Sequence, knots: Knots, residual: Float[Array, ""], departure: Departure | None = None
) -> Found:
    """Judge the orbit with the given knots, a constant of differentiation."""
    given = pair, sequence, knots, residual, departure
    pair, sequence, knots, residual, departure = jax.tree.map(lax.stop_gradient, given)
    leaves = shooting.departures(pair, sequence, knots) if departure is None else departure
    return Found(knots, leaves.speed, residual, validity(pair, sequence, knots, residual, leaves))


def response(
    device: Harvester, pair: ImpactPair, sequence: Sequence, knots: Knots, residual: Float[Array, ""]
) -> Steady:
    """Compute what the orbit with the given knots yields; these follow device and pair under differentiation."""
    return _response(device, pair, sequence, _judged(pair, sequence, knots, residual))


def _response(device: Harvester, pair: ImpactPair, sequence: Sequence, found: Found) -> Steady:
    knots, out, residual, (status, multiplier, condition, (room, deepest)) = found
    # Harmless numbers where there is no orbit: what is computed from them is thrown away.
    absent = (status == Status.NO_ORBIT) | ~sequence.real
    knots = jnp.where(absent[:, None], jnp.array(_HARMLESS, knots.dtype), knots)
    knots, out = shared_slopes(_follows(pair, sequence, knots, jnp.where(absent, 1.0, out)))
    valid = jnp.where(status == Status.OK, 1.0, jnp.nan)
    depth, harvested, work = (valid * x for x in yields(device, pair, sequence, knots, out, deepest))
    mean = 0.5 * (harvested + image_energy(device, sequence, depth, harvested)) if device.unequal else harvested
    P = jnp.where(sequence.real, mean, 0.0).sum() / sequence.span
    left, right = ((sequence.side == wall).sum(dtype=jnp.int32) for wall in (-1, 1))
    # Closed half way, the mirror image of the orbit is the rest of it.
    left, right = (jnp.where(sequence.mirrored, left + right, side) for side in (left, right))
    return Steady(
        P=P,
        power=P * device.omega / flow.PI,
        speed=valid * jnp.where(sequence.real, knots[:, 1], 0.0).max() * device.speed_unit,
        depth=depth,
        energy=harvested,
        work=work,
        multiplier=multiplier,
        condition=condition,
        clearance=room,
        residual=residual,
        status=status,
        left=left,
        right=right,
        period=jnp.round(sequence.span * jnp.where(sequence.mirrored, 1.0, 0.5)).astype(jnp.int32),
        knots=knots,
    )


_HARMLESS = (0.0, 1.0, 0.5)  # a knot


def yields(device: Harvester, pair: ImpactPair, sequence: Sequence, knots: Knots, out: Out, deepest):
    """Compute depth [m], harvested energy [J] and energy given to the membrane [J] of every impact.

    Padded impacts have none of the first two and infinitely much of the last.
    Where several results need a derivative XLA would compute it for each of them: sharing them halves what it compiles.
    """
    real, side = sequence.real, jnp.where(sequence.real, sequence.side, 1)
    wall, _, joined = shooting.joined_knots(sequence, knots)
    given = each(partial(contacts.given, pair))(wall, joined[:, :3], -wall * out, jnp.nan_to_num(deepest))
    depth, work = shared_slopes(given)
    if pair.rigid:
        depth = depth * device.omega / (flow.PI * at(device.omega0, side))
    depth = jnp.where(real, depth, 0.0) * device.length_unit
    work = jnp.where(real, work, jnp.inf) * (device.m_b * device.speed_unit**2)
    return depth, energy.harvested_energy(device.at(side), depth), work


def image_energy(device: Harvester, sequence: Sequence, depth, harvested) -> Float[Array, " impact"]:
    """Compute what the mirror image of each impact of an orbit closed half way harvests, at the other wall.

    Of orbits closed in full, which have no images, it is what the impact itself does.
    """
    there = energy.harvested_energy(device.at(-sequence.side), depth)
    return jnp.where(sequence.mirrored, there, harvested)
