"""Maximise a function under bounds and inequality constraints, from many starts at once; independent of the physics.

The method is an interior-point method. L-BFGS (optax) climbs the merit function

    value(z) + weight * sum_i log(margin_i(z)),

where z are the variables and constraint i holds if margin_i >= 0. The weight of the logarithmic barrier falls as the
ascent converges. A trial is accepted only if the function exists at the trial point, all constraints hold there and the
merit is higher; otherwise the step is halved. Every point after the first admissible one is therefore admissible. As
long as the current point of a start breaks a constraint, the ascent raises the smallest margin instead.
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
from vijax.runtime.arrays import select
from vijax.runtime.compilation.xla import reuse_trace

_CONVERGED_WEIGHT = 1e-6  # an ascent with at most this weight has converged, with six correct digits
_FINAL_STEP = 1e-8  # an accepted point with a next step of at most this length ends the ascent
_SHORTEST_TRIAL = 1e-9  # trials of at most this length are not made; the ascent ends
_ROUNDING_SHARE = 1e-3  # if predicted gain / barrier weight is smaller, rounding caused the refusal


class Evaluation(NamedTuple):
    """Values and derivatives of the objective and the constraints at the current or trial point of every start.

    Attributes:
        value: Value of the function to maximise.
        gradient: Derivative of `value` in the variables.
        margins: Values of the constraints; a constraint holds where its margin is not negative.
        slopes: Derivatives of the margins.
        exists: True if the function is defined at the point (for an orbit: if the orbit exists). If False, the other
            fields are ignored.
        memory: Data that `evaluate` reuses at nearby points, for example solutions as initial values of Newton's
            method; any arrays with a leading axis of starts.
    """

    value: Float[Array, " start"]
    gradient: Float[Array, "start variable"]
    margins: Float[Array, "start constraint"]
    slopes: Float[Array, "start constraint variable"]
    exists: Bool[Array, " start"]
    memory: Any


class Box(NamedTuple):
    """Bounds of the variables, and `radius`, the largest change of a variable in one step."""

    low: Float[Array, "start variable"]
    high: Float[Array, "start variable"]
    radius: float


class AscentState(eqx.Module):
    """State of the ascents of all starts; the carry of the loop.

    Attributes:
        z, evaluation: Last accepted point of each start, and the evaluation at this point.
        weight: Weight of the barrier.
        step, step_share: Full step from the current point, and the share of this step in the next trial.
        running: True for starts that have not ended.
        reached_edge: True for starts where the last trial was refused because the point did not exist, not because of
            its value or the constraints.
        evaluations: Number of evaluations of each start.
        path, path_objective: Variables and value of the trial in each iteration; NaN where the trial was refused.
        iteration: Number of iterations of the loop; each iteration evaluates all starts once.
        state: State of optax.
    """

    z: Float[Array, "start variable"]
    evaluation: Evaluation
    weight: Float[Array, " start"]
    step: Float[Array, "start variable"]
    step_share: Float[Array, " start"]
    running: Bool[Array, " start"]
    reached_edge: Bool[Array, " start"]
    evaluations: Int[Array, " start"]
    path: Float[Array, "evaluation start variable"]
    path_objective: Float[Array, "evaluation start"]
    iteration: Int[Array, ""]
    state: Any


class _Problem(NamedTuple):
    """Constants of an ascent: function, bounds, largest number of evaluations, L-BFGS of optax, settings."""

    evaluate: Callable[..., Evaluation]
    box: Box
    max_evaluations: int
    lbfgs: Any
    settings: DesignSettings


def ascend(
    evaluate: Callable[..., Evaluation],
    z: Float[Array, "start variable"],
    memory: Any,
    box: Box,
    max_evaluations: int,
    settings: DesignSettings = DEFAULT,
) -> AscentState:
    """Climb from every start and return the final state; to be called within jit.

    Args:
        evaluate: Function (z, near, memory) -> `Evaluation` at z; `memory` is `Evaluation.memory` of the nearby points
            `near`. Its margins do not include the bounds, which `ascend` appends.
        z: Starts, within the bounds.
        memory: Initial `Evaluation.memory`, for points near the starts.
        box: Bounds of the variables of each start, and the largest step.
        max_evaluations: Largest number of evaluations of one start, the first one included.
        settings: Weights of the barrier, largest share of the way to a constraint in one step, and number of curvature
            pairs of L-BFGS.
    """
    import optax  # imported here: importing vijax must not load optax

    # The function is needed for its output shapes and in the loop; `reuse_trace` traces it only once.
    problem = _Problem(
        reuse_trace(evaluate), box, max_evaluations, optax.scale_by_lbfgs(settings.curvature_pairs), settings
    )
    start = _initial_state(problem, z, memory)
    return lax.while_loop(
        lambda c: c.running.any() & (c.iteration < max_evaluations), partial(_advance, problem), start
    )


def _initial_state(problem: _Problem, z: Float[Array, "start variable"], memory: Any) -> AscentState:
    """Return the state before the first evaluation.

    The loop makes the first evaluation, too, so that the function is compiled only once.
    """
    starts = z.shape[0]
    shapes = jax.eval_shape(partial(_evaluate, problem), z, z, memory)
    blank: Evaluation = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    path = jnp.full((problem.max_evaluations, *z.shape), jnp.nan, z.dtype)
    return AscentState(
        z=z,
        evaluation=blank._replace(memory=memory),
        weight=jnp.full(starts, problem.settings.first_barrier, z.dtype),
        step=jnp.zeros_like(z),
        step_share=jnp.ones(starts, z.dtype),
        running=jnp.ones(starts, bool),
        reached_edge=jnp.zeros(starts, bool),
        evaluations=jnp.zeros(starts, jnp.int32),
        path=path,
        path_objective=path[..., 0],
        iteration=jnp.int32(0),
        state=_reset_lbfgs(problem, z),
    )


def _advance(problem: _Problem, c: AscentState) -> AscentState:
    """Make one trial for every start that has not ended."""
    # A start that has ended evaluates its current point again, which is fast because Newton's method starts at the
    # solution. At its last refused trial Newton's method could fail, which takes all iterations.
    trial = c.z + jnp.where(c.running, c.step_share, 0.0)[:, None] * c.step
    evaluation = _evaluate(problem, trial, c.z, c.evaluation.memory)
    better = c.running & evaluation.exists & (_is_improvement(c, evaluation) | (c.iteration == 0))
    stalled = _is_stalled_at_barrier(problem, c, evaluation, better)
    reduced = stalled | (better & (c.step_share == 1) & _is_barrier_converged(c))
    # The weight falls after a full step with a predicted gain below the weight, and if `_is_stalled_at_barrier`.
    weight = jnp.where(reduced, _reduce_weight(problem.settings, c.weight), c.weight)
    # L-BFGS must compare gradients of one function, so the previous gradient is recomputed with the new weight. The
    # stored curvature is reset when a start enters the admissible region, because the function to climb changes there,
    # and when the weight falls after a refused trial.
    state = c.state._replace(updates=-_merit_gradient(c.evaluation, weight))
    reset = stalled | (better & ~_is_admissible(c.evaluation) & _is_admissible(evaluation))
    state = select(reset, _reset_lbfgs(problem, c.z), state)
    z, current = select(better, (trial, evaluation), (c.z, c.evaluation))
    step, state = select(better | stalled, _compute_step(problem, z, current, weight, state), (c.step, c.state))
    step_length = jnp.abs(step).max(axis=1)
    finished = better & (step_length <= _FINAL_STEP) & (weight <= problem.settings.last_barrier)
    # After a refusal the next trial has half the length of the last one, also if a new step was computed.
    refused_share = 0.5 * c.step_share * jnp.abs(c.step).max(axis=1) / jnp.maximum(step_length, _SHORTEST_TRIAL)
    step_share = jnp.minimum(jnp.where(better, 2 * c.step_share, refused_share), 1.0)
    count = c.evaluations + c.running.astype(jnp.int32)
    return AscentState(
        z=z,
        evaluation=current,
        weight=weight,
        step=step,
        step_share=jnp.where(c.running, step_share, c.step_share),
        running=c.running
        & ~finished
        & (step_share * step_length > _SHORTEST_TRIAL)
        & (count < problem.max_evaluations),
        reached_edge=jnp.where(c.running, ~evaluation.exists, c.reached_edge),
        evaluations=count,
        path=c.path.at[c.iteration].set(jnp.where(better[:, None], trial, jnp.nan)),
        path_objective=c.path_objective.at[c.iteration].set(jnp.where(better, evaluation.value, jnp.nan)),
        iteration=c.iteration + 1,
        state=state,
    )


def _reduce_weight(settings: DesignSettings, weight: Float[Array, " start"]) -> Float[Array, " start"]:
    """Return the barrier weight after w, by default min(0.1 w, w**1.5), at least `settings.last_barrier`."""
    reduced = jnp.minimum(settings.barrier_factor * weight, weight**settings.barrier_power)
    return jnp.maximum(reduced, settings.last_barrier)


def _evaluate(problem: _Problem, z, near, memory) -> Evaluation:
    """Evaluate the function, and append the bounds to its constraints."""
    evaluation = problem.evaluate(z, near, memory)
    # The bounds are the last constraints: z - low >= 0 and high - z >= 0.
    eye = jnp.broadcast_to(jnp.eye(z.shape[1], dtype=z.dtype), (*z.shape, z.shape[1]))
    return evaluation._replace(
        margins=jnp.concatenate([evaluation.margins, z - problem.box.low, problem.box.high - z], axis=1),
        slopes=jnp.concatenate([evaluation.slopes, eye, -eye], axis=1),
    )


def _is_barrier_converged(c: AscentState) -> Bool[Array, " start"]:
    """Return a mask of the starts converged for their weight: admissible, with a predicted gain below the weight."""
    return c.running & _is_admissible(c.evaluation) & (c.step_share * _predict_gain(c) < c.weight)


def _predict_gain(c: AscentState) -> Float[Array, " start"]:
    """Return the gain in merit that the merit gradient predicts for the full step."""
    return (c.step * _merit_gradient(c.evaluation, c.weight)).sum(axis=1)


def _is_stalled_at_barrier(
    problem: _Problem, c: AscentState, trial: Evaluation, better: Bool[Array, " start"]
) -> Bool[Array, " start"]:
    """Return a mask of the starts with a refused trial that need a smaller barrier weight, not a shorter step.

    Such a start has converged for its weight, and one of two cases holds. In the first case the function does not exist
    at the trial point. The barrier may have pushed the start to this edge, and with a smaller weight the step may lead
    elsewhere. In the second case the predicted gain of the full step is below 1e-3 of the weight, so that rounding
    decides whether the trial is higher. Halving the step would then end the ascent at the maximum for this weight.
    """
    rounded = _predict_gain(c) < _ROUNDING_SHARE * c.weight
    return ~better & _is_barrier_converged(c) & (~trial.exists | rounded) & (c.weight > problem.settings.last_barrier)


def _reset_lbfgs(problem: _Problem, z) -> Any:
    """Return a state of optax's L-BFGS without stored curvature."""
    return jax.vmap(problem.lbfgs.init)(z)


