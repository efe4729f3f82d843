"""Ascent to a local maximum under bounds and inequality constraints, many starts at once; knows no physics.

An interior-point method: L-BFGS of optax climbs the value plus a logarithmic barrier, whose weight falls as it
converges. A trial is taken only if it is a point at all, satisfies every constraint and lies higher; else the step is
halved. So from the first admissible point on, every point is admissible.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.design.design_settings import DEFAULT, DesignSettings
from vijax.runtime.arrays import choose
from vijax.runtime.xla import once

_CONVERGED = 1e-6  # At this weight of the barrier a maximum is right to six digits.
_ARRIVED = 1e-8  # A step this short is the last.
_STUCK = 1e-9  # So is a trial that is refused this near.
_ROUNDED = 1e-3  # If a step that gains so small a part of the barrier's weight is refused, rounding decided.


class Look(NamedTuple):
    """What is seen at a point of every start.

    Attributes:
        value: To be raised.
        gradient: Of the value.
        margins: Constraints, each satisfied where it is not negative.
        slopes: Of the margins.
        there: Whether the point exists; nothing else is read where it does not.
        memory: What a look near here starts from; any arrays with a leading axis.
    """

    value: Float[Array, " start"]
    gradient: Float[Array, "start variable"]
    margins: Float[Array, "start constraint"]
    slopes: Float[Array, "start constraint variable"]
    there: Bool[Array, " start"]
    memory: Any


class Box(NamedTuple):
    """Bounds of the variables, and how far one step may go."""

    low: Float[Array, "start variable"]
    high: Float[Array, "start variable"]
    radius: float


class Climb(eqx.Module):
    """The ascent of every start; also the loop's state.

    Attributes:
        z, seen: Where each is, and what is seen there.
        weight: Of the barrier.
        step, pace: The full step to try from there, the share of it to try.
        going: Which are on the way.
        lost: Which had their last trial refused as it was no point, not for its height or the constraints.
        evaluations: Of each start.
        path, heights: Variables and values after every evaluation; NaN where the trial was refused.
        iteration: Evaluations of the batch.
        state: Of optax.
    """

    z: Float[Array, "start variable"]
    seen: Look
    weight: Float[Array, " start"]
    step: Float[Array, "start variable"]
    pace: Float[Array, " start"]
    going: Bool[Array, " start"]
    lost: Bool[Array, " start"]
    evaluations: Int[Array, " start"]
    path: Float[Array, "evaluation start variable"]
    heights: Float[Array, "evaluation start"]
    iteration: Int[Array, ""]
    state: Any


class _Task(NamedTuple):
    """What stays the same on every way: what is looked at, bounds, most evaluations, optax's memory, settings."""

    look: Callable[..., Look]
    box: Box
    max_evaluations: int
    lbfgs: Any
    settings: DesignSettings


def ascend(
    look: Callable[..., Look],
    z: Float[Array, "start variable"],
    memory: Any,
    box: Box,
    max_evaluations: int,
    settings: DesignSettings = DEFAULT,
) -> Climb:
    """Climb from every start, under jit.

    Args:
        look: (points, the points whose memory is given, that memory) -> what is seen, bounds aside.
        z: Starts, within the bounds.
        memory: Of the starts.
        box: Their bounds.
        max_evaluations: That a start may take, the first one included.
        settings: Of the barrier, how near a step may come to a constraint, and how much curvature is kept.
    """
    import optax  # here, as importing vijax must not load it

    # Traced once for the shapes of what is seen, and for the loop.
    task = _Task(once(look), box, max_evaluations, optax.scale_by_lbfgs(settings.curvature_pairs), settings)
    start = _begun(task, z, memory)
    return lax.while_loop(lambda c: c.going.any() & (c.iteration < max_evaluations), partial(_advance, task), start)


