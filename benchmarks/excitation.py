"""How much time do excitations other than the sine take, how accurate are they, and how does noise change a map?

    python benchmarks/excitation.py               # every part
    python benchmarks/excitation.py --only cost   # or order, noise

One line a figure.

- cost: us a cell and period, on all cores, of a looped record with 64 samples a period, of the sine with noise of as
  many values, and of two harmonics; compared with the sine, and with numba's RK4 of 1,024 steps on the same record.
- order: convergence of the speeds of eight impacts under a sampled sine to the sine's.
- noise: for the level plane at 64 starts, the fraction of P that remains under noise, and of cells with more.
"""

import argparse
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np

import vijax
from benchmarks.accelerator import plane
from benchmarks.asymmetry import in_turn
from benchmarks.orbits import print_figure
from vijax import Harmonics, Noise, Waveform

SAMPLES, PERIODS, _PAIRS = 64, 100, 7
_LEVELS = (0.01, 0.03, 0.1)


def sampled_sine(samples: int) -> Waveform:
    """Return one period of the sine as a record."""
    return Waveform(np.cos(2 * np.pi * np.arange(samples) / samples), samples)


def cost() -> None:
    """Time runs of the default plane in turn."""
    from benchmarks import peers

    axes = plane(128)
    d, kappa = (x.ravel() for x in np.meshgrid(axes["d"], axes["kappa"], indexing="ij"))
    rough = Waveform(np.random.default_rng(1).normal(size=SAMPLES) / np.sqrt(2), SAMPLES)
    settings: dict[str, Any] = {"until": "window", "periods": PERIODS}

    def by_vijax(excitation: Any, outputs: list[str]) -> Callable[[], Any]:
        return lambda: vijax.sweep(**axes, **settings, excitation=excitation, outputs=outputs)

    def numba() -> Any:
        def forcing(t: np.ndarray) -> np.ndarray:
            return np.interp(t * SAMPLES / 2, np.arange(SAMPLES + 1), np.append(rough.values, rough.values[0]))

        return peers.rk4(d, kappa, 0.5, 0.05, -0.4, PERIODS, 1024, shaken=forcing)

    counts, energy = ["impacts_per_period"], ["P", "admissible"]
    noisy = Harmonics() + Noise(0.05, SAMPLES / 2)
    alternatives = {
        "sine, counts": by_vijax(None, counts),
        "record, counts": by_vijax(rough, counts),
        "record, P": by_vijax(rough, energy),
        "sine and noise, counts": by_vijax(noisy, counts),
        "two harmonics, counts": by_vijax(Harmonics([1.0, 0.3]), counts),
        "numba RK4, 1,024 steps, counts": numba,
    }
    seconds = in_turn(alternatives, _PAIRS)
    for name, times in seconds.items():
        ratio = statistics.median(b / a for a, b in zip(times, seconds["numba RK4, 1,024 steps, counts"], strict=True))
        us = statistics.median(times) / (d.size * PERIODS) * 1e6
        print_figure(f"{name}: us a cell and period, times as fast as numba", f"{us:.3f}, {ratio:.2f}")


def order() -> None:
    """Halve the sampling interval of a sine, and measure the speeds of impacts."""
    pair = vijax.impact_pair(0.2, np.array([8.0, 60.0, 400.0]), 0.3)
    exact = vijax.trajectory(pair, 0.05, -0.4, 6).impacts.v_in
    counts = 2 ** np.arange(6, 11)
    speeds = [vijax.trajectory(pair, 0.05, -0.4, 6, excitation=sampled_sine(int(n))).impacts.v_in for n in counts]
    errors = np.array([np.abs(v - exact)[:, :8].max(axis=1) for v in speeds])
    for n, row in zip(counts, errors, strict=True):
        print_figure(f"{n} samples a period: error of speeds at kappa 8, 60, 400", ", ".join(f"{x:.1e}" for x in row))
    slopes = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    print_figure("order at kappa 8, 60, 400", ", ".join(f"{x:.3f}" for x in slopes))


def noise() -> None:
    """Compare P of the level plane with and without noise."""
    axes: dict[str, Any] = {"d": np.geomspace(0.03, 10, 24), "kappa": np.geomspace(5, 400, 24), "r": 0.5}
    starts = np.linspace(-0.4, 0.4, 8)
    settings: dict[str, Any] = {"until": "window", "periods": 300, "transient": 100, "v0": starts, "outputs": ["P"]}
    noiseless = vijax.sweep(**axes, **settings)["P"].mean("v0")
    for level in _LEVELS:
        noisy = vijax.sweep(**axes, **settings, excitation=Harmonics() + Noise(level, 32))["P"].mean("v0")
        power_ratio = (noisy / noiseless).where(noiseless > 1e-9)
        for group, selected in (("all cells", power_ratio), ("d above 1", power_ratio.where(power_ratio.d > 1))):
            ratio = selected.values[np.isfinite(selected.values)]
            parts = ", ".join(f"{np.quantile(ratio, q):.3f}" for q in (0.1, 0.5, 0.9))
            print_figure(f"level {level}, {group}: P over the noiseless one, 10, 50 and 90 % of the cells", parts)
            print_figure(f"level {level}, {group}: cells that harvest more", f"{(ratio > 1).mean():.2f}")


PARTS = {"cost": cost, "order": order, "noise": noise}


def main() -> None:
    """Print every figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=PARTS, nargs="+", default=list(PARTS))
    for name in parser.parse_args().only:
        PARTS[name]()


if __name__ == "__main__":
    main()
