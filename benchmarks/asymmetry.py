"""Do unequal walls harvest more than equal ones, and how much more does their program cost?

    python benchmarks/asymmetry.py               # every part
    python benchmarks/asymmetry.py --only fixed  # or free, cost
    python benchmarks/asymmetry.py --starts 64

One line a figure. P is the average over a cell's starts, at the electrical values of Tables I and II.

- fixed: at kappa 100, the gain of r = 0.5 -+ x over r = 0.5 at both walls, over d and x.
- free: the best admissible P over kappa at every d, of equal walls; the gain of walls with two kappa, or two r, on
  level ground and on an incline; and the fraction of the starts that end on the best attractor there.
- cost: ratio of the seconds of the default plane, by the program of unequal walls over the program of equal ones.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import vijax
from benchmarks.accelerator import plane
from benchmarks.orbits import print_figure

GAMMA = 0.1
_D = np.linspace(0.08, 0.34, 14)
_KAPPA = np.geomspace(30, 130, 80)
_OFF = np.linspace(0.05, 0.45, 9)
_PAIRS = 7


def fixed(starts: int) -> None:
    """Compare unequal restitutions with equal ones at fixed stiffness."""
    equal = vijax.sweep(d=_D, kappa=100.0, starts=starts)
    ratios = [vijax.sweep(d=_D, kappa=100.0, r_left=0.5 - x, r_right=0.5 + x, starts=starts).P / equal.P for x in _OFF]
    gain = np.array([ratio.values for ratio in ratios])
    offset_index, gap_index = np.unravel_index(gain.argmax(), gain.shape)
    print_figure(
        "kappa 100, level: most that two r give over one",
        f"{gain.max():.3f} at d {_D[gap_index]:.2f}, x {_OFF[offset_index]:.2f}",
    )
    print_figure("d at which some x gives more than 1 % more, of", f"{int((gain.max(axis=0) > 1.01).sum())}, {_D.size}")


def _best(starts: int, **axes: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest admissible P at every d, and the share of the best attractor there."""
    dataset = vijax.sweep(d=_D, starts=starts, **axes)
    P = dataset.P.where(dataset.admissible, 0.0).values.reshape(_D.size, -1)
    share = dataset.best_share.values.reshape(_D.size, -1)
    rows, best_column = np.arange(_D.size), P.argmax(axis=1)
    return P[rows, best_column], share[rows, best_column]


def _print_gain(quantity: str, gain: np.ndarray, share: np.ndarray) -> None:
    print_figure(
        f"{quantity}: least, median, most", ", ".join(f"{x:.3f}" for x in (gain.min(), np.median(gain), gain.max()))
    )
    print_figure(f"{quantity}: least share of the starts on the best attractor", f"{share.min():.2f}")


def free(starts: int) -> None:
    """Compare the best admissible designs of equal and of unequal walls."""
    for gamma in (0.0, GAMMA):
        case = "level" if gamma == 0 else f"gamma {gamma}"
        equal, _ = _best(starts, kappa=_KAPPA, gamma=gamma)
        unequal, share = _best(starts, kappa_left=_KAPPA, kappa_right=_KAPPA, gamma=gamma)
        _print_gain(f"{case}, best P of two kappa over one", unequal / equal, share)
        candidates = [
            _best(starts, kappa=_KAPPA, r_left=0.5 - x, r_right=0.5 + x, gamma=gamma)
            for x in (_OFF if gamma == 0 else [*-_OFF, *_OFF])
        ]
        best_index = np.argmax([P for P, _ in candidates], axis=0)
        best, share = (
            np.array([candidate[part] for candidate in candidates])[best_index, np.arange(_D.size)] for part in (0, 1)
        )
        _print_gain(f"{case}, best P of two r over one", best / equal, share)


def in_turn(alternatives: dict[str, Callable[[], Any]], pairs: int) -> dict[str, list[float]]:
    """Time alternatives in turn, after a first round that compiles; return the seconds of each."""
    seconds: dict[str, list[float]] = {name: [] for name in alternatives}
    for round_number in range(pairs + 1):
        for name, alternative in alternatives.items():
            start = time.perf_counter()
            alternative()
            if round_number:
                seconds[name].append(time.perf_counter() - start)
    return seconds


def cost(starts: int) -> None:
    """Compare the program of unequal walls with the program of equal ones, on the same cells."""
    axes = plane(128)
    r = axes.pop("r")
    alternatives: dict[str, Callable[[], Any]] = {
        "equal": lambda: vijax.sweep(**axes, r=r),
        "apart": lambda: vijax.sweep(**axes, r_left=r, r_right=r),
    }
    seconds = in_turn(alternatives, _PAIRS)
    ratio = statistics.median(b / a for a, b in zip(*seconds.values(), strict=True))
    print_figure(
        "128 x 128 cells with P, seconds of equal walls, of walls that may differ, median ratio of pairs",
        ", ".join([*(f"{statistics.median(times):.3f}" for times in seconds.values()), f"{ratio:.3f}"]),
    )


PARTS = {"fixed": fixed, "free": free, "cost": cost}


def main() -> None:
    """Print every figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=PARTS, nargs="+", default=list(PARTS))
    parser.add_argument("--starts", type=int, default=16)
    options = parser.parse_args()
    for name in options.only:
        PARTS[name](options.starts)


if __name__ == "__main__":
    main()