def _compute_step(problem: _Problem, z, evaluation: Evaluation, weight, state):
    """Return the next step and the state of optax after it.

    If the L-BFGS step does not ascend, the stored curvature does not belong to a maximum and is reset.
    """
    gradient = _merit_gradient(evaluation, weight)
    # optax mixes integers and booleans, which raises an error if the user has set strict dtype promotion in JAX.
    with jax.numpy_dtype_promotion("standard"):
        with_memory, without_memory = (
            jax.vmap(problem.lbfgs.update)(-gradient, lbfgs_state, z)
            for lbfgs_state in (state, _reset_lbfgs(problem, z))
        )
    # Updates are descent steps of -value: their product with the ascent direction must be negative.
    step, after = select((with_memory[0] * gradient).sum(axis=1) < 0, with_memory, without_memory)
    return _shorten_step(problem, -step, evaluation), after


def converged(c: AscentState) -> Bool[Array, " start"]:
    """Return a mask of the starts with a barrier weight of at most 1e-6.

    The other starts stalled, reached the edge of existence, or used all evaluations.
    """
    return c.weight <= _CONVERGED_WEIGHT


def _is_admissible(evaluation: Evaluation) -> Bool[Array, " start"]:
    """Return a mask of the points that satisfy all constraints strictly."""
    return evaluation.margins.min(axis=1) > 0


