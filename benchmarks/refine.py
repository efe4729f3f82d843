"""How much of a plane does refinement compute, and how accurate are its filled cells?

    python benchmarks/refine.py                                # the default plane, 1024 x 1024, 3 levels
    python benchmarks/refine.py --plane r --points 256         # restitution over stiffness
    python benchmarks/refine.py --plane inclined --points 128  # gamma = 0.1

Both planes are computed in the same run, the full one first. P of an aperiodic cell is an average with an error; P is
compared where the full plane is periodic. The labels of coexisting attractors are speckled: a correct picture of the
full plane requires the computation of all cells with a neighbour of another label. Printout of the first, two cores, a
busy machine, programs compiled before:

    full                         115.7 s, 71.7 s of all cores together
    3 levels                     62.9 s, 34.6 s of all cores together
    computed                     19.75% of 1,048,576 cells
    forcing periods run          43.01% of the full plane's: cells on borders are the slow ones
    computed cells               equal bit for bit in 18 variables
    labels equal                 99.822% of all cells
    filled periodic              71.51% of all cells, P within 1% in 99.937% of them
    filled aperiodic             8.72% of all cells, P within 1% in 81.198% of them
    forced by labels             7.50% of all cells have a neighbour of another label
    speckles                     0.73% have none of their own
"""

import argparse
import os
import time
from typing import Any

import jax
import numpy as np

import vijax
from vijax.model.label import label

WITHIN = 0.01  # relative, of P
GOALS = "at most 25 % computed, labels equal in 99.3 % of all cells, P within 1 % in 99 % of the periodic filled ones"


def axes(plane: str, points: int) -> dict[str, Any]:
    """Return the axes of a plane; the first plane is the default of `scripts/grid.py`."""
    kappa = np.geomspace(3, 400, points)
    planes: dict[str, dict[str, Any]] = {
        "default": {"d": np.linspace(0.05, 0.3, points), "kappa": kappa},
        "r": {"r": np.linspace(0.1, 0.95, points), "kappa": kappa, "d": 0.2},
        "inclined": {"d": np.linspace(0.05, 0.3, points), "kappa": kappa, "gamma": 0.1},
    }
    return planes[plane]


def timed(**arguments: Any) -> tuple[Any, str]:
    """Time a sweep with its compilation; on a busy machine processor time is the fairer measure."""
    start, busy = time.perf_counter(), time.process_time()
    dataset = vijax.sweep(**arguments)
    return dataset, f"{time.perf_counter() - start:.1f} s, {time.process_time() - busy:.1f} s of all cores together"


def labels(dataset: Any) -> np.ndarray:
    """Return the labels of a plane; without gravity, mirror images have one label."""
    columns = (dataset[name].values for name in ("period", "impacts_left", "impacts_right", "status"))
    return label(*columns, merge_mirrors=float(dataset.gamma) == 0)


def like_neighbours(words: np.ndarray) -> np.ndarray:
    """Count the four neighbours with the label of each cell; outside of the plane the edge cells repeat."""
    padded = np.pad(words, 1, mode="edge")
    inner = slice(1, -1)
    sides = (padded[:-2, inner], padded[2:, inner], padded[inner, :-2], padded[inner, 2:])
    return sum((side == words).astype(int) for side in sides)


def report(full: Any, refined: Any) -> list[str]:
    """Return the figures, one line each."""
    words, refined_labels = labels(full), labels(refined)
    computed = refined.computed.values
    same = [
        np.array_equal(full[name].values[computed], refined[name].values[computed], equal_nan=True) for name in full
    ]
    same_label = like_neighbours(words)
    work = float(refined.periods_run.sum() / full.periods_run.sum())
    lines = [
        f"computed                     {computed.mean():.2%} of {computed.size:,} cells",
        f"forcing periods run          {work:.2%} of the full plane's: cells on borders are the slow ones",
        f"computed cells               {'equal bit for bit' if all(same) else 'DIFFER'} in {len(same)} variables",
        f"labels equal                 {(words == refined_labels).mean():.3%} of all cells",
    ]
    errors = abs(refined.P.values / full.P.values - 1)
    for name, kind in (("periodic", full.period.values > 0), ("aperiodic", full.period.values == 0)):
        cells = ~computed & kind
        share = f", P within {WITHIN:.0%} in {(errors[cells] <= WITHIN).mean():.3%} of them" if cells.any() else ""
        lines.append(f"filled {name:<21} {cells.mean():.2%} of all cells{share}")
    return [
        *lines,
        f"forced by labels             {(same_label < 4).mean():.2%} of all cells have a neighbour of another label",
        f"speckles                     {(same_label == 0).mean():.2%} have none of their own",
    ]


def main() -> None:
    """Run the full plane and the refined one and compare them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plane", default="default", choices=("default", "r", "inclined"))
    parser.add_argument("--points", type=int, default=1024, help="along each axis")
    parser.add_argument("--levels", type=int, default=3)
    options = parser.parse_args()
    arguments = axes(options.plane, options.points)
    print(f"{os.cpu_count()} cores, {jax.default_backend()}, JAX {jax.__version__}")
    full, seconds = timed(**arguments)
    print(f"full                         {seconds}")
    refined, seconds = timed(**arguments, refine=options.levels)
    print(f"{options.levels} levels                     {seconds}")
    print("\n".join(report(full, refined)))
    print(f"goals at 1024 x 1024: {GOALS}")


if __name__ == "__main__":
    main()
