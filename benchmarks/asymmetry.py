"""Does it pay to make the two walls differ, and what do walls that may differ cost?

    python benchmarks/asymmetry.py               # every part
    python benchmarks/asymmetry.py --only fixed  # or free, cost
    python benchmarks/asymmetry.py --starts 64

One line a figure. P is what a cell harvests on average over its starts, at the electrical values of Tables I and II.

- fixed: of walls of kappa 100, how much more r = 0.5 -+ x harvests than r = 0.5 at both, over d and x.
- free: the best admissible P over kappa at every d, of equal walls; how much more walls of two kappa give, or of two r,
  on level ground and on an incline; and what part of the starts ends on the best attractor there.
- cost: seconds of the default plane by the program of walls that may differ over those of equal ones, in pairs.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import vijax
from benchmarks.accelerator import plane
from benchmarks.orbits import say

GAMMA = 0.1
_D = np.linspace(0.08, 0.34, 14)
_KAPPA = np.geomspace(30, 130, 80)
_OFF = np.linspace(0.05, 0.45, 9)
_PAIRS = 7


def fixed(starts: int) -> None:
    """Compare restitutions that differ with equal ones, the stiffness as it is."""
    equal = vijax.sweep(d=_D, kappa=100.0, starts=starts)
    gains = [vijax.sweep(d=_D, kappa=100.0, r_left=0.5 - x, r_right=0.5 + x, starts=starts).P / equal.P for x in _OFF]
    gain = np.array([one.values for one in gains])
    off, place = np.unravel_index(gain.argmax(), gain.shape)
    say("kappa 100, level: most that two r give over one", f"{gain.max():.3f} at d {_D[place]:.2f}, x {_OFF[off]:.2f}")
    say("d at which some x gives more than 1 % more, of", f"{int((gain.max(axis=0) > 1.01).sum())}, {_D.size}")


def _best(starts: int, **axes: Any) -> tuple[np.ndarray, np.ndarray]:
    """Find the largest admissible P of every d, and the share of the best attractor there."""
    found = vijax.sweep(d=_D, starts=starts, **axes)
    P = found.P.where(found.admissible, 0.0).values.reshape(_D.size, -1)
    share = found.best_share.values.reshape(_D.size, -1)
    rows, at = np.arange(_D.size), P.argmax(axis=1)
    return P[rows, at], share[rows, at]


def _told(what: str, gain: np.ndarray, share: np.ndarray) -> None:
    say(f"{what}: least, median, most", ", ".join(f"{x:.3f}" for x in (gain.min(), np.median(gain), gain.max())))
    say(f"{what}: least share of the starts on the best attractor", f"{share.min():.2f}")


def free(starts: int) -> None:
    """Compare the best admissible designs of equal walls and of walls that differ."""
    for gamma in (0.0, GAMMA):
        ground = "level" if gamma == 0 else f"gamma {gamma}"
        equal, _ = _best(starts, kappa=_KAPPA, gamma=gamma)
        two, share = _best(starts, kappa_left=_KAPPA, kappa_right=_KAPPA, gamma=gamma)
        _told(f"{ground}, best P of two kappa over one", two / equal, share)
        every = [
            _best(starts, kappa=_KAPPA, r_left=0.5 - x, r_right=0.5 + x, gamma=gamma)
            for x in (_OFF if gamma == 0 else [*-_OFF, *_OFF])
        ]
        which = np.argmax([P for P, _ in every], axis=0)
        best, share = (np.array([one[part] for one in every])[which, np.arange(_D.size)] for part in (0, 1))
        _told(f"{ground}, best P of two r over one", best / equal, share)


def in_turn(ways: dict[str, Callable[[], Any]], pairs: int) -> dict[str, list[float]]:
    """Time ways to do something in turn, so often each, after a first time that compiles; give the seconds of each."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(pairs + 1):
        for name, way in ways.items():
            begun = time.perf_counter()
            way()
            if turn:
                seconds[name].append(time.perf_counter() - begun)
    return seconds


def cost(starts: int) -> None:
    """Compare the program of walls that may differ with that of equal ones, on the same cells."""
    axes = plane(128)
    r = axes.pop("r")
    ways: dict[str, Callable[[], Any]] = {
        "equal": lambda: vijax.sweep(**axes, r=r),
        "apart": lambda: vijax.sweep(**axes, r_left=r, r_right=r),
    }
    seconds = in_turn(ways, _PAIRS)
    ratio = statistics.median(b / a for a, b in zip(*seconds.values(), strict=True))
    say(
        "128 x 128 cells with P, seconds of equal walls, of walls that may differ, median ratio of pairs",
        ", ".join([*(f"{statistics.median(some):.3f}" for some in seconds.values()), f"{ratio:.3f}"]),
    )


PARTS = {"fixed": fixed, "free": free, "cost": cost}


def main() -> None:
    """Print every figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=PARTS, nargs="+", default=list(PARTS))
    parser.add_argument("--starts", type=int, default=16)
    given = parser.parse_args()
    for name in given.only:
        PARTS[name](given.starts)


if __name__ == "__main__":
    main()
