"""The average power of a device's motion, periodic or not, with derivatives that one ensemble of balls gives.

Derivatives along a chaotic flight grow with its Lyapunov exponent and say nothing of averages. These come from a local
least-squares fit instead, over balls in devices a little apart; where the fit shows that there is no smooth average,
the record says why.
"""

import enum
from functools import lru_cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.batch import perturbed
from vijax.batch.summary import Summary
from vijax.design.local_fit import LocalFit, local_fit
from vijax.model import flow
from vijax.model.device import Harvester, check_each_constant, electrical
from vijax.model.energy import capacitance
from vijax.model.pair import ImpactPair, pair_of, quantities
from vijax.planes.basins import SPEED
from vijax.runtime import checks, tiles
from vijax.runtime.arrays import Values, present
from vijax.runtime.checks import is_concrete
from vijax.runtime.context import door
from vijax.runtime.lattice import lattice
from vijax.runtime.printed import PrintedRecord, printed
from vijax.runtime.programs import jitted

_LEAST_BALLS = 32  # fewer give no standard error that could be trusted
_MOST_BALLS = 2**20
_WIDEST = 0.2  # spread of a neighbourhood that a quadratic may describe
_BALLS_A_TERM = 6  # terms of second order are fitted where there are so many balls for every coefficient
# Electrical constants are moved by this part of themselves: what is left out of the derivative, and what rounding of
# energies makes of it, are both some 1e-8 of it.
_STEP = 1e-7
_ELECTRICAL = "C_T", "R0", "V", "eps_M", "r_b", "w0"
# What is not smooth, see `Smoothness`.
_INNER = 0.8  # part of the neighbourhood
_STRAY = 0.01  # share of balls
_APART = 4.0  # variance between balls over that within them
_ROUGH = 1e-4  # relative difference of P between balls below which they are not told apart
_DIFFERENT = 4.5  # standard errors between the slopes of both halves
_BENT = 0.02  # difference of elasticities below which a slope is not called different, whatever its error


class Smoothness(enum.IntEnum):
    """Whether averages are smooth in the neighbourhood of a device, as far as its balls show."""

    SMOOTH = 0
    FAILED = 1  # some balls have no average
    WINDOW = 2  # some are on orbits, others are not
    ATTRACTORS = 3  # balls differ by more than their own flights explain
    KINK = 4  # the inner and the outer half of the neighbourhood have different slopes

    @property
    def advice(self) -> str:
        """Say what it means for the derivatives, in a sentence."""
        return _ADVICE[self]


_ADVICE = {
    Smoothness.SMOOTH: "use them: the averages of all balls lie on one smooth surface",
    Smoothness.FAILED: "run more periods, or look at a sweep: some balls ended without an average",
    Smoothness.WINDOW: "spread less to see the window alone: some balls settle on orbits, others do not",
    Smoothness.ATTRACTORS: "look at the basins: balls end on several attractors, whose shares move with the device",
    Smoothness.KINK: "spread less: P bends within the neighbourhood, as at a crisis or at the edge of a window",
}


class Average(PrintedRecord):
    """The average of a device's motion, its derivatives, and how far they can be trusted.

    Standard errors are those of the scatter of the balls. They do not know of what no ball has met: an attractor that
    few starts end on, a window narrower than the balls are apart.

    Attributes:
        P, P_stderr: Energy harvested per half forcing period, over all attractors by the share of starts that end on
            each, and its standard error [J]. With `power` the only field that has derivatives under `jax.grad`.
        power: P omega/pi [W].
        by_pair, by_pair_stderr: dP/d(d, kappa, r, gamma) at fixed unit of length, and standard errors [J]. 0 in gamma
            on level ground, where P is an even function of it.
        by_device, by_device_stderr: dP by every constant of the device, the others fixed, and standard errors [J per
            unit of the constant].
        periodic: Share of the balls that ended on orbits.
        smooth: Whether the averages of all balls lie on one smooth surface.
        verdict: A `Smoothness`, whose `advice` says what it means.
    """

    P: Float[Array, ""]
    P_stderr: Float[Array, ""]
    power: Float[Array, ""]
    by_pair: ImpactPair
    by_pair_stderr: ImpactPair
    by_device: Harvester
    by_device_stderr: Harvester
    periodic: Float[Array, ""]
    smooth: Bool[Array, ""]
    verdict: Int[Array, ""]

    def __repr__(self) -> str:
        # The verdict may be traced, or a tangent.
        known = isinstance(self.verdict, jax.Array) and is_concrete(self.verdict) and self.verdict.ndim == 0
        return printed(self, verdict=f"Smoothness.{Smoothness(int(self.verdict)).name}") if known else printed(self)


