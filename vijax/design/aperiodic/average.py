"""Average power of a device's motion, periodic or not, with derivatives from one ensemble of samples.

Derivatives along a chaotic trajectory grow with its Lyapunov exponent and do not converge to derivatives of averages.
Here a polynomial is fitted by least squares to P of samples in devices at small offsets x from the specified device,

    P(x) = P_0 + g . x + x . H x / 2,

and g is the derivative. If the fit shows that there is no smooth average, the record states the reason (`Smoothness`).
"""

import enum
from functools import lru_cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vijax.design.aperiodic.ensemble_fit import LocalFit, local_fit
from vijax.maps.basins import SPEED
from vijax.model import flow
from vijax.model.device import Harvester, check_scalar_constants, electrical_device
from vijax.model.energy import capacitance
from vijax.model.pair import ImpactPair, pair_of, pair_quantities
from vijax.runtime import tiles, validation
from vijax.runtime.arrays import Values, not_none
from vijax.runtime.compilation.programs import jitted
from vijax.runtime.numerics.low_discrepancy import lattice
from vijax.runtime.public_api import public_api
from vijax.runtime.record_text import PrintedRecord, printed
from vijax.runtime.validation import is_concrete
from vijax.simulation import perturbed_averages
from vijax.simulation.summary import Summary

_MIN_SAMPLES = 32  # with fewer samples standard errors are not reliable
_MAX_SAMPLES = 2**20
_MAX_WIDTH = 0.2  # largest accepted `spread`; a quadratic does not describe more
_SAMPLES_PER_TERM = 6  # terms of second order need this many samples per coefficient
# Relative step of difference quotients in the electrical constants. With this step the truncation error and the
# rounding error are both about 1e-8 of the derivative.
_RELATIVE_STEP = 1e-7
_ELECTRICAL = "C_T", "R0", "V", "eps_M", "r_b", "w0"
# Thresholds of `Smoothness`.
_INNER = 0.8  # samples with all |x| below this value form the inner half
_OTHER_KIND_SHARE = 0.01  # tolerated share of orbits among aperiodic samples, or the reverse
_VARIANCE_RATIO = 4.0  # largest ratio of the variance between samples to the variance within them
_RESOLUTION = 1e-4  # relative difference of P below which samples count as equal
_SLOPE_ERRORS = 4.5  # the slopes of both halves may differ by this many standard errors
_MIN_BEND = 0.02  # smallest difference of elasticities that counts as a bend, whatever its error


class Smoothness(enum.IntEnum):
    """Whether the average of P is a smooth function of the constants near a device, judged by its samples."""

    SMOOTH = 0
    FAILED = 1  # some samples have no average
    WINDOW = 2  # some samples end on orbits, others do not
    ATTRACTORS = 3  # samples differ by more than their standard errors explain
    KINK = 4  # the inner and the outer half of the neighbourhood have different slopes

    @property
    def advice(self) -> str:
        """Return the consequence for the derivatives, in one sentence."""
        return _ADVICE[self]


_ADVICE = {
    Smoothness.SMOOTH: "use them: the averages of all samples lie on one smooth surface",
    Smoothness.FAILED: "run more periods, or compare with a sweep: some samples ended without an average",
    Smoothness.WINDOW: "spread less to see the window alone: some samples settle on orbits, others do not",
    Smoothness.ATTRACTORS: "compute the basins: samples end on several attractors, whose shares change with the device",
    Smoothness.KINK: "spread less: P bends within the neighbourhood, as at a crisis or at the edge of a window",
}


