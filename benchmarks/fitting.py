"""Are the errors that `vijax.fit` tells right, and what does a fit cost?

    python benchmarks/fitting.py                # 100 random devices, 202 impacts each
    python benchmarks/fitting.py --devices 10
    python benchmarks/fitting.py --impacts 60

Devices have d, kappa, r and gamma of their own; the search for kappa and r begins a tenth off (kappa by a factor, r by
a tenth of 1, one standard deviation). Times are off by 1e-3 of a forcing period. One line a figure: how many truths are
within two standard errors (95 of 100 are expected), and the root of the mean square error in standard errors; likewise
how many slopes of the test of constancy; which devices have values that are not told, or others that fit as well; and
seconds: of the first fit, which compiles, and of others.
"""

import argparse
import statistics
import time
from typing import NamedTuple

import jax
import numpy as np

import vijax
from benchmarks.orbits import say
from vijax.fitting.fitted import Fit
from vijax.model.device import with_pair

_UNKNOWN = "kappa", "r"
_ERROR = 2e-3  # of a time, in half forcing periods: 1e-3 periods
_OFF = 0.1  # by how much the search begins off
_TRANSIENT = 60  # impacts before the first that is timed


class Bench(NamedTuple):
    """A device by its numbers, and its impacts."""

    truth: dict[str, float]
    times: np.ndarray
    sides: np.ndarray


def bench(rng: np.random.Generator, impacts: int) -> Bench:
    """Draw a device that has so many impacts, and time them; a half period of the default device is one second."""
    while True:
        truth = {
            "d": float(np.exp(rng.uniform(np.log(0.12), np.log(0.6)))),
            "kappa": float(np.exp(rng.uniform(np.log(5), np.log(80)))),
            "r": float(rng.uniform(0.3, 0.85)),
            "gamma": float(rng.uniform(-0.15, 0.15)),
        }
        run = vijax.trajectory(vijax.impact_pair(**truth), 0.01, -0.4, 150, max_impacts=1000)
        kept = slice(_TRANSIENT, min(int(run.filled), _TRANSIENT + impacts))
        n, t, side = (np.asarray(getattr(run.impacts, name))[kept] for name in ("n", "t", "side"))
        if n.size >= min(impacts, 120):
            times = 2.0 * n + t + _ERROR * rng.standard_normal(n.size)
            return Bench(truth, times, side.astype(float))


def fitted(rng: np.random.Generator, measured: Bench) -> Fit:
    """Fit a device from a guess that is off."""
    guess = dict(measured.truth)
    guess["kappa"] *= float(np.exp(_OFF * rng.standard_normal()))
    guess["r"] = float(np.clip(guess["r"] + _OFF * rng.standard_normal(), 0.1, 0.95))
    device = jax.tree.map(float, with_pair(vijax.Harvester(), vijax.impact_pair(**guess)))
    return vijax.fit(measured.times, measured.sides, timing_error=_ERROR, device=device, unknown=_UNKNOWN)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, default=100)
    parser.add_argument("--impacts", type=int, default=202)
    asked = parser.parse_args()
    pulls: list[list[float]] = []
    seconds: list[float] = []
    slopes: list[float] = []
    untold: list[int] = []
    several: list[int] = []
    none: list[int] = []
    for seed in range(asked.devices):
        rng = np.random.default_rng(seed)
        measured = bench(rng, asked.impacts)
        begun = time.perf_counter()
        found = fitted(rng, measured)
        seconds.append(time.perf_counter() - begun)
        pulls.append([(found.values[name] - measured.truth[name]) / found.stderr[name] for name in _UNKNOWN])
        slopes.append(found.constancy.slope / found.constancy.stderr)
        for kept, is_so in ((untold, found.untold), (several, found.alternatives), (none, not found.converged)):
            kept.extend([seed] * bool(is_so))
    each = np.array(pulls)
    for name, column in zip(_UNKNOWN, each.T, strict=True):
        within = int((np.abs(column) <= 2).sum())
        told = column[column != 0]
        size = float(np.sqrt(np.mean(told**2)))
        say(f"{name}: within two standard errors, mean square error", f"{within} of {len(each)}, {size:.2f}")
    steady = int((np.abs(slopes) <= 2).sum())
    say("slope of r over speed, which has none: within two standard errors", f"{steady} of {len(each)}")
    say("devices of which a value is not told", str(untold))
    say("devices beside which others fit as well", str(several))
    say("devices not found", str(none))
    say("seconds of the first fit, of others", f"{seconds[0]:.1f}, {statistics.median(seconds[1:] or seconds):.2f}")


if __name__ == "__main__":
    main()
