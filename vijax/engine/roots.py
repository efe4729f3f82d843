"""Roots: inside a bracket, their derivatives by the equation they solve, and the step that all quick searches share."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from vijax.model.flow import horner
from vijax.runtime.arrays import Flag, Flags, Scalar, Values
from vijax.runtime.xla import search, share, shared

_MOST_ROUNDS = 120  # bisection alone needs 2 x 53; Newton ends most after 6


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def implicit_root(residual: Callable, root: Scalar, args: Any) -> Scalar:
    """Make `root` a function of `args` by residual(root, args) = 0.

    Its value is unchanged, derivatives of every order are right: the tangent rule calls itself on the root, so that
    second ones are right too (one Newton step would not do).
    """
    return root


@implicit_root.defjvp
def _implicit_root_jvp(residual, primals, tangents):
    root, args = primals
    root = implicit_root(residual, root, args)
    _, moved = jax.jvp(lambda a: residual(root, a), (args,), (tangents[1],))
    _, slope = jax.jvp(lambda s: residual(s, args), (root,), (jnp.ones_like(root),))
    return root, -moved / slope


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def extreme_value(course: Callable, place: Scalar, args: Any) -> Scalar:
    """Compute a value at its extremum as a function of `args`; that moves with them, in derivatives beyond the first.

    Args:
        course: (s, args) -> the value's derivative in s, and the value at s.
        place: Where the derivative vanishes.
        args: What both are functions of.
    """
    return course(place, args)[1]


@extreme_value.defjvp
def _extreme_value_jvp(course, primals, tangents):
    place, args = primals
    place = implicit_root(lambda s, args: course(s, args)[0], place, args)
    return jax.jvp(lambda a: course(place, a)[1], (args,), (tangents[1],))


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def implicit_state(course: Callable, rates: Callable, root: Scalar, args: Any) -> tuple[Scalar, Scalar]:
    """Return a root and the state there as functions of `args`: values unchanged, derivatives of every order right.

    `rates` computes derivatives in s from the equation of motion in a few operations. `jax.jvp` of `course` in s would
    differentiate its closed form once more: the program of a second derivative would be 1.2x as large.

    Args:
        course: (s, args) -> (residual, state) at s.
        rates: (s, args, state) -> derivatives in s of residual and state, where the residual vanishes.
        root: s where the residual vanishes.
        args: Pytree of the numbers that root and state depend on.

    Returns:
        The root, and the state there.
    """
    return root, course(root, args)[1]


@implicit_state.defjvp
def _implicit_state_jvp(course, rates, primals, tangents):
    # The rule calls itself, so that root and state move in second derivatives.
    args = primals[1]
    root, state = implicit_state(course, rates, *primals)
    _, (moved, change) = jax.jvp(lambda a: course(root, a), (args,), (tangents[1],))
    slope, rate = rates(root, args, state)
    step = -moved / slope
    return (root, state), (step, change + rate * step)


def bracketed_root(function: Callable, low: Scalar, high: Scalar, guess: Scalar, wanted: Flag) -> Scalar:
    """Find the root in [low, high] of a function positive at low, not positive at high: Newton inside a bracket.

    A Newton step that leaves the bracket, or a bracket that does not halve in two rounds, falls back to bisection.
    `function(x)` returns value and derivative. `low` itself may be a root (a flight or contact begins there).
    """
    eps = jnp.finfo(low.dtype).eps

    def unfinished(carry):
        done, low, high, x, step, _ = carry
        return wanted & (done < _MOST_ROUNDS) & (jnp.abs(step) > eps * jnp.abs(x)) & (high - low > eps * jnp.abs(high))

    def shrink(carry):
        done, low, high, x, _, width = carry
        value, slope = share(function(x))
        low, high = jnp.where(value > 0, x, low), jnp.where(value > 0, high, x)
        steep = slope != 0
        newton = x - value / jnp.where(steep, slope, 1.0)
        # A Newton step of a few roundings has arrived: the next one would only follow the rounding of the function.
        arrived = (value == 0) | (steep & (jnp.abs(newton - x) <= 8 * eps * jnp.abs(x)))
        check = done % 3 == 2
        inside = steep & (newton > low) & (newton < high) & ~(check & (high - low > 0.5 * width))
        ahead = jnp.where(inside | arrived, newton, 0.5 * (low + high))
        ahead = jnp.where(value == 0, x, ahead)
        step = jnp.where(arrived, 0.0, ahead - x)
        return done + 1, low, high, ahead, step, jnp.where(check, high - low, width)

    guess = jnp.where((guess > low) & (guess < high), guess, 0.5 * (low + high))
    start = (jnp.int32(0), low, high, guess, high - low, high - low)
    return search(unfinished, shrink, start)[3]


def converged_step(eps: Any) -> float:
    """Give the largest last step, times the stiffness, after which a fourth-order iteration is off by eps."""
    return float(eps) ** 0.25


def converges(step: Values, rate: Any, f1: Values, f2: Values, most: float) -> Flags:
    """Say whether a step times the stiffness is below a bound: that of the rate, or |f2/f1|, without its division."""
    size = jnp.abs(step)
    return (rate * size < most) & (jnp.abs(f2) * size < most * jnp.abs(f1))


def householder(f: Values, f1: Values, f2: Values, f3: Values) -> Values:
    """Compute the step of the fourth-order root iteration from f and its first three derivatives; one division."""
    slope, bent = f1 * f1, f * f2
    return -f * (6 * slope - 3 * bent) / (6 * f1 * (slope - bent) + f * f * f3)


def taylor(derivatives: tuple[Values, ...], order: int, s: Values) -> Values:
    """Sum derivatives[k] s^k/(k + order)!."""
    return horner(tuple(d * (1 / math.factorial(k + order)) for k, d in enumerate(derivatives)), s)


def correction(step: Values, derivatives: tuple[Values, ...]) -> Values:
    """Compute what a step to a root misses: Newton's on the Taylor polynomial, from where the step leads."""
    return -taylor(derivatives, 0, step) / taylor(derivatives[1:], 0, step)


@shared
def single(tree: Any) -> Any:
    """Turn floating leaves to single precision.

    An iteration of fourth order needs double precision in the last one alone: the others cost a quarter as much.
    """
    return jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != jnp.bool_ else x, tree)