class Average(PrintedRecord):
    """The average power of a device's motion, its derivatives, standard errors, and a test whether P is smooth.

    Standard errors come from the scatter of the samples. They miss effects that no sample shows, for example an
    attractor that few starts reach, or a window narrower than the distance between samples.

    Attributes:
        P, P_stderr: Energy harvested per half forcing period, and its standard error [J]. Each attractor counts by the
            share of starts that end on it. Only P and `power` have derivatives under `jax.grad`.
        power: P omega/pi [W].
        by_pair, by_pair_stderr: Derivatives of P in d, kappa, r, gamma at fixed unit of length, and their standard
            errors [J]. The derivative in gamma is 0 at level ground, where P is an even function of it.
        by_device, by_device_stderr: Derivatives of P in each constant of the device with all others fixed, and their
            standard errors [J per unit of the constant].
        periodic: Share of the samples that ended on orbits.
        smooth: True if the averages of all samples lie on one smooth surface.
        smoothness: A `Smoothness`; its `advice` states the consequence.
    """

    P: Float[Array, ""]
    P_stderr: Float[Array, ""]
    power: Float[Array, ""]
    by_pair: ImpactPair
    by_pair_stderr: ImpactPair
    by_device: Harvester
    by_device_stderr: Harvester
    periodic: Float[Array, ""]
    smooth: Bool[Array, ""]
    smoothness: Int[Array, ""]

    def __repr__(self) -> str:
        # The code may be traced, or a tangent of a derivative.
        is_number = (
            isinstance(self.smoothness, jax.Array) and is_concrete(self.smoothness) and self.smoothness.ndim == 0
        )
        return (
            printed(self, smoothness=f"Smoothness.{Smoothness(int(self.smoothness)).name}")
            if is_number
            else printed(self)
        )


class _Inputs(NamedTuple):
    """Quantities that determine P: the pair (motion), the unit of length [m] and the electrical constants."""

    pair: ImpactPair
    length: Any
    device: Harvester


class _EnsembleResults(NamedTuple):
    """The results of an ensemble.

    Attributes:
        width: Spread of the samples.
        x: Offsets of the samples' devices from the centre, divided by `width`.
        real: True for samples that are not padding and have an average.
        failed: True if at least one sample has no average.
        P, P_stderr: Average of every sample and its standard error [J].
        fixed: Derivatives of P in the unit of length and the electrical constants, with the motion of each sample held
            fixed.
        periodic: True for samples that ended on orbits.
    """

    width: Float[Array, ""]
    x: Float[Array, "sample variable"]
    real: Bool[Array, " sample"]
    failed: Bool[Array, ""]
    P: Float[Array, " sample"]
    P_stderr: Float[Array, " sample"]
    fixed: Float[Array, "sample quantity"]
    periodic: Bool[Array, " sample"]


