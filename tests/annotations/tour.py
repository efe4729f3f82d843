"""A small run of every kind with all annotations checked: `python tests/annotations/tour.py [kind ...]`.

The import hook of jaxtyping checks the annotations of a package that is imported under it. The check runs in a separate
process (`test_annotations`), because tests of validation pass wrong types on purpose and would fail under the hook.
Programs that are read from the disk are not traced and therefore not checked.
"""

import sys
from contextlib import suppress
from pathlib import Path

from beartype import BeartypeConf, beartype
from jaxtyping import TypeCheckError, install_import_hook

_checked = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is accepted as a float, as in mypy


def checked(function):
    """Return the function with checked annotations; return a nested function unchanged.

    A nested function would be decorated at every call, which takes twice the time of all other checks.
    """
    return function if "<locals>" in function.__qualname__ else _checked(function)


def planes(vijax, np, jax):
    """Inclined and rigid maps, basins on level ground."""
    vijax.sweep(d=[0.1, 0.2], kappa=10, r=0.5, gamma=[0.05, 0.3], periods=40)
    # The number of variants gives a program that `maps/test_compare` compiles, too.
    vijax.sweep(d=[0.1, 0.2], wall="rigid", r=0.5, periods=40, A=[1.0, 1.5, 2.0, 2.5, 3.0], omega=3.0)
    vijax.basins(d=0.2, kappa=3.0, r=0.5, u0=[0.0, 0.05], v0=[0.1, 0.3], periods=60)


def more_planes(vijax, np, jax):
    """A refined map, a stepping engine, a comparison, basin fractions, an orbit diagram."""
    plane = {"d": np.linspace(0.1, 0.3, 3), "kappa": [5.0, 50.0], "r": 0.5}
    vijax.sweep(d=0.2, kappa=5.0, periods=4, method="rk4")
    vijax.sweep(**plane | {"d": np.linspace(0.1, 0.3, 9)}, periods=20, refine=1)
    vijax.compare(**plane, periods=40, tolerance=0.1)
    vijax.basin_fractions(d=0.2, kappa=3.0, r=0.5, starts=4, periods=60)
    vijax.orbit_diagram(
        along="d", values=[0.2, 0.21], kappa=[5.0, 50.0], r=0.5, direction="both", periods=40, recorded_periods=4
    )


def motions(vijax, np, jax):
    """Trajectories by every engine, a batch of trajectories, and the derivative of a trajectory."""
    pair = vijax.impact_pair(0.2, 5.0, 0.5)
    for method in ("exact", "ode", "rk4"):
        vijax.trajectory(pair, 0.0, 0.3, periods=5, method=method)
    vijax.trajectory(vijax.impact_pair([0.2, 0.3], None, 0.5), np.array([0.0, 0.1]), 0.3, periods=5, t0=0.5)
    # `runtime/test_programs` compiles the same program.
    jax.grad(lambda v: vijax.trajectory(pair, 0.0, v, periods=5).states.u[-1])(0.3)


def orbits(vijax, np, jax):
    """A branch through a fold, a family, orbits from states, a steady state and its gradient."""
    solutions = vijax.find_orbits(vijax.impact_pair(0.19, None, 0.5), "RLL", guesses=32)
    (branch,) = vijax.follow_orbits(solutions[:1], "d", (0.18, 0.21), direction="up")
    vijax.branch_dataset([branch])
    folds = [point for point in branch.points if point.kind == "fold"]
    vijax.curve_dataset(vijax.follow_curves(folds, "d", {"d": (0.1, 0.3), "r": (0.4, 0.6)}, max_points=4))
    branches = vijax.follow_families(solutions[:1], "d", (0.185, 0.195), points=4)
    vijax.limit_points(branches)
    u, v = np.array([[0.0, 0.1], [0.3, -0.2]])
    solutions = vijax.orbits_from_states(vijax.impact_pair(0.2, 5.0, 0.5), u, v, settle=40)
    vijax.orbit_impacts(solutions), vijax.orbit_labels(solutions), vijax.orbit_path(solutions)
    device = vijax.Harvester(omega=5 * np.pi, s=0.25, A=2.0)
    vijax.orbit_power(solutions, device)
    jax.jacrev(lambda pair: vijax.steady(device, solutions[0], pair=pair).P)(
        jax.tree.map(lambda x: x[0], solutions.pair)
    )


def designs(vijax, np, jax):
    """A design and its statistics under tolerances."""
    device = vijax.Harvester(omega=10 * np.pi, s=0.006, A=3.0, V=1700.0)
    best = vijax.optimise(device, survey_points=128, starts=1, max_impacts=2).best
    vijax.tolerance_statistics(best, [vijax.Tolerance("omega0", 0.05)])


KINDS = {kind.__name__: kind for kind in (planes, more_planes, motions, orbits, designs)}


def main(names):
    """Run the named kinds, or all kinds."""
    with install_import_hook("vijax", f"{Path(__file__).stem}.{checked.__name__}"):
        import jax
        import numpy as np

        import vijax.public
        from vijax.model import flow
        from vijax.runtime.compilation import export_cache
    with suppress(TypeCheckError):
        flow.wrap_phase(0.5)  # 0.5 is not an array
        raise SystemExit("annotations are not checked")
    # All programs are traced here and none is stored; JAX may still read their compiled code from its disk cache.
    export_cache._read = export_cache._write = lambda *_: None
    for name in names or KINDS:
        KINDS[name](vijax, np, jax)


if __name__ == "__main__":
    main(sys.argv[1:])
