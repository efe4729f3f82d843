"""Is a library's root finder suitable for multiple shooting: is optimistix faster or surer than `shooting.newton`?

    python benchmarks/newton.py

From the same guesses, 256 at once, one compiled call each, with the Jacobian of vijax: Newton without damping and
Powell's dogleg, with the elimination of vijax and with LAPACK. LAPACK is shown for its potential only: programs that
call it from two threads can block each other (`linear_solve`). Times are medians of rounds taken in turn. "Found"
counts guesses that converge to a possible orbit with a residual of 1e-9. Part of a printout, two cores:

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
from vijax.orbits.periodic import make_guess
from vijax.runtime.numerics import linear_solve

GUESSES, ROUNDS = 256, 7
D, KAPPA, R = 0.18, 40.0, 0.5
FASTEST = 1.5  # speed of a random guess
OFF = 1e-3  # relative offset of the impact unknowns near an orbit
TOLERANCE, ITERATIONS = 1e-9, 80

Rows = tuple[Any, shooting.Sequence, jax.Array]


class Elimination(lineax.AbstractLinearSolver):
    """Elimination of vijax, with the interface of lineax."""

    def init(self, operator, options):
        """Return the matrix."""
        return operator.as_matrix()

    def compute(self, state, vector, options):
        """Solve the linear system."""
        flat, unflatten = ravel_pytree(vector)
        return unflatten(linear_solve.solve(state, flat)), lineax.RESULTS.successful, {}

    def transpose(self, state, options):
        """Transpose the matrix."""
        return state.T, options

    def conj(self, state, options):
        """Return the state unchanged, as all numbers are real."""
        return state, options

    def assume_full_rank(self):
        """Return True: singular systems get no special treatment."""
        return True


@jax.custom_jvp
def orbit_residual(impact_unknowns, at):
    """Return the residual of an orbit, with the derivatives of vijax."""
    return shooting.residuals(*at, impact_unknowns.reshape(-1, 3))


@orbit_residual.defjvp
def _orbit_residual_jvp(primals, tangents):
    impact_unknowns, at = primals
    linear = shooting.linearise(*at, impact_unknowns.reshape(-1, 3))
    return linear.residuals, linear.slope @ tangents[0]


def optimistix_search(solver: Any) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """Return a search like `shooting.newton` by a solver of optimistix."""

    def search(pair, sequence, impact_unknowns):
        solution = optimistix.root_find(
            orbit_residual,
            solver,
            impact_unknowns.reshape(-1),
            args=(pair, sequence),
            max_steps=ITERATIONS,
            throw=False,
        ).value.reshape(impact_unknowns.shape)
        residual = jnp.abs(shooting.residuals(pair, sequence, solution)).max()
        return solution, jnp.where(shooting.has_positive_durations(pair, sequence, solution), residual, jnp.inf)

    return jax.vmap(search)


def anywhere(walls: list[int], kappa: float | None) -> Rows:
    """Return random guesses of orbits of a sequence, as `orbit_search.find_orbits` makes them."""
    draw, count = np.random.default_rng(0), len(walls)
    pair = impact_pair(D, kappa, R)
    intervals = draw.dirichlet(np.ones(count), GUESSES) * count
    t = draw.uniform(0, 2, (GUESSES, 1)) + np.cumsum(intervals, axis=1) - intervals[:, :1]
    free_duration = np.zeros(()) if kappa is None else np.pi / np.asarray(pair.omega1)
    impact_unknowns = np.stack(
        [t, draw.uniform(0, FASTEST, t.shape), np.minimum(free_duration, 0.5 * intervals)], axis=-1
    )
    side, span = np.broadcast_to(np.asarray(walls, np.int32), t.shape), np.full(GUESSES, float(count))
    sequence, near = make_guess(side, span, np.zeros(GUESSES, bool), impact_unknowns)
    return jax.tree.map(jnp.asarray, (jax.tree.map(lambda x: np.broadcast_to(x, GUESSES), pair), sequence, near))


def near_by(d: float, period: int) -> Rows:
    """Return guesses near an attractor."""
    orbit = vijax.orbits_from_states(impact_pair(d, KAPPA, R), 0.02, 0.3, period=period, settle=300)
    pair, sequence, impact_unknowns = jax.tree.map(
        lambda x: np.repeat(np.asarray(x), GUESSES, axis=0), (orbit.pair, orbit.sequence, orbit.impact_unknowns)
    )
    factors = 1 + OFF * np.random.default_rng(1).normal(size=impact_unknowns.shape)
    return jax.tree.map(jnp.asarray, (pair, sequence, np.nan_to_num(impact_unknowns) * factors))


SOLVERS: dict[str, Callable[..., Any]] = {
    "ours": shooting.newton,
    "optimistix Newton": optimistix_search(optimistix.Newton(TOLERANCE, TOLERANCE, linear_solver=Elimination())),
    "optimistix Dogleg": optimistix_search(optimistix.Dogleg(TOLERANCE, TOLERANCE, linear_solver=Elimination())),
    "optimistix Newton by LAPACK": optimistix_search(optimistix.Newton(TOLERANCE, TOLERANCE)),
}


def compare_solvers(scene: str, rows: Rows) -> None:
    """Print time and success of every solver."""
    calls = {name: jax.jit(search) for name, search in SOLVERS.items()}
    successes = {name: int((np.asarray(call(*rows)[1]) < TOLERANCE).sum()) for name, call in calls.items()}
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call(*rows))
            seconds[name].append(time.perf_counter() - start)
    for name, times in seconds.items():
        ratio = statistics.median(a / b for a, b in zip(times, seconds["ours"], strict=True))
        milli = 1e3 * statistics.median(times)
        print(f"{scene:30} {name:28} {milli:8.2f} ms, {ratio:4.2f} times ours; found {successes[name]} of {GUESSES}")


def main() -> None:
    """Print the figures."""
    compare_solvers("soft RL, anywhere", anywhere([1, -1], KAPPA))
    compare_solvers("rigid RL, anywhere", anywhere([1, -1], None))
    compare_solvers("soft RLRL, anywhere", anywhere([1, -1, 1, -1], KAPPA))
    compare_solvers("2 impacts, near", near_by(0.2, 1))
    compare_solvers("11 impacts, near", near_by(0.12, 4))


if __name__ == "__main__":
    main()
