"""Ensembles: samples in devices scattered about one design; all ensembles of a round are simulated in one call.

Surfaces are fitted to ensembles in `response_surface`; `aperiodic_search` uses the surfaces.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from vijax.design.aperiodic.motion_averages import Averages, summary_averages
from vijax.design.design_settings import DesignSettings
from vijax.design.robustness.tolerance import Tolerance, draw_devices
from vijax.design.survey.attractor_survey import gap_time_factor, simulate_survey
from vijax.maps.basins import SPEED, start_variables
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.records import Status
from vijax.model.tuned_quantities import LINEAR, tuned_devices_and_pairs, with_factors
from vijax.runtime import tiles
from vijax.simulation.simulate import Starts

_TILES = (512, 4096, 32768)  # numbers of cells of one compiled call
# Relative difference of the velocities of samples that repeat a start. Identical samples would add no information.
_VELOCITY_OFFSET = 1e-4
_SHORT_STAGE_FACTOR = 10  # full / first periods of a confirmation; the short run already refutes most designs
_CONFIRMING_FACTOR = 4  # samples that confirm a design, divided by samples of an ensemble, for "expected"


class DesignTask(NamedTuple):
    """A search for the best designs.

    Attributes:
        devices: Devices to design; the quantities that are not tuned keep their values.
        tune: Names of the tuned
            quantities.
        box: Lower and upper bounds of the variables, [device, 2, variable].
        objective: One of `OBJECTIVES`.
        tolerances: Scatter of the constants about each design.
        reliability: Share of the samples that must keep within the limits.
        settings: Settings of the design.
    """

    devices: list[Harvester]
    tune: tuple[str, ...]
    box: np.ndarray
    objective: str
    tolerances: tuple[Tolerance, ...]
    reliability: float
    settings: DesignSettings

    @property
    def expected(self) -> bool:
        """Return True for the objective "expected", where samples start anywhere in the gap, not on one motion."""
        return self.objective == "expected"

    @property
    def samples(self) -> int:
        """Return the number of samples of an ensemble."""
        return self.settings.expected_samples if self.expected else self.settings.ensemble_samples

    @property
    def confirmation_stages(self) -> list[tuple[int, int]]:
        """Return (samples, forcing periods) of each simulation that a design must pass, in order.

        The last simulation confirms the design.
        """
        settings = self.settings
        if self.expected:
            return [(_CONFIRMING_FACTOR * settings.expected_samples, settings.ensemble_periods)]
        samples, periods = settings.confirm_samples, settings.confirm_periods
        return [(samples, max(periods // _SHORT_STAGE_FACTOR, 1)), (samples, periods)]

    def unit(self, device_index: int) -> np.ndarray:
        """Return the unit of radii in each variable: 1 for a logarithm, the width of the bounds for an inclination."""
        low, high = self.box[device_index]
        return np.where([name in LINEAR for name in self.tune], high - low, 1.0)


class Ensemble(NamedTuple):
    """Samples about one design.

    Attributes:
        offsets: Offsets of the samples in the variables [sample, variable].
        averages, device: Averages and devices of the samples.
        periods: Simulated forcing periods of each sample.
    """

    offsets: np.ndarray
    averages: Averages
    device: Harvester
    periods: int = 0

    def select(self, index: np.ndarray) -> "Ensemble":
        """Return the samples with the specified indices."""
        device = jax.tree.map(lambda x: x[index], self.device)
        return Ensemble(self.offsets[index], self.averages.select(index), device, self.periods)


def simulate_ensembles(
    task: DesignTask,
    device_index: np.ndarray,
    centre: np.ndarray,
    radius: np.ndarray,
    starts: list[Starts],
    periods: int,
    samples: int,
) -> list[Ensemble]:
    """Simulate an ensemble about every centre.

    Args:
        task: The search.
        device_index: Index of the device of each centre.
        centre: Variables [centre, variable].
        radius: Largest offset of the samples from each centre, in units of `DesignTask.unit`; 0 puts all samples at the
            centre.
        starts: Starts on the motion of the design, for each centre; unused for the objective "expected".
        periods: Forcing periods of every sample; in a wide gap more, see `simulated_periods`.
        samples: Number of samples of an ensemble.
    """
    unit = np.array([task.unit(item) for item in device_index])
    offsets = (radius[:, None] * unit)[:, None] * draw_opposite_offsets(samples, len(task.tune))
    # Samples beyond a bound are moved onto it.
    z = np.clip(centre[:, None] + offsets, task.box[device_index, 0][:, None], task.box[device_index, 1][:, None])
    sample_device = np.repeat(device_index, samples)
    base_devices = jax.tree.map(lambda *x: np.array(x, float)[sample_device], *task.devices)
    device, pair = _make_cells(base_devices, z.reshape(-1, len(task.tune)), task.tune)
    if task.tolerances:
        names, factors = draw_devices(task.tolerances, samples)
        # The devices are tuned already. With no variables, `_make_cells` only computes the pairs of the scattered
        # devices.
        device = with_factors(device, names, [np.tile(x, len(device_index)) for x in factors.T])
        device, pair = _make_cells(device, np.zeros((sample_device.size, 0)), ())
    sample_starts = (
        _starts_anywhere(pair.d, len(device_index), samples)
        if task.expected
        else _concatenate([repeat_starts(x, samples) for x in starts])
    )
    # All samples of an ensemble have the number of periods for its widest gap.
    widest = np.asarray(pair.d).reshape(len(device_index), samples).max(axis=1)
    max_periods = simulated_periods(task.settings, widest, periods)
    results = summary_averages(
        device,
        simulate_survey(pair, device, sample_starts, max_period=1, periods=np.repeat(max_periods, samples)).summary,
    )
    all_samples = Ensemble((z - centre[:, None]).reshape(-1, len(task.tune)), results, device)
    ensembles = (all_samples.select(np.arange(i * samples, (i + 1) * samples)) for i in range(len(device_index)))
    return [item._replace(periods=int(count)) for item, count in zip(ensembles, max_periods, strict=True)]


def simulated_periods(settings: DesignSettings, d: Any, periods: int) -> np.ndarray:
    """Return `periods`, multiplied in wide gaps by `gap_time_factor`, and at most max(periods, `confirm_periods`)."""
    return np.minimum(periods * gap_time_factor(d), max(periods, settings.confirm_periods))


def _make_cells(device: Harvester, z: np.ndarray, names: tuple[str, ...]) -> tuple[Harvester, ImpactPair]:
    """Return devices with tuned quantities, and their pairs, as NumPy arrays."""
    result = tiles.map_tiles(lambda rows: tuned_devices_and_pairs(rows[0], rows[1], names), (device, z), _TILES)
    return jax.tree.map(np.asarray, result)


def draw_opposite_offsets(samples: int, size: int) -> np.ndarray:
    """Return random offsets in [-1, 1] [sample, variable], in opposite pairs, evenly spread in every variable."""
    half = (samples + 1) // 2
    # A lattice is not used because with few samples it leaves out the ends of each variable, which determine a surface
    # best.
    order = np.random.default_rng(size).permuted(np.tile(np.arange(half), (size, 1)), axis=1).T
    # The term 0.5 makes all offsets differ from all opposite offsets. Two samples with one start are then never in one
    # device, where they would have the same motion.
    offsets = (2 * order + 0.5) / half - 1
    return np.concatenate([offsets, -offsets])[:samples]


def repeat_starts(starts: Starts, samples: int) -> Starts:
    """Return `samples` starts: the specified starts cyclically, with a slightly larger velocity in each repetition."""
    u, v, t = (np.resize(x, samples) for x in jax.tree.leaves(starts))
    columns: Any = u, v * (1 + _VELOCITY_OFFSET * (np.arange(samples) // len(starts.v))), t
    return Starts(*columns)


def _starts_anywhere(d: Any, centres: int, samples: int) -> Starts:
    """Return starts spread over the gap and over velocity; in units of the gap they are the same in every ensemble."""
    # `start_variables` returns positions in units of the gap and velocities in units of 2 SPEED.
    u, v = (np.tile(x.values, centres) for x in start_variables(samples, None))
    columns: Any = u * d, 2 * SPEED * v, np.zeros_like(d)
    return Starts(*columns)


def _concatenate(parts: list[Starts]) -> Starts:
    """Concatenate starts."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def is_impacting(results: Averages) -> np.ndarray:
    """Return a mask of the samples with impacts and a positive, finite P."""
    return np.isfinite(results.P) & (results.P > 0) & (results.status != Status.NO_IMPACT)


def has_no_impact(results: Averages) -> np.ndarray:
    """Return a mask of the samples without an impact in all simulated periods.

    In a wide gap such a sample may be on an aperiodic motion with long flights.
    """
    return results.status == Status.NO_IMPACT


def is_majority_kind(results: Averages) -> np.ndarray:
    """Return a mask of the samples with the more frequent kind of motion, periodic or aperiodic.

    Samples without an impact count as aperiodic. Samples of the other kind would distort a fitted surface.
    """
    impacting = is_impacting(results)
    # Samples without an impact are counted, but their averages may be missing.
    aperiodic, periodic = (impacting & (results.period <= 0)) | has_no_impact(results), impacting & (results.period > 0)
    return aperiodic if impacting[aperiodic].any() and aperiodic.sum() >= periodic.sum() else periodic