def _begun(task: _Task, z: Float[Array, "start variable"], memory: Any) -> Climb:
    """Stand before the first look, which the loop takes: so it is compiled once."""
    starts = z.shape[0]
    shapes = jax.eval_shape(partial(_view, task), z, z, memory)
    blank: Look = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    path = jnp.full((task.max_evaluations, *z.shape), jnp.nan, z.dtype)
    return Climb(
        z=z,
        seen=blank._replace(memory=memory),
        weight=jnp.full(starts, task.settings.first_barrier, z.dtype),
        step=jnp.zeros_like(z),
        pace=jnp.ones(starts, z.dtype),
        going=jnp.ones(starts, bool),
        lost=jnp.zeros(starts, bool),
        evaluations=jnp.zeros(starts, jnp.int32),
        path=path,
        heights=path[..., 0],
        iteration=jnp.int32(0),
        state=_forgotten(task, z),
    )


def _advance(task: _Task, c: Climb) -> Climb:
    """Make one trial of every start that is on its way."""
    # Who has ended looks where it is, which is soon seen: what its last trial lost would be sought in vain again.
    trial = c.z + jnp.where(c.going, c.pace, 0.0)[:, None] * c.step
    seen = _view(task, trial, c.z, c.seen.memory)
    better = c.going & seen.there & (_higher(c, seen) | (c.iteration == 0))
    turns = _turns(task, c, seen, better)
    falls = turns | (better & (c.pace == 1) & _little(c))
    weight = jnp.where(falls, _lighter(task.settings, c.weight), c.weight)
    # Curvature compares gradients of one function: that before, under the new weight; none across the border, nor where
    # it turns.
    state = c.state._replace(updates=-_gradient(c.seen, weight))
    afresh = turns | (better & ~_inside(c.seen) & _inside(seen))
    state = choose(afresh, _forgotten(task, c.z), state)
    z, now = choose(better, (trial, seen), (c.z, c.seen))
    step, state = choose(better | turns, _aim(task, z, now, weight, state), (c.step, c.state))
    length = jnp.abs(step).max(axis=1)
    settled = better & (length <= _ARRIVED) & (weight <= task.settings.last_barrier)
    refused = 0.5 * c.pace * jnp.abs(c.step).max(axis=1) / jnp.maximum(length, _STUCK)
    pace = jnp.minimum(jnp.where(better, 2 * c.pace, refused), 1.0)
    count = c.evaluations + c.going.astype(jnp.int32)
    return Climb(
        z=z,
        seen=now,
        weight=weight,
        step=step,
        pace=jnp.where(c.going, pace, c.pace),
        going=c.going & ~settled & (pace * length > _STUCK) & (count < task.max_evaluations),
        lost=jnp.where(c.going, ~seen.there, c.lost),
        evaluations=count,
        path=c.path.at[c.iteration].set(jnp.where(better[:, None], trial, jnp.nan)),
        heights=c.heights.at[c.iteration].set(jnp.where(better, seen.value, jnp.nan)),
        iteration=c.iteration + 1,
        state=state,
    )


def _lighter(settings: DesignSettings, weight: Float[Array, " start"]) -> Float[Array, " start"]:
    """Give the next weight of the barrier: w <- min(0.1 w, w**1.5) by default, and not below the last."""
    falls = jnp.minimum(settings.barrier_factor * weight, weight**settings.barrier_power)
    return jnp.maximum(falls, settings.last_barrier)


def _view(task: _Task, z, near, memory) -> Look:
    """Look, with the bounds among the constraints."""
    seen = task.look(z, near, memory)
    eye = jnp.broadcast_to(jnp.eye(z.shape[1], dtype=z.dtype), (*z.shape, z.shape[1]))
    return seen._replace(
        margins=jnp.concatenate([seen.margins, z - task.box.low, task.box.high - z], axis=1),
        slopes=jnp.concatenate([seen.slopes, eye, -eye], axis=1),
    )


