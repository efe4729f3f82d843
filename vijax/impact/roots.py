"""Root finding: Newton's method inside a bracket, implicit derivatives of roots, and Householder's fourth-order step.

The derivatives of a root s of F(s, a) = 0 follow from the implicit function theorem: ds = -F_a da / F_s.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from vijax.model.flow import horner
from vijax.runtime.arrays import Flag, Flags, Scalar, Values
from vijax.runtime.compilation.xla import materialise, materialised, short_while_loop

_MOST_ROUNDS = 120  # limit of iterations: bisection alone needs 2 x 53, Newton's method usually 6


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def implicit_root(residual: Callable, root: Scalar, args: Any) -> Scalar:
    """Return `root` unchanged, with its derivatives with respect to `args` as defined by residual(root, args) = 0.

    Derivatives of every order are correct, because the tangent rule applies `implicit_root` to the root again. (A
    differentiated Newton step has correct first derivatives only.)
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
    """Return an extremum of a function of s, with derivatives of every order with respect to `args`.

    The first derivative does not depend on the displacement of the extremum, because the value is stationary in s.
    Higher derivatives do, and include it.

    Args:
        course: (s, args) -> (derivative of the value by s, value) at s.
        place: The s of the extremum, where the derivative is zero.
        args: Second argument of `course`.
    """
    return course(place, args)[1]


@extreme_value.defjvp
def _extreme_value_jvp(course, primals, tangents):
    place, args = primals
    place = implicit_root(lambda s, args: course(s, args)[0], place, args)
    return jax.jvp(lambda a: course(place, a)[1], (args,), (tangents[1],))


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def implicit_state(course: Callable, rates: Callable, root: Scalar, args: Any) -> tuple[Scalar, Scalar]:
    """Return a root and the state at the root, with correct derivatives of every order with respect to `args`.

    The root is returned unchanged. `rates` computes the derivatives by s from the equation of motion in a few
    operations. `jax.jvp` of `course` would differentiate a closed form instead, and the program of a second derivative
    would be 1.2x as large.

    Args:
        course: (s, args) -> (residual, state) at s.
        rates: (s, args, state) -> derivatives by s of residual and state, at a zero of the residual.
        root: The s of the zero of the residual.
        args: Pytree of the numbers that root and state depend on.

    Returns:
        The root, and the state there.
    """
    return root, course(root, args)[1]


@implicit_state.defjvp
def _implicit_state_jvp(course, rates, primals, tangents):
    # The rule applies the function again, so that root and state move in second derivatives.
    args = primals[1]
    root, state = implicit_state(course, rates, *primals)
    _, (moved, change) = jax.jvp(lambda a: course(root, a), (args,), (tangents[1],))
    slope, rate = rates(root, args, state)
    step = -moved / slope
    return (root, state), (step, change + rate * step)


def bracketed_root(function: Callable, low: Scalar, high: Scalar, guess: Scalar, active: Flag) -> Scalar:
    """Return the root in [low, high] of a function that is positive at low and not positive at high.

    Newton's method inside a bracket. If a Newton step leaves the bracket, or if the bracket has not halved in three
    iterations, the iteration bisects. `function(x)` returns value and derivative. `low` itself may be a root (at the
    start of a flight or contact). If `active` is False, no iteration is made and the result has no meaning.
    """
    eps = jnp.finfo(low.dtype).eps

    def unfinished(carry):
        done, low, high, x, step, _ = carry
        return active & (done < _MOST_ROUNDS) & (jnp.abs(step) > eps * jnp.abs(x)) & (high - low > eps * jnp.abs(high))

    def shrink(carry):
        done, low, high, x, _, width = carry
        value, slope = materialise(function(x))
        low, high = jnp.where(value > 0, x, low), jnp.where(value > 0, high, x)
        steep = slope != 0
        newton = x - value / jnp.where(steep, slope, 1.0)
        # After a Newton step of a few roundings the iteration ends: a further step would follow the rounding of the
        # function.
        converged = (value == 0) | (steep & (jnp.abs(newton - x) <= 8 * eps * jnp.abs(x)))
        # Every third iteration compares the width of the bracket with its width three iterations before.
        check = done % 3 == 2
        inside = steep & (newton > low) & (newton < high) & ~(check & (high - low > 0.5 * width))
        ahead = jnp.where(inside | converged, newton, 0.5 * (low + high))
        ahead = jnp.where(value == 0, x, ahead)
        step = jnp.where(converged, 0.0, ahead - x)
        return done + 1, low, high, ahead, step, jnp.where(check, high - low, width)

    guess = jnp.where((guess > low) & (guess < high), guess, 0.5 * (low + high))
    start = (jnp.int32(0), low, high, guess, high - low, high - low)
    return short_while_loop(unfinished, shrink, start)[3]


def converged_step(eps: Any) -> float:
    """Return eps^(1/4), the bound of the last step of a fourth-order iteration for an error of at most about eps.

    The step is in units of 1/stiffness; `converges` defines the stiffness.
    """
    return float(eps) ** 0.25


def converges(step: Values, rate: Any, f1: Values, f2: Values, most: float) -> Flags:
    """Return True if |step| times the stiffness is below `most`.

    The stiffness is the larger of `rate`, the inverse time scale of the motion, and |f2/f1|, where f1 and f2 are the
    first two derivatives of the residual. Products are compared, so that no division is needed.
    """
    size = jnp.abs(step)
    return (rate * size < most) & (jnp.abs(f2) * size < most * jnp.abs(f1))


def householder(f: Values, f1: Values, f2: Values, f3: Values) -> Values:
    """Return the fourth-order root step from f and its first three derivatives, with one division."""
    # With f2 = f3 = 0 this is Newton's step.
    slope, bent = f1 * f1, f * f2
    return -f * (6 * slope - 3 * bent) / (6 * f1 * (slope - bent) + f * f * f3)


def taylor(derivatives: tuple[Values, ...], order: int, s: Values) -> Values:
    """Return the sum over k of derivatives[k] s^k/(k + order)!."""
    return horner(tuple(d * (1 / math.factorial(k + order)) for k, d in enumerate(derivatives)), s)


def correction(step: Values, derivatives: tuple[Values, ...]) -> Values:
    """Return the correction of an approximate step to a root of f: a Newton step on the Taylor polynomial of f.

    The Newton step starts at the end of `step`. `derivatives` holds f and its derivatives at the start of `step`.
    """
    return -taylor(derivatives, 0, step) / taylor(derivatives[1:], 0, step)


@materialised
def single(tree: Any) -> Any:
    """Convert the floating-point leaves of a tree to single precision.

    Only the last iteration of a fourth-order method needs double precision. In single precision the earlier iterations
    cost a quarter as much.
    """
    return jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != jnp.bool_ else x, tree)
