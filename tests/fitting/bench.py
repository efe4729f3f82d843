"""Simulated measurements of known devices, with errors."""

import dataclasses
from typing import NamedTuple

import numpy as np

import vijax

SIDES = vijax.Harvester(s=0.02, omega=10.0, A=3.0, omega0=vijax.Sides(60.0, 90.0), r=vijax.Sides(0.6, 0.5), beta=0.01)


class Measured(NamedTuple):
    """Measured impacts: times [s], sides, speeds [m/s]."""

    times: np.ndarray
    sides: np.ndarray
    speeds: np.ndarray


def measured(device, periods, *, excitation=None, wall="soft", skip=10, error=0.0, seed=0, start=(0.01, -0.4)):
    """Simulate a device; return its impacts with errors of the times [s]."""
    run = vijax.trajectory(device.pair(wall), *start, periods, excitation=excitation)
    selection = slice(skip, int(run.filled))
    n, t, side, v = (np.asarray(getattr(run.impacts, name))[selection] for name in ("n", "t", "side", "v_in"))
    times = (2.0 * n + t) * np.pi / float(device.omega)
    times = times + error * np.random.default_rng(seed).normal(size=times.size)
    return Measured(times, side.astype(float), np.abs(v) * float(device.speed_unit))


def with_faults(times, sides, missed=(), false=()):
    """Remove impacts and add false impacts: after an impact, at a part of the interval to the next impact, on a side.

    Returns:
        Times, sides, and the indices of the false impacts.
    """
    remaining = np.delete(np.arange(times.size), missed)
    added = np.array([times[k] + part * (times[k + 1] - times[k]) for k, part, _ in false])
    all_times = np.append(times[remaining], added)
    order = np.argsort(all_times)
    walls = np.append(sides[remaining], [side for *_, side in false])
    return all_times[order], walls[order], np.flatnonzero(order >= remaining.size)


def measured_with_restitution(device, count, restitution, *, error=0.0, seed=0, skip=10):
    """Return the impacts of a device with restitution as a function of the impact speed [m/s]."""
    half, unit = float(device.pair().d) / 2, float(device.speed_unit)
    n, t, side, v = 0, 0.3, 1.0, 0.4
    impacts = []
    for _ in range(count + skip):
        r = restitution(abs(v) * unit)
        pair = dataclasses.replace(device, r=r).pair()
        run = vijax.trajectory(pair, side * half, v, 8, t, max_impacts=1)
        impacts.append((2 * n + t, side, abs(v) * unit))
        further, t, side, v = (np.asarray(getattr(run.impacts, name))[0].item() for name in ("n", "t", "side", "v_in"))
        n, side = n + further, float(side)
    times, sides, speeds = np.array(impacts[skip:]).T
    times = times * np.pi / float(device.omega) + error * np.random.default_rng(seed).normal(size=count)
    return Measured(times, sides, speeds)