class _Inputs(NamedTuple):
    """What P depends on: the motion by the pair, energies by the unit of length [m] and the electrical constants."""

    pair: ImpactPair
    length: Any
    device: Harvester


class _FlownBalls(NamedTuple):
    """An ensemble: where its balls were, and what they gave.

    Attributes:
        width: How far balls were spread.
        x: Offsets of the balls' devices from the centre, in parts of the width.
        real: Which balls are no padding and have an average.
        failed: Whether others have none.
        P, P_stderr: Of every ball [J].
        fixed: Derivatives of P at each ball's motion in the unit of length and the electrical constants.
        periodic: Which balls ended on orbits.
    """

    width: Float[Array, ""]
    x: Float[Array, "ball variable"]
    real: Bool[Array, " ball"]
    failed: Bool[Array, ""]
    P: Float[Array, " ball"]
    P_stderr: Float[Array, " ball"]
    fixed: Float[Array, "ball quantity"]
    periodic: Bool[Array, " ball"]


@door
def average(
    device: Harvester, *, balls: int = 4096, periods: int = 400, spread: float = 0.01, seed: int | None = None
) -> Average:
    """Average what a device with soft walls gives, with derivatives; under jit, vmap and grad (both modes, once).

    ::

        found = average(device)
        found.P, found.P_stderr, found.by_device.omega0, found.by_device_stderr.omega0, found.smooth
        jax.grad(lambda device: average(device).P)(device)  # the same derivatives

    One ensemble flies. Its balls start all over the gap, in pairs of opposite offsets from the device: ln d, ln kappa,
    ln r and gamma (on level ground it stays 0) are spread evenly, of walls that differ those of each. P of the balls is
    fitted by a quadratic in the offsets, of which value and slopes at the centre are told: the plain mean of the balls
    would be off by P's curvature. What does not move the ball (electrical constants, the unit of length) is
    differentiated at its motion.
    Errors are those of the fit with the scatter as it is found, pair by pair. Numbers are the same in every call: from
    one device to the next there is no new noise but what chaos makes of the change.

    A call takes a second; the first one of a process compiles for ten. Inside `jit` and `vmap` programs are compiled
    anew, twice if it is not known there whether the ground is level, and devices of a batch fly one after another.

    Args:
        device: Constants, one number each; those under differentiation traced.
        balls: How many fly, even, 32 to 1,048,576. Programs are compiled for powers of two.
        periods: Forcing periods of a ball that settles on no orbit; the first quarter is left out of its averages. A
            ball with fewer than 200 impacts, or two in three periods, runs on, to 4 or 16 times as many.
        spread: How far balls are spread to either side, in logarithms (gamma: as it is), 0.2 at most. Errors of slopes
            fall as it grows, what the quadratic leaves out grows with its square, and with it what windows it meets.
        seed: Of offsets and starts drawn at random; unless given they lie on lattices, which are more even.

    Returns:
        The record; second derivatives are NaN, as nothing here measures them. Where `smooth` is false the average
        of P stands for the neighbourhood, and its derivatives mean little.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    check_each_constant(device, "map devices by jax.vmap")
    balls = checks.whole("balls", balls, _LEAST_BALLS, _MOST_BALLS)
    if balls % 2:
        raise ValueError(f"balls must be even, as they fly in pairs; got {balls}; take {balls + 1}")
    periods = checks.whole("periods", periods, 8)
    width = checks.real("spread", spread, f"a number in (0, {_WIDEST}]", lambda x: 0 < x <= _WIDEST)
    device = jax.tree.map(lambda x: jnp.asarray(x, float), device)
    at = lax.stop_gradient(_inputs(device))
    size = len(jax.tree.leaves(at.pair))
    flown = _fly(at, _design(balls, size, checks.seed(seed)), periods, width)
    return _concluded(device, at, flown, balls >= _BALLS_A_TERM * (size + 1) * (size + 2) // 2)


def _inputs(device: Harvester) -> _Inputs:
    return _Inputs(device.pair(), device.length_unit, electrical(device))


# --- the ensemble -----------------------------------------------------------------------------------------------------


class _Design(NamedTuple):
    """Where balls are: offsets in [-1, 1] [ball, variable], in pairs of opposite ones that share a start [ball, 2]."""

    offsets: np.ndarray
    start: np.ndarray


@lru_cache(maxsize=8)
def _design(balls: int, size: int, seed: int | None) -> _Design:
    """Place so many balls in so many variables: on lattices, or drawn at random by a seed."""
    half = balls // 2
    if seed is None:
        start, some = lattice(half, 2).T, lattice(half, size).T
    else:
        start, some = np.split(np.random.default_rng(seed).random((half, 2 + size)), [2], axis=1)
    some = 2 * some - 1
    return _Design(np.stack([some, -some], axis=1).reshape(balls, size), np.repeat(2 * start - 1, 2, axis=0))


def _fly(at: _Inputs, design: _Design, periods: int, width: float) -> _FlownBalls:
    """Fly the ensemble about a device."""
    balls = len(design.offsets)
    offsets, square = (jnp.asarray(np.resize(x, (tiles.padded(balls), x.shape[1]))) for x in design)
    reach, count = jnp.asarray(width), jnp.asarray(balls, jnp.int32)
    x, pair, length, device, steps = _spread(at, reach, offsets)
    start = 0.5 * square[:, 0] * pair.d, SPEED * square[:, 1]
    ended = perturbed.averages(pair, start, length, device, count, jnp.asarray(periods, float))
    return _gathered(reach, x, ended, steps, count)


@jitted
def _spread(at: _Inputs, width: Float[Array, ""], offsets: Float[Array, "ball variable"]):
    """Spread balls: offsets and pairs; units of length, electrical constants and the steps between them [variant]."""
    offs = dict(zip(quantities(at.pair), (width * offsets).T, strict=True))
    moved = {name: _moved(name, value, offs[name]) for name, value in quantities(at.pair).items()}
    x = jnp.stack([off for _, off in moved.values()], axis=1) / width
    now = jnp.stack([at.length, *jax.tree.leaves([getattr(at.device, name) for name in _ELECTRICAL])])
    size = jnp.where(now == 0, 1.0, jnp.abs(now))
    # C_T, the first of them, may be 0, beside a capacitance that is not.
    size = size.at[1].add(capacitance(at.device.at(1), jnp.zeros(())))
    after = now + _STEP * size
    # Each variant but the first has one of them moved.
    table = jnp.where(jnp.eye(now.size, now.size + 1, 1, dtype=bool), after[:, None], now[:, None])
    m_b = jnp.broadcast_to(at.device.m_b, table.shape[1:])
    # Not by `replace`, which would check fields that are not there.
    device = eqx.tree_at(_electrical_and_mass, at.device, [*table[1:], m_b])
    pair = pair_of({name: value for name, (value, _) in moved.items()}, "soft")
    return x, pair, table[0], device, after - now


def _moved(name: str, value: Values, off: Values) -> tuple[Values, Values]:
    """Move a quantity of the pair, by a factor of e^off or, gamma, by off; give it and how far it could be moved."""
    if name == "gamma":
        there = value + jnp.where(value == 0, 0.0, off)
        return there, there - value
    there = value * jnp.exp(off)
    if not name.startswith("r"):
        return there, off
    there = jnp.minimum(there, 1.0)
    return there, jnp.log(there / value)


def _electrical_and_mass(device: Harvester) -> list[Any]:
    return jax.tree.leaves([getattr(device, name) for name in (*_ELECTRICAL, "m_b")])


@jitted
def _gathered(width, x, ended: Summary, steps, count) -> _FlownBalls:
    there = jnp.arange(x.shape[0], dtype=count.dtype) < count
    found, errors = present(ended.P), present(ended.P_stderr)
    real = there & jnp.isfinite(found[:, 0])
    # A ball without an average weighs nothing, and so does the other of its pair.
    real = jnp.repeat(real.reshape(-1, 2).all(axis=1), 2)
    P, P_stderr = (jnp.where(real[:, None], y, 0.0) for y in (found, errors))
    fixed = (P[:, 1:] - P[:, :1]) / steps
    return _FlownBalls(width, x, real, (there & ~real).any(), P[:, 0], P_stderr[:, 0], fixed, real & (ended.period > 0))


# --- the fit ----------------------------------------------------------------------------------------------------------


@partial(jitted, static=("second",))
def _concluded(device: Harvester, at: _Inputs, flown: _FlownBalls, second: bool) -> Average:
    """Make the record of an ensemble."""
    fit = local_fit(flown.x, jnp.column_stack([flown.P, flown.fixed]), flown.real, second)
    value = fit.found[0, 0]

    def slopes(coefficients: Float[Array, "term column"]) -> _Inputs:
        """Turn coefficients of the fit into derivatives of P."""
        unit = {name: 1.0 if name == "gamma" else value for name, value in quantities(at.pair).items()}
        each = coefficients[1 : 1 + len(unit), 0] / flown.width / jnp.stack(list(unit.values()))
        blank = jax.tree.map(jnp.zeros_like, at.device)
        constants = list(coefficients[0, 2:])
        electric = eqx.tree_at(_electrical_and_mass, blank, [*constants, blank.m_b])
        return _Inputs(pair_of(dict(zip(unit, each, strict=True)), "soft"), coefficients[0, 1], electric)

    def size(added: Any) -> Any:
        return jax.tree.map(lambda x: jnp.sqrt((x * x).sum(axis=0)), added)

    by, by_each = slopes(fit.found), jax.vmap(slopes)(fit.added)
    _, back = jax.vjp(_inputs, lax.stop_gradient(device))
    (by_device,), (by_device_each,) = back(by), jax.vmap(back)(by_each)
    P = _follows(_inputs(device), value, by)
    verdict = _verdict(flown, fit, second)
    return Average(
        P=P,
        P_stderr=fit.errors()[0, 0],
        power=P * device.omega / flow.PI,
        by_pair=by.pair,
        by_pair_stderr=size(by_each.pair),
        by_device=by_device,
        by_device_stderr=size(by_device_each),
        periodic=_share(flown),
        smooth=verdict == Smoothness.SMOOTH,
        verdict=verdict,
    )


def _verdict(flown: _FlownBalls, fit: LocalFit, second: bool) -> Int[Array, ""]:
    """Judge whether the averages of all balls lie on one smooth surface."""
    value, periodic = fit.found[0, 0], _share(flown)
    within = (flown.P_stderr**2).sum() / flown.real.sum(dtype=value.dtype)
    between = (fit.rest[:, 0] ** 2).sum() / fit.left
    inner = jnp.abs(flown.x).max(axis=1) < _INNER
    halves = [local_fit(flown.x, flown.P[:, None], flown.real & half, second) for half in (inner, ~inner)]
    slopes = slice(1, 1 + flown.x.shape[1])
    difference = jnp.abs(halves[0].found[slopes, 0] - halves[1].found[slopes, 0])
    error = jnp.hypot(*(half.errors()[slopes, 0] for half in halves))
    bent = (difference > _DIFFERENT * error) & (difference > _BENT * flown.width * value)
    doubts = {
        Smoothness.FAILED: flown.failed,
        Smoothness.WINDOW: (periodic > _STRAY) & (periodic < 1 - _STRAY),
        Smoothness.ATTRACTORS: between > _APART * within + (_ROUGH * value) ** 2,
        Smoothness.KINK: bent.any(),
    }
    codes = [jnp.asarray(code, jnp.int32) for code in doubts]
    return jnp.select(list(doubts.values()), codes, jnp.asarray(Smoothness.SMOOTH, jnp.int32))


def _share(flown: _FlownBalls) -> Float[Array, ""]:
    """Count the share of the balls that ended on orbits."""
    return flown.periodic.sum(dtype=flown.P.dtype) / flown.real.sum(dtype=flown.P.dtype)


@jax.custom_jvp
def _follows(inputs: _Inputs, value: Float[Array, ""], slopes: _Inputs) -> Float[Array, ""]:
    """Make `value` a function of the inputs, with measured slopes."""
    return value


@_follows.defjvp
def _follows_jvp(primals, tangents):
    inputs, value, slopes = primals
    slopes = _constant(inputs, slopes)
    moved = jax.tree.map(lambda slope, x: slope * x, slopes, tangents[0])
    return value, sum(jax.tree.leaves(moved))


@jax.custom_jvp
def _constant(inputs: _Inputs, slopes: _Inputs) -> _Inputs:
    """Give slopes whose own derivatives are not known."""
    return slopes


@_constant.defjvp
def _constant_jvp(primals, tangents):
    unknown = jnp.nan * sum(jax.tree.leaves(tangents[0]))
    return primals[1], jax.tree.map(lambda _: unknown, primals[1])