@public_api
def average(
    device: Harvester, *, samples: int = 4096, periods: int = 400, spread: float = 0.01, seed: int | None = None
) -> Average:
    """Compute the average P of a device with soft walls, and first derivatives; jit, vmap, grad and jvp work on it.

    ::

        result = average(device)
        result.P, result.P_stderr, result.by_device.omega0, result.by_device_stderr.omega0, result.smooth
        jax.grad(lambda device: average(device).P)(device)  # the same derivatives

    One ensemble is simulated. Its samples start all over the gap, in pairs with opposite offsets from the device. The
    offsets in ln d, ln kappa, ln r and gamma (at level ground it stays 0) are spread evenly; where the walls differ,
    the quantities of each wall have separate offsets. A quadratic in the offsets is fitted to P of the samples, and its
    value and slopes at the centre are returned: the plain mean of the samples would be biased by the curvature of P.
    Constants that do not affect the motion (electrical constants, the unit of length) are differentiated at fixed
    motion. Standard errors follow from the observed scatter about the fit, pair by pair. Results are deterministic;
    between two devices they differ by the true change and by the response of chaos to it.

    A call takes a second; the first call of a process compiles for ten. A user's `jit` or `vmap` compiles the programs
    anew, twice if gamma is traced there, since level ground has a program of its own. Devices of a batch are simulated
    one after another.

    Args:
        device: Constants, one number each; traced numbers are allowed.
        samples: Number of samples, even, 32 to 1,048,576. Programs are compiled for powers of two.
        periods: Forcing periods of a sample that settles on no orbit; the first quarter is left out of its averages. A
            sample with fewer than 200 impacts, or fewer than two impacts in three periods, is continued to 4 or 16
            times as many periods.
        spread: Largest offset of the samples to either side, in logarithms (for gamma in its value), at most 0.2. With
            a larger spread the standard errors of slopes are smaller, but the error of the quadratic grows with its
            square, and more windows lie within it.
        seed: Seed of random offsets and starts; by default they lie on lattices, which are more even.

    Returns:
        An `Average`. Second derivatives under `jax.grad` are NaN, since they are not measured. If `smooth` is False, P
        is an average over the neighbourhood, and its derivatives are not reliable.

    Raises:
        ValueError: An argument is invalid; the message states the argument, the requirement and the value.
    """
    check_scalar_constants(device, "map devices by jax.vmap")
    samples = validation.validate_integer("samples", samples, _MIN_SAMPLES, _MAX_SAMPLES)
    if samples % 2:
        raise ValueError(f"samples must be even, since they are simulated in pairs; got {samples}; take {samples + 1}")
    periods = validation.validate_integer("periods", periods, 8)
    width = validation.validate_real("spread", spread, f"a number in (0, {_MAX_WIDTH}]", lambda x: 0 < x <= _MAX_WIDTH)
    device = jax.tree.map(lambda x: jnp.asarray(x, float), device)
    # The ensemble itself is not differentiated: derivatives come from the fit (`_with_slopes`).
    centre = lax.stop_gradient(_inputs(device))
    size = len(jax.tree.leaves(centre.pair))
    results = _simulate(centre, _place_samples(samples, size, validation.validate_seed(seed)), periods, width)
    return _fit_average(device, centre, results, samples >= _SAMPLES_PER_TERM * (size + 1) * (size + 2) // 2)


def _inputs(device: Harvester) -> _Inputs:
    """Return the quantities of a device that determine P."""
    return _Inputs(device.pair(), device.length_unit, electrical_device(device))


# --- the ensemble -----------------------------------------------------------------------------------------------------


class _SamplePlaces(NamedTuple):
    """Offsets in [-1, 1], [sample, variable], and scaled starts (u, v), [sample, 2]; samples 2i, 2i + 1 form a pair."""

    offsets: np.ndarray
    start: np.ndarray


@lru_cache(maxsize=8)
def _place_samples(samples: int, size: int, seed: int | None) -> _SamplePlaces:
    """Return offsets and starts of samples: lattice points, or random numbers if a seed is specified."""
    half = samples // 2
    if seed is None:
        start, offsets = lattice(half, 2).T, lattice(half, size).T
    else:
        start, offsets = np.split(np.random.default_rng(seed).random((half, 2 + size)), [2], axis=1)
    offsets = 2 * offsets - 1
    return _SamplePlaces(
        np.stack([offsets, -offsets], axis=1).reshape(samples, size), np.repeat(2 * start - 1, 2, axis=0)
    )


def _simulate(centre: _Inputs, places: _SamplePlaces, periods: int, width: float) -> _EnsembleResults:
    """Simulate the ensemble about a device."""
    samples = len(places.offsets)
    # Samples are repeated up to a compiled size; the first `count` samples are real, the others are padding.
    offsets, unit_starts = (jnp.asarray(np.resize(x, (tiles.padded(samples), x.shape[1]))) for x in places)
    spread, count = jnp.asarray(width), jnp.asarray(samples, jnp.int32)
    x, pair, length, device, steps = _spread_samples(centre, spread, offsets)
    # Starts fill the gap, |u| <= d/2, and the speeds up to SPEED.
    start = 0.5 * unit_starts[:, 0] * pair.d, SPEED * unit_starts[:, 1]
    summary = perturbed_averages.averages(pair, start, length, device, count, jnp.asarray(periods, float))
    return _collect(spread, x, summary, steps, count)


@jitted
def _spread_samples(centre: _Inputs, width: Float[Array, ""], offsets: Float[Array, "sample variable"]):
    """Return, for all samples: offsets, pairs, units of length, devices with shifted constants, and these shifts."""
    shifts = dict(zip(pair_quantities(centre.pair), (width * offsets).T, strict=True))
    shifted_pair = {name: _shift(name, value, shifts[name]) for name, value in pair_quantities(centre.pair).items()}
    x = jnp.stack([shift for _, shift in shifted_pair.values()], axis=1) / width
    current = jnp.stack([centre.length, *jax.tree.leaves([getattr(centre.device, name) for name in _ELECTRICAL])])
    size = jnp.where(current == 0, 1.0, jnp.abs(current))
    # C_T, the first constant, may be 0; the step is then relative to the capacitance of the membrane.
    size = size.at[1].add(capacitance(centre.device.at(1), jnp.zeros(())))
    shifted = current + _RELATIVE_STEP * size
    # Column 0 holds the constants themselves; in column i constant i - 1 is moved.
    table = jnp.where(jnp.eye(current.size, current.size + 1, 1, dtype=bool), shifted[:, None], current[:, None])
    m_b = jnp.broadcast_to(centre.device.m_b, table.shape[1:])
    # `replace` would validate fields that are placeholders here.
    device = eqx.tree_at(_electrical_and_mass, centre.device, [*table[1:], m_b])
    pair = pair_of({name: value for name, (value, _) in shifted_pair.items()}, "soft")
    return x, pair, table[0], device, shifted - current


def _shift(name: str, value: Values, shift: Values) -> tuple[Values, Values]:
    """Return value * e^shift (gamma: value + shift), and the applied shift, which the bound r <= 1 may reduce."""
    if name == "gamma":
        shifted = value + jnp.where(value == 0, 0.0, shift)
        return shifted, shifted - value
    shifted = value * jnp.exp(shift)
    if not name.startswith("r"):
        return shifted, shift
    # r is at most 1, so the applied shift may be smaller than `shift`.
    shifted = jnp.minimum(shifted, 1.0)
    return shifted, jnp.log(shifted / value)


def _electrical_and_mass(device: Harvester) -> list[Any]:
    return jax.tree.leaves([getattr(device, name) for name in (*_ELECTRICAL, "m_b")])


@jitted
def _collect(width, x, summary: Summary, steps, count) -> _EnsembleResults:
    """Return the results of the samples; P and its error are 0 for samples without an average."""
    is_sample = jnp.arange(x.shape[0], dtype=count.dtype) < count
    values, errors = not_none(summary.P), not_none(summary.P_stderr)
    real = is_sample & jnp.isfinite(values[:, 0])
    # If a sample has no average, both samples of its pair are excluded from the fit.
    real = jnp.repeat(real.reshape(-1, 2).all(axis=1), 2)
    P, P_stderr = (jnp.where(real[:, None], column, 0.0) for column in (values, errors))
    fixed = (P[:, 1:] - P[:, :1]) / steps
    return _EnsembleResults(
        width, x, real, (is_sample & ~real).any(), P[:, 0], P_stderr[:, 0], fixed, real & (summary.period > 0)
    )


# --- the fit ----------------------------------------------------------------------------------------------------------


@partial(jitted, static=("second",))
def _fit_average(device: Harvester, centre: _Inputs, results: _EnsembleResults, second: bool) -> Average:
    """Fit the results of an ensemble and return the record."""
    fit = local_fit(results.x, jnp.column_stack([results.P, results.fixed]), results.real, second)
    value = fit.coefficients[0, 0]

    def slopes(coefficients: Float[Array, "term column"]) -> _Inputs:
        """Return the derivatives of P from the coefficients of the fit."""
        # The fit has slopes in logarithms, so dP/dx = (dP/d ln x) / x. The variable gamma is not logarithmic.
        unit = {name: 1.0 if name == "gamma" else value for name, value in pair_quantities(centre.pair).items()}
        by_quantity = coefficients[1 : 1 + len(unit), 0] / results.width / jnp.stack(list(unit.values()))
        blank = jax.tree.map(jnp.zeros_like, centre.device)
        constants = list(coefficients[0, 2:])
        electric = eqx.tree_at(_electrical_and_mass, blank, [*constants, blank.m_b])
        return _Inputs(pair_of(dict(zip(unit, by_quantity, strict=True)), "soft"), coefficients[0, 1], electric)

    def size(contributions: Any) -> Any:
        return jax.tree.map(lambda x: jnp.sqrt((x * x).sum(axis=0)), contributions)

    by, by_contributions = slopes(fit.coefficients), jax.vmap(slopes)(fit.contributions)
    # Chain rule from (pair, unit of length, electrical constants) to the constants of the device.
    _, to_device = jax.vjp(_inputs, lax.stop_gradient(device))
    (by_device,), (by_device_contributions,) = to_device(by), jax.vmap(to_device)(by_contributions)
    P = _with_slopes(_inputs(device), value, by)
    code = _classify(results, fit, second)
    return Average(
        P=P,
        P_stderr=fit.errors()[0, 0],
        power=P * device.omega / flow.PI,
        by_pair=by.pair,
        by_pair_stderr=size(by_contributions.pair),
        by_device=by_device,
        by_device_stderr=size(by_device_contributions),
        periodic=_periodic_share(results),
        smooth=code == Smoothness.SMOOTH,
        smoothness=code,
    )


def _classify(results: _EnsembleResults, fit: LocalFit, second: bool) -> Int[Array, ""]:
    """Return the code of the first condition of `Smoothness` that the samples fulfil, or SMOOTH if they fulfil none."""
    value, periodic = fit.coefficients[0, 0], _periodic_share(results)
    within = (results.P_stderr**2).sum() / results.real.sum(dtype=value.dtype)
    between = (fit.residuals[:, 0] ** 2).sum() / fit.degrees_of_freedom
    inner = jnp.abs(results.x).max(axis=1) < _INNER
    halves = [local_fit(results.x, results.P[:, None], results.real & half, second) for half in (inner, ~inner)]
    slopes = slice(1, 1 + results.x.shape[1])
    difference = jnp.abs(halves[0].coefficients[slopes, 0] - halves[1].coefficients[slopes, 0])
    error = jnp.hypot(*(half.errors()[slopes, 0] for half in halves))
    # A difference of the slopes in both halves is a bend only if it is significant, and large compared with P.
    bent = (difference > _SLOPE_ERRORS * error) & (difference > _MIN_BEND * results.width * value)
    conditions = {
        Smoothness.FAILED: results.failed,
        Smoothness.WINDOW: (periodic > _OTHER_KIND_SHARE) & (periodic < 1 - _OTHER_KIND_SHARE),
        Smoothness.ATTRACTORS: between > _VARIANCE_RATIO * within + (_RESOLUTION * value) ** 2,
        Smoothness.KINK: bent.any(),
    }
    # `select` returns the code of the first condition that holds, so the order of `conditions` is their precedence.
    codes = [jnp.asarray(code, jnp.int32) for code in conditions]
    return jnp.select(list(conditions.values()), codes, jnp.asarray(Smoothness.SMOOTH, jnp.int32))


def _periodic_share(results: _EnsembleResults) -> Float[Array, ""]:
    """Return the share of the samples that ended on orbits."""
    return results.periodic.sum(dtype=results.P.dtype) / results.real.sum(dtype=results.P.dtype)


@jax.custom_jvp
def _with_slopes(inputs: _Inputs, value: Float[Array, ""], slopes: _Inputs) -> Float[Array, ""]:
    """Return `value`; JAX differentiates it as a function of the inputs with the derivatives `slopes`."""
    return value


@_with_slopes.defjvp
def _with_slopes_jvp(primals, tangents):
    inputs, value, slopes = primals
    slopes = _not_differentiable(inputs, slopes)
    changes = jax.tree.map(lambda slope, x: slope * x, slopes, tangents[0])
    return value, sum(jax.tree.leaves(changes))


@jax.custom_jvp
def _not_differentiable(inputs: _Inputs, slopes: _Inputs) -> _Inputs:
    """Return the slopes; their derivatives are NaN, because second derivatives are not measured."""
    return slopes


@_not_differentiable.defjvp
def _not_differentiable_jvp(primals, tangents):
    not_measured = jnp.nan * sum(jax.tree.leaves(tangents[0]))
    return primals[1], jax.tree.map(lambda _: not_measured, primals[1])