def _little(c: Climb) -> Bool[Array, " start"]:
    """Return which starts have converged for the weight of their barrier: the step promises less than it weighs."""
    return c.going & _inside(c.seen) & (c.pace * _promised(c) < c.weight)


def _promised(c: Climb) -> Float[Array, " start"]:
    """Compute what the whole step gains by the slope."""
    return (c.step * _gradient(c.seen, c.weight)).sum(axis=1)


def _turns(task: _Task, c: Climb, trial: Look, better: Bool[Array, " start"]) -> Bool[Array, " start"]:
    """Return which starts have converged for the weight of their barrier although their trial is refused.

    There are two cases. Beyond an edge there is no point: the barrier may have pushed the start there, and with less of
    it the way may lead elsewhere. Or even the whole step gains next to nothing: rounding decides whether the trial is
    higher, and halving the step would end the ascent at the maximum of this barrier.
    """
    rounded = _promised(c) < _ROUNDED * c.weight
    return ~better & _little(c) & (~trial.there | rounded) & (c.weight > task.settings.last_barrier)


def _forgotten(task: _Task, z) -> Any:
    """Make a state of optax without any memory of curvature."""
    return jax.vmap(task.lbfgs.init)(z)


def _aim(task: _Task, z, seen: Look, weight, state):
    """Aim the next step, and give the state of optax after it; afresh where its curvature points down."""
    ahead = _gradient(seen, weight)
    # Optax mixes whole numbers and truths, which callers may have forbidden.
    with jax.numpy_dtype_promotion("standard"):
        found, straight = (jax.vmap(task.lbfgs.update)(-ahead, of, z) for of in (state, _forgotten(task, z)))
    step, after = choose((found[0] * ahead).sum(axis=1) < 0, found, straight)
    return _shortened(task, -step, seen), after


def converged(c: Climb) -> Bool[Array, " start"]:
    """Say which ended with a barrier that no longer matters; the others stalled, or lost their point."""
    return c.weight <= _CONVERGED


def _inside(seen: Look) -> Bool[Array, " start"]:
    return seen.margins.min(axis=1) > 0


def _gradient(seen: Look, weight: Float[Array, " start"]) -> Float[Array, "start variable"]:
    """Differentiate value and barrier; where a constraint is violated, the margin that lacks most."""
    safe = jnp.where(seen.margins > 0, seen.margins, 1.0)
    barrier = weight[:, None] * (seen.slopes / safe[..., None]).sum(axis=1)
    worst = seen.margins.argmin(axis=1)[:, None, None]
    least = jnp.take_along_axis(seen.slopes, worst, axis=1)[:, 0]
    return jnp.nan_to_num(choose(_inside(seen), seen.gradient + barrier, least))


def _higher(c: Climb, trial: Look) -> Bool[Array, " start"]:
    """Say whether a trial is better: admissible and higher, or nearer to admissible where none is yet."""
    before, after = (seen.margins.min(axis=1) for seen in (c.seen, trial))
    gain = trial.value - c.seen.value
    ratio = jnp.where((c.seen.margins > 0) & (trial.margins > 0), trial.margins / c.seen.margins, 1.0)
    gain = gain + c.weight * jnp.log(ratio).sum(axis=1)
    return jnp.where(before > 0, (after > 0) & (gain > 0), after > before)


def _shortened(task: _Task, step, seen: Look) -> Float[Array, "start variable"]:
    """Go as far along a step as the trust region and the linearised constraints allow."""
    closing = -(seen.slopes * step[:, None]).sum(axis=2)
    limited = (seen.margins > 0) & (closing > 0)
    share = jnp.where(limited, task.settings.max_approach * seen.margins / jnp.where(limited, closing, 1.0), 1.0)
    radius = task.box.radius
    share = jnp.minimum(share.min(axis=1), radius / jnp.maximum(jnp.abs(step).max(axis=1), radius))
    return jnp.minimum(share, 1.0)[:, None] * step
