"""Fit of a device to its impacts: `fit` validates the data, then series -> equations -> least squares -> `Fit`."""

import math
from collections.abc import Iterable
from dataclasses import replace

import jax
import numpy as np

from vijax.fitting.fit_excitation import FitExcitation, fit_excitation
from vijax.fitting.fit_model import FitModel
from vijax.fitting.fit_result import Fit
from vijax.fitting.series import Series, validate_series
from vijax.fitting.unknowns import DELAY, half_period, limits, validate_names, variables_of_device
from vijax.model.choices import Walls
from vijax.model.device import Harvester, scalar_device
from vijax.model.forcing.excitation import Excitation, Noise, Record, Waveform, validate_excitation
from vijax.model.pair import WALLS
from vijax.model.tuned_quantities import LINEAR
from vijax.model.units import QuantityLike
from vijax.model.walls.sides import as_sides
from vijax.runtime import validation
from vijax.runtime.doc_pages import see
from vijax.runtime.numerics.low_discrepancy import lattice
from vijax.runtime.public_api import public_api

# `_PLACES` starts of the search lie around the specified device. A variable of a start differs from the device by at
# most `_ABOUT`, and a linear variable (an inclination) by at most `_LINEAR_ABOUT`.
_PLACES, _ABOUT, _LINEAR_ABOUT = 16, 0.2, 0.02


@public_api
def fit(
    times: QuantityLike,
    sides: QuantityLike | None = None,
    excitation: Excitation | None = None,
    *,
    timing_error: float,
    speeds: QuantityLike | None = None,
    speed_error: float | None = None,
    device: Harvester | None = None,
    unknown: str | Iterable[str] = ("omega0", "r"),
    wall: Walls = "soft",
) -> Fit:
    """Find the device that produces measured impacts: stiffness, restitution and other constants from impact times.

    ::

        found = vijax.fit(times, sides, timing_error=1e-3, device=device, unknown=("omega0", "r"))
        print(found)
        found.values["r"], found.stderr["r"], found.device

    From each impact to the next the motion has a closed form. Two consecutive intervals must agree on the speed of the
    impact between them: one equation for three times. No motion is simulated over more than one interval, so that chaos
    has no effect. The unknowns minimise the change of the times, in standard errors, that fulfils all equations (least
    squares with errors in the times). Impacts that the bench missed or reported falsely are detected and left out.

    Args:
        times: Onsets of consecutive impacts [s], rising, at least 4; on the clock of `excitation`: phase 0 of the sine
            is at 0, a `Record` has its own times.
        sides: The wall of each impact, -1 left or +1 right.
        excitation: Excitation of the capsule. Noise is not permitted, because its values are not measured. Default: the
            sine.
        timing_error: Standard error of a time [s].
        speeds: Impact speeds [m/s]; with signs, as velocities, they also specify the sides.
        speed_error: Standard error of a speed [m/s].
        device: Specifies all known constants, and the start of the search for the unknowns. Default: Tables I and II.
        unknown: Names of the unknowns: `omega0`, `k` or `kappa`, `r`, `s` or `d`, `beta` or `gamma`, `A`, `omega`, for
            one wall `omega0_left` and so on; and "delay", the lag of the clock of the times behind the clock of the
            excitation [s].
        wall: Kind of the walls, as in `Harvester.pair`.

    Returns:
        The `Fit`, with values, standard errors and correlations, combinations that the data do not determine, other
        devices that fit equally well, the misfit, a test for constant restitution, and the impacts left out.

    Raises:
        ValueError: With the argument, the requirement and the value.
    """
    # Imported here, because SciPy takes half a second to load and `import vijax` must not load it.
    from vijax.fitting.evaluation import make_fit
    from vijax.fitting.least_squares import least_squares

    series = validate_series(times, sides, speeds, timing_error, speed_error)
    device = scalar_device(device)
    validation.validate_choice("wall", wall, WALLS)
    names = validate_names(unknown, device, wall)
    if series.equations <= len(names):
        raise ValueError(
            f"times must give more equations than there are unknowns: of {len(names)} at least "
            f"{len(names) + 3} impacts without speeds; got {series.times.size}"
        )
    series, scaled = _on_excitation_clock(series, excitation, device, names)
    shape = _fit_excitation(series, scaled, device, wall)
    model = FitModel(jax.tree.map(np.asarray, device), names, wall, shape, limits(device, names))
    initial = variables_of_device(device, names)
    ends = least_squares(model, series, _places(model, initial))
    return make_fit(model, series, ends, initial)


def _on_excitation_clock(
    series: Series, excitation: Excitation | None, device: Harvester, names: tuple[str, ...]
) -> tuple[Series, Excitation | None]:
    """Convert times to the clock of the excitation, and the excitation to the units of the device.

    Raises:
        ValueError: If the excitation contains noise, an unknown only scales units under a record, or a time is outside
            of the record.
    """
    if excitation is None:
        return series, None
    if validate_excitation(excitation).of(Noise):
        raise ValueError(see("excitation", "excitation must be known; got noise; a Record holds what was measured"))
    for record in excitation.of(Record):
        # Under a record, A and omega only scale units, so that the impact times do not depend on them.
        fixed = [name for name in names if name in ("A", "omega")]
        if fixed:
            raise ValueError(
                f"unknown must have an effect on the motion; got {fixed[0]}, which only scales units under a record"
            )
        # A waveform starts at time 0: shift the times to the first sample of the record.
        series = replace(series, times=series.times - record.time[0])
    scaled = excitation.nondimensional(device)
    for wave in scaled.of(Waveform):
        last = wave.periods * 2 * half_period(device)
        within = (series.times >= 0) & (wave.looped | (series.times <= last))
        if not within.all():
            raise ValueError(
                f"times must lie within the record, {last:.6g} s from its first sample on; got "
                f"{validation.first_invalid(series.times, within)} s after it"
            )
    return series, scaled


def _fit_excitation(series: Series, excitation: Excitation | None, device: Harvester, wall: Walls) -> FitExcitation:
    """Convert the excitation to the form of fits, valid for intervals up to twice as long and kappa down to half."""
    longest = float(np.diff(series.times).max()) / half_period(device)
    omega0 = as_sides(device.omega0)
    softest = math.inf if wall == "rigid" else min(float(omega0.left), float(omega0.right)) * half_period(device)
    # The factor 2 and the half allow for the unknowns to change during the search.
    return jax.tree.map(np.asarray, fit_excitation(excitation, 2 * longest, softest / 2))


def _places(model: FitModel, first: np.ndarray) -> list[np.ndarray]:
    """List the starts of a search: the specified device, and devices around it, at any delay."""
    distances = np.array([_LINEAR_ABOUT if name in LINEAR else _ABOUT for name in model.names])
    if DELAY in model.names:
        # With a periodic excitation the starts have delays up to half a period either way; the unit of the delay is
        # half a period. With a record, which does not repeat, all starts have the delay of `first`.
        distances[-1] = 0.0 if model.excitation.sampled else 1.0
    # Low-discrepancy points in [-1, 1] for each unknown.
    points = 2 * lattice(_PLACES, len(first)).T - 1
    return list(np.clip([first, *(first + distances * point for point in points)], *model.limits))
