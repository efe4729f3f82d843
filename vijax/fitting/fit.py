"""A device from its impacts: `fit` is the line: series -> equations -> least squares -> what they tell."""

import math
from collections.abc import Iterable
from dataclasses import replace

import jax
import numpy as np

from vijax.fitting.fit_model import FitModel
from vijax.fitting.fitted import Fit
from vijax.fitting.series import Series, take_series
from vijax.fitting.shaking import Shaking, shaking
from vijax.fitting.unknowns import DELAY, half_period, known, limits, take_names
from vijax.model.choices import Walls
from vijax.model.device import Harvester, one_device
from vijax.model.excitation import Excitation, Noise, Record, Waveform, instance
from vijax.model.pair import WALLS
from vijax.model.sides import apart
from vijax.model.units import Given
from vijax.model.variables import LINEAR
from vijax.runtime import checks
from vijax.runtime.context import door
from vijax.runtime.lattice import lattice
from vijax.runtime.pages import see

# The search begins at the best of so many places about the device as it is known: their variables differ by so much at
# most, of inclinations by less.
_PLACES, _ABOUT, _LINEAR_ABOUT = 16, 0.2, 0.02


@door
def fit(
    times: Given,
    sides: Given | None = None,
    excitation: Excitation | None = None,
    *,
    timing_error: float,
    speeds: Given | None = None,
    speed_error: float | None = None,
    device: Harvester | None = None,
    unknown: str | Iterable[str] = ("omega0", "r"),
    wall: Walls = "soft",
) -> Fit:
    """Find what device has these impacts: stiffness, restitution and others from the times that a bench measured.

    ::

        found = vijax.fit(times, sides, timing_error=1e-3, device=device, unknown=("omega0", "r"))
        print(found)
        found.values["r"], found.stderr["r"], found.device

    From each impact to the next the motion has a closed form, and two intervals in a row must agree on the impact
    between them: an equation for three times. Nothing is simulated for long, so that chaos does no harm. The unknowns
    are those for which times have to be changed least, in standard errors, to make all equations hold (least squares
    with errors in the times); impacts that were missed by the bench, or that are none, are found and left out.

    Args:
        times: Onsets of impacts in a row [s], rising, at least 4; on the clock of `excitation`: phase 0 of the sine is
            at 0, a `Record` has its own times.
        sides: The wall of each, -1 left or +1 right.
        excitation: What shook the capsule, without noise, which is no measurement. The sine unless given.
        timing_error: Standard error of a time [s].
        speeds: Impact speeds [m/s]; with signs, as velocities, they say the sides, too.
        speed_error: Their standard error [m/s].
        device: Gives all that is known, and where the search for the unknowns begins; Tables I and II unless given.
        unknown: Names of what is looked for: `omega0`, `k` or `kappa`, `r`, `s` or `d`, `beta` or `gamma`, `A`,
            `omega`, of one wall `omega0_left` and so on; and "delay", by how much the clock of the times is late [s].
        wall: What the walls are, as in `Harvester.pair`.

    Returns:
        The `Fit`, which has values with standard errors and correlations, combinations that the data do not tell, other
            devices that fit as well, the misfit, a test whether restitution is constant, and the impacts left out.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """
    # Here, as SciPy takes half a second, and importing vijax must not load it.
    from vijax.fitting.search import least_squares
    from vijax.fitting.verdict import told

    series = take_series(times, sides, speeds, timing_error, speed_error)
    device = one_device(device)
    checks.choice("wall", wall, WALLS)
    names = take_names(unknown, device, wall)
    if series.equations <= len(names):
        raise ValueError(
            f"times must be so many that they say more than there are unknowns: of {len(names)} at least "
            f"{len(names) + 3} impacts without speeds; got {series.times.size}"
        )
    series, shaken = _clocked(series, excitation, device, names)
    shape = _shaking(series, shaken, device, wall)
    model = FitModel(jax.tree.map(np.asarray, device), names, wall, shape, limits(device, names))
    begin = known(device, names)
    ends = least_squares(model, series, _places(model, begin))
    return told(model, series, ends, begin)


def _clocked(
    series: Series, excitation: Excitation | None, device: Harvester, names: tuple[str, ...]
) -> tuple[Series, Excitation | None]:
    """Bring times to the clock of the excitation, and that into the units of the device.

    Raises:
        ValueError: Why they do not go together.
    """
    if excitation is None:
        return series, None
    if instance(excitation).of(Noise):
        raise ValueError(see("excitation", "excitation must be known; got noise; a Record holds what was measured"))
    for record in excitation.of(Record):
        fixed = [name for name in names if name in ("A", "omega")]
        if fixed:
            raise ValueError(f"unknown must be told by the motion; got {fixed[0]}, which is but a unit under a record")
        series = replace(series, times=series.times - record.time[0])
    shaken = excitation.scaled(device)
    for wave in shaken.of(Waveform):
        last = wave.periods * 2 * half_period(device)
        within = (series.times >= 0) & (wave.looped | (series.times <= last))
        if not within.all():
            raise ValueError(
                f"times must lie within the record, {last:.6g} s from its first sample on; got "
                f"{checks.first(series.times, within)} s after it"
            )
    return series, shaken


def _shaking(series: Series, excitation: Excitation | None, device: Harvester, wall: Walls) -> Shaking:
    """Bring the excitation into the form of fits; unknowns may stretch intervals and soften walls by a half."""
    longest = float(np.diff(series.times).max()) / half_period(device)
    omega0 = apart(device.omega0)
    softest = math.inf if wall == "rigid" else min(float(omega0.left), float(omega0.right)) * half_period(device)
    return jax.tree.map(np.asarray, shaking(excitation, 2 * longest, softest / 2))


def _places(model: FitModel, here: np.ndarray) -> list[np.ndarray]:
    """List where a search may begin: at the device as it is known, and about it, at any delay."""
    moves = np.array([_LINEAR_ABOUT if name in LINEAR else _ABOUT for name in model.names])
    if DELAY in model.names:
        moves[-1] = 0.0 if model.shaking.sampled else 1.0
    points = 2 * lattice(_PLACES, len(here)).T - 1
    return list(np.clip([here, *(here + moves * point for point in points)], *model.limits))
