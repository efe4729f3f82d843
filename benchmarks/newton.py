"""Would a library's root finder do for multiple shooting: is optimistix faster than `shooting.newton`, or surer?

    python benchmarks/newton.py

From the same guesses, 256 at once, one compiled call each, by the Jacobian that ours uses: Newton without damping and
Powell's dogleg, with the elimination that ours uses and with LAPACK's. LAPACK is shown for what it would give: two
programs that call it from two threads can stop each other (`linear_solve`). Times are medians of rounds taken in turn.
"Found" are guesses from which a possible orbit is reached, to a residual of 1e-9. Of a printout, two cores:

    soft RL, anywhere              ours                            37.80 ms, 1.00 times ours; found 136 of 256
    soft RL, anywhere              optimistix Newton               48.12 ms, 1.23 times ours; found 94 of 256
    soft RL, anywhere              optimistix Dogleg               58.48 ms, 1.54 times ours; found 137 of 256
    11 impacts, near               ours                           103.65 ms, 1.00 times ours; found 256 of 256
    11 impacts, near               optimistix Newton              114.55 ms, 1.08 times ours; found 256 of 256
    11 impacts, near               optimistix Newton by LAPACK     39.28 ms, 0.37 times ours; found 256 of 256
"""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
from jax.flatten_util import ravel_pytree

import vijax
from vijax.model.pair import impact_pair
from vijax.orbits import shooting
from vijax.orbits.periodic import guessed
from vijax.runtime import linear_solve

GUESSES, ROUNDS = 256, 7
D, KAPPA, R = 0.18, 40.0, 0.5
FASTEST = 1.5  # speed of a random guess
OFF = 1e-3  # how far knots near an orbit are off, relative
TOLERANCE, ITERATIONS = 1e-9, 80

Rows = tuple[Any, shooting.Sequence, jax.Array]


class Elimination(lineax.AbstractLinearSolver):
    """Our elimination, as lineax wants it."""

    def init(self, operator, options):
        """Take the matrix."""
        return operator.as_matrix()

    def compute(self, state, vector, options):
        """Solve."""
        flat, unflatten = ravel_pytree(vector)
        return unflatten(linear_solve.solve(state, flat)), lineax.RESULTS.successful, {}

    def transpose(self, state, options):
        """Turn the matrix."""
        return state.T, options

    def conj(self, state, options):
        """Leave real numbers as they are."""
        return state, options

    def assume_full_rank(self):
        """Say that singular systems are not looked after."""
        return True


@jax.custom_jvp
def gap(knots, at):
    """Compute what is missing to an orbit, with the derivatives that ours uses."""
    return shooting.gap(*at, knots.reshape(-1, 3))


@gap.defjvp
def _gap(primals, tangents):
    knots, at = primals
    linear = shooting.linearise(*at, knots.reshape(-1, 3))
    return linear.gap, linear.slope @ tangents[0]


def theirs(solver: Any) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """Search as `shooting.newton` does, by a solver of optimistix."""

    def one(pair, sequence, knots):
        found = optimistix.root_find(
            gap, solver, knots.reshape(-1), args=(pair, sequence), max_steps=ITERATIONS, throw=False
        ).value.reshape(knots.shape)
        residual = jnp.abs(shooting.gap(pair, sequence, found)).max()
        return found, jnp.where(shooting.possible(pair, sequence, found), residual, jnp.inf)

    return jax.vmap(one)


def anywhere(walls: list[int], kappa: float | None) -> Rows:
    """Guess orbits of a sequence at random, as `orbit_search.search` does."""
    draw, count = np.random.default_rng(0), len(walls)
    pair = impact_pair(D, kappa, R)
    gaps = draw.dirichlet(np.ones(count), GUESSES) * count
    t = draw.uniform(0, 2, (GUESSES, 1)) + np.cumsum(gaps, axis=1) - gaps[:, :1]
    free = np.zeros(()) if kappa is None else np.pi / np.asarray(pair.omega1)
    knots = np.stack([t, draw.uniform(0, FASTEST, t.shape), np.minimum(free, 0.5 * gaps)], axis=-1)
    side, span = np.broadcast_to(np.asarray(walls, np.int32), t.shape), np.full(GUESSES, float(count))
    sequence, near = guessed(side, span, np.zeros(GUESSES, bool), knots)
    return jax.tree.map(jnp.asarray, (jax.tree.map(lambda x: np.broadcast_to(x, GUESSES), pair), sequence, near))


def near_by(d: float, period: int) -> Rows:
    """Guess near an attractor."""
    orbit = vijax.orbits_from_states(impact_pair(d, KAPPA, R), 0.02, 0.3, period=period, settle=300)
    pair, sequence, knots = jax.tree.map(
        lambda x: np.repeat(np.asarray(x), GUESSES, axis=0), (orbit.pair, orbit.sequence, orbit.knots)
    )
    off = 1 + OFF * np.random.default_rng(1).normal(size=knots.shape)
    return jax.tree.map(jnp.asarray, (pair, sequence, np.nan_to_num(knots) * off))


SOLVERS: dict[str, Callable[..., Any]] = {
    "ours": shooting.newton,
    "optimistix Newton": theirs(optimistix.Newton(TOLERANCE, TOLERANCE, linear_solver=Elimination())),
    "optimistix Dogleg": theirs(optimistix.Dogleg(TOLERANCE, TOLERANCE, linear_solver=Elimination())),
    "optimistix Newton by LAPACK": theirs(optimistix.Newton(TOLERANCE, TOLERANCE)),
}


def compared(scene: str, rows: Rows) -> None:
    """Print time and success of every solver."""
    calls = {name: jax.jit(search) for name, search in SOLVERS.items()}
    found = {name: int((np.asarray(call(*rows)[1]) < TOLERANCE).sum()) for name, call in calls.items()}
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            begun = time.perf_counter()
            jax.block_until_ready(call(*rows))
            seconds[name].append(time.perf_counter() - begun)
    for name, taken in seconds.items():
        ratio = statistics.median(a / b for a, b in zip(taken, seconds["ours"], strict=True))
        milli = 1e3 * statistics.median(taken)
        print(f"{scene:30} {name:28} {milli:8.2f} ms, {ratio:4.2f} times ours; found {found[name]} of {GUESSES}")


def main() -> None:
    """Print the figures."""
    compared("soft RL, anywhere", anywhere([1, -1], KAPPA))
    compared("rigid RL, anywhere", anywhere([1, -1], None))
    compared("soft RLRL, anywhere", anywhere([1, -1, 1, -1], KAPPA))
    compared("2 impacts, near", near_by(0.2, 1))
    compared("11 impacts, near", near_by(0.12, 4))


if __name__ == "__main__":
    main()