def _merit_gradient(evaluation: Evaluation, weight: Float[Array, " start"]) -> Float[Array, "start variable"]:
    """Return the gradient of the merit function; where a constraint is violated, the slope of the smallest margin."""
    # Margins that are not positive are replaced by 1, because a division by 0 would yield NaN even in the branch that
    # `select` discards.
    positive_margins = jnp.where(evaluation.margins > 0, evaluation.margins, 1.0)
    barrier = weight[:, None] * (evaluation.slopes / positive_margins[..., None]).sum(axis=1)
    worst = evaluation.margins.argmin(axis=1)[:, None, None]
    worst_slope = jnp.take_along_axis(evaluation.slopes, worst, axis=1)[:, 0]
    return jnp.nan_to_num(select(_is_admissible(evaluation), evaluation.gradient + barrier, worst_slope))


def _is_improvement(c: AscentState, trial: Evaluation) -> Bool[Array, " start"]:
    """Return a mask of the trials that are improvements.

    If the current point is admissible, the trial must be admissible and have a higher merit. If it is not, the smallest
    margin of the trial must be larger.
    """
    before, after = (evaluation.margins.min(axis=1) for evaluation in (c.evaluation, trial))
    gain = trial.value - c.evaluation.value
    # The barrier difference is computed as log(after/before), without the cancellation of log(after) - log(before).
    ratio = jnp.where((c.evaluation.margins > 0) & (trial.margins > 0), trial.margins / c.evaluation.margins, 1.0)
    gain = gain + c.weight * jnp.log(ratio).sum(axis=1)
    return jnp.where(before > 0, (after > 0) & (gain > 0), after > before)


def _shorten_step(problem: _Problem, step, evaluation: Evaluation) -> Float[Array, "start variable"]:
    """Return the step, shortened to the radius of the box and to a share of the way to the linearised constraints."""
    closing = -(evaluation.slopes * step[:, None]).sum(axis=2)
    limited = (evaluation.margins > 0) & (closing > 0)
    # After this share of the step each linearised margin still has at least 1 - max_approach of its value.
    share = jnp.where(
        limited, problem.settings.max_approach * evaluation.margins / jnp.where(limited, closing, 1.0), 1.0
    )
    radius = problem.box.radius
    share = jnp.minimum(share.min(axis=1), radius / jnp.maximum(jnp.abs(step).max(axis=1), radius))
    return jnp.minimum(share, 1.0)[:, None] * step
