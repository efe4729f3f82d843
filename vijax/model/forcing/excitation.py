"""Excitations of the capsule other than the sine: harmonics, measured records, noise, and sums of them.

The excitation replaces the forcing cos(pi t) of u'' = -gamma + cos(pi t). Times and accelerations are in the units of
the pair: half forcing periods pi/omega, and the amplitude A. Only a `Record` is in SI units, as it was measured.
"""

import hashlib
import math
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from vijax.model import units
from vijax.model.device import Harvester, check_device
from vijax.model.units import QuantityLike
from vijax.runtime import validation
from vijax.runtime.arrays import AnyArray
from vijax.runtime.doc_pages import see
from vijax.runtime.public_api import public_api

Samples = Float[AnyArray, "sample"]

# Largest permitted difference between the longest and the shortest time step of a record, relative to the mean step.
_STEP_TOLERANCE = 1e-3
# Largest number of samples in a forcing period.
_MOST_SAMPLES = 10**6


class Excitation(eqx.Module):
    """Excitation of the capsule. Excitations add: `Harmonics() + Noise(0.05, 32)` is the sine with noise on it."""

    def __add__(self, other: "Excitation") -> "Excitation":
        # The parts are joined, so that no addend of a sum is itself a sum.
        return Sum((*self.parts, *validate_excitation(other).parts))

    def __radd__(self, other: object) -> "Excitation":
        # `sum` starts from 0, which is not an excitation.
        return self if isinstance(other, int) and other == 0 else validate_excitation(other) + self

    @property
    def parts(self) -> tuple["Excitation", ...]:
        """List the addends of the excitation; itself if it is not a `Sum`."""
        return (self,)

    @property
    def is_periodic(self) -> bool:
        """Return whether the excitation repeats after every forcing period, so that a motion can be periodic."""
        # Waveforms and records never count as periodic here, even looped, because their length need not be one period.
        return all(isinstance(part, Harmonics) or (isinstance(part, Noise) and not part.level) for part in self.parts)

    @property
    def has_half_wave_symmetry(self) -> bool:
        """Return whether the excitation changes sign after half a period.

        The mirror image of every motion is then a motion. Among periodic excitations, only sums of odd harmonics have
        this symmetry.
        """
        # amplitudes[0] belongs to k = 1, so indices 1, 3, ... are the even harmonics.
        odd = [not any(part.amplitudes[1::2]) for part in self.of(Harmonics)]
        return self.is_periodic and all(odd)

    @property
    def is_sine(self) -> bool:
        """Return whether the excitation is the forcing of the paper, cos(pi t)."""
        return False

    def of(self, kind: type) -> list[Any]:
        """List the addends of a kind."""
        return [part for part in self.parts if isinstance(part, kind)]

    def nondimensional(self, device: Harvester) -> "Excitation":
        """Convert to the units of a device: records become waveforms, other excitations already have these units."""
        check_device(device)
        parts = tuple(part.waveform(device) if isinstance(part, Record) else part for part in self.parts)
        return parts[0] if len(parts) == 1 else Sum(parts)


class Harmonics(Excitation):
    """Harmonic excitation: sum over k = 1, 2, ... of amplitudes_k cos(k pi t + phases_k). The default is the sine.

    Attributes:
        amplitudes: Amplitude of every multiple of the forcing frequency, in units of A.
        phases: Phase of every harmonic, or one phase for all harmonics [rad]; default 0.

    Raises:
        ValueError: If an argument is not admissible; the message contains its name, the requirement and the value.
    """

    amplitudes: tuple[float, ...]
    phases: tuple[float, ...]

    def __init__(self, amplitudes: QuantityLike = 1.0, phases: QuantityLike = 0.0):
        # A single number is the amplitude of the first harmonic. Zeros are not removed from a list of amplitudes,
        # because the position in the list is the order of the harmonic.
        strengths = np.atleast_1d(validation.validate_finite("amplitudes", amplitudes)).astype(float)
        angles = np.atleast_1d(
            validation.validate_finite("phases", units.plain_number("angle", phases, "phases"))
        ).astype(float)
        if strengths.ndim > 1 or not strengths.any():
            raise ValueError(
                f"amplitudes must be one number a harmonic, not all 0; got {validation.value_text(amplitudes)}"
            )
        if angles.shape not in ((1,), strengths.shape):
            raise ValueError(f"phases must be one number, or one a harmonic, {strengths.size}; got {angles.size}")
        self.amplitudes = tuple(strengths.tolist())
        self.phases = tuple(np.broadcast_to(angles, strengths.shape).tolist())

    @property
    def is_sine(self) -> bool:
        """Return whether the excitation is the forcing of the paper, cos(pi t)."""
        return self.amplitudes == (1.0,) and self.phases == (0.0,)

    def __str__(self) -> str:
        """Return name and numbers, as the attributes of maps store them."""
        pairs = zip(self.amplitudes, self.phases, strict=True)
        return "harmonics " + ", ".join(f"{a!r}" + (f" at {phase!r} rad" if phase else "") for a, phase in pairs)


class Waveform(Excitation):
    """Samples at equal time steps with linear interpolation; the signal scales with A and omega of the device.

    Attributes:
        values: Accelerations in units of A [sample].
        samples: Number of samples in a forcing period; need not be an integer.
        looped: Whether the signal repeats forever; otherwise no run may be longer than the signal.

    Raises:
        ValueError: If an argument is not admissible; the message contains its name, the requirement and the value.
    """

    values: Samples
    samples: float
    looped: bool

    def __init__(self, values: QuantityLike, samples: float, looped: bool = True):
        self.values = _samples("values", values)
        must = f"a number from 2 to {_MOST_SAMPLES:,}, samples a forcing period"
        self.samples = validation.validate_real("samples", samples, must, lambda x: 2 <= x <= _MOST_SAMPLES)
        self.looped = validation.validate_flag("looped", looped)

    @property
    def periods(self) -> float:
        """Compute the duration of the samples in forcing periods, without repetition."""
        # A loop has one more segment, from the last sample back to the first.
        return (self.values.size - (not self.looped)) / self.samples

    def __str__(self) -> str:
        """Return a name, as the attributes of maps store it."""
        times = "looped" if self.looped else "once"
        return f"waveform of {self.values.size} samples, {self.samples!r} a period, {times}, {_digest(self.values)}"


class Record(Excitation):
    """A measured acceleration of the capsule along its axis, in SI units, with linear interpolation between samples.

    It replaces A cos(omega tau). A and omega of the device then only set the units of displacement and time, and the
    "half period" in the definition of P: no power in watts depends on them.

    Attributes:
        time: Time of each sample [s], with equal steps [sample].
        acceleration: Acceleration [m/s^2] [sample].
        looped: Whether the record repeats forever; otherwise no run may be longer than the record.

    Raises:
        ValueError: If an argument is not admissible; the message contains its name, the requirement and the value.
    """

    time: Samples
    acceleration: Samples
    looped: bool

    def __init__(self, time: QuantityLike, acceleration: QuantityLike, looped: bool = False):
        self.time = _samples("time", units.plain_number("time", time))
        self.acceleration = _samples("acceleration", units.plain_number("acceleration", acceleration))
        self.looped = validation.validate_flag("looped", looped)
        if self.time.size != self.acceleration.size:
            raise ValueError(
                f"acceleration must hold one number a time, {self.time.size}; got {self.acceleration.size}"
            )
        steps = np.diff(self.time)
        # np.ptp: largest minus smallest step; the tolerance admits times rounded to few digits.
        if not (steps.min() > 0 and np.ptp(steps) <= _STEP_TOLERANCE * self.step):
            raise ValueError(
                see(
                    "excitation",
                    f"time must rise by even steps, to {_STEP_TOLERANCE:g} of one; got steps from {steps.min():g} to "
                    f"{steps.max():g} s; numpy.interp brings a record to even ones",
                )
            )

    @property
    def step(self) -> float:
        """Compute the time between two samples [s]."""
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    @public_api
    def waveform(self, device: Harvester) -> Waveform:
        """Convert the record to a waveform in the units A and omega of a device.

        Args:
            device: One device, or arrays of devices that share A and omega.

        Raises:
            ValueError: If there are several A or omega, or less than two samples in a period 2 pi/omega.
        """
        scales = {}
        for name in ("A", "omega"):
            # All cells share one conversion, so that A and omega must not vary among the cells.
            values = np.unique(validation.validate_untraced(name, getattr(check_device(device), name)))
            if values.size > 1:
                raise ValueError(see("excitation", f"{name} must be one number with a record; got {values.size}"))
            scales[name] = float(values[0])
        # The forcing period 2 pi/omega in steps of the record; at least two samples represent the frequency omega.
        samples = 2 * math.pi / (scales["omega"] * self.step)
        if not 2 <= samples <= _MOST_SAMPLES:
            advice = "lower it" if samples < 2 else "raise it"
            raise ValueError(
                see(
                    "excitation",
                    f"omega must give the record 2 to {_MOST_SAMPLES:,} samples in a period 2 pi/omega; it only "
                    f"sets the unit of time; got {samples:.3g} at omega = {scales['omega']:g} rad/s; {advice}",
                )
            )
        return Waveform(self.acceleration / scales["A"], samples, self.looped)

    def __str__(self) -> str:
        """Return a name, as the attributes of maps store it."""
        times = "looped" if self.looped else "once"
        return f"record of {self.time.size} samples every {self.step!r} s, {times}, {_digest(self.acceleration)}"


class Noise(Excitation):
    """White noise up to a frequency: a waveform of independent normal values, generated during the run.

    In a time t without impacts it adds a velocity of variance level^2 t, for every bandwidth. The noise of a cell is
    a function of the seed, the time, and seven digits of its d, kappa, r, gamma and start: it is the same in every
    plane and on every device, and differs between cells and starts.

    Attributes:
        level: Standard deviation of the added velocity per square root of time, in units of A times the square root of
            half a forcing period; >= 0.
        bandwidth: Highest frequency, in units of the forcing frequency; a period has twice as many values.
        seed: Number of the realisation, an integer of 32 bits.

    Raises:
        ValueError: If an argument is not admissible; the message contains its name, the requirement and the value.
    """

    level: float
    bandwidth: float
    seed: int

    def __init__(self, level: float, bandwidth: float, seed: int = 0):
        self.level = validation.validate_real(
            "level", level, "a finite number of at least 0", lambda x: 0 <= x < math.inf
        )
        must = "a number from 1 to 10^5, in units of the forcing frequency"
        self.bandwidth = validation.validate_real("bandwidth", bandwidth, must, lambda x: 1 <= x <= 1e5)
        self.seed = validation.validate_integer("seed", seed, 0, 2**32 - 1)

    def __str__(self) -> str:
        """Return name and numbers, as the attributes of maps store them."""
        return f"noise of level {self.level!r} up to {self.bandwidth!r} times the frequency, seed {self.seed}"


class Sum(Excitation):
    """Sum of several excitations, with at most one sampled signal and one noise."""

    addends: tuple[Excitation, ...]

    def __init__(self, addends: tuple[Excitation, ...]):
        self.addends = addends
        # A run interpolates at most one sampled signal and draws at most one noise.
        for kinds, name in (((Waveform, Record), "records and waveforms"), ((Noise,), "noises")):
            number = sum(isinstance(part, kinds) for part in addends)
            if number > 1:
                raise ValueError(f"excitation must hold at most one of {name}; got {number}")

    @property
    def parts(self) -> tuple[Excitation, ...]:
        """List the addends of the excitation."""
        return self.addends

    def __str__(self) -> str:
        """Return the names of the addends, as the attributes of maps store them."""
        return " + ".join(map(str, self.addends))


def _samples(name: str, values: Any) -> Any:
    """Return a one-dimensional float array of at least two finite numbers."""
    array = np.asarray(validation.validate_finite(name, values), float)
    # Linear interpolation needs two samples.
    if array.ndim != 1 or array.size < 2:
        raise ValueError(f"{name} must be a row of at least two numbers; got shape {array.shape}")
    return array


def _digest(values: Any) -> str:
    """Return twelve hexadecimal digits that identify a row of samples."""
    # Little-endian doubles, so that the digest does not depend on the machine.
    return hashlib.sha256(np.ascontiguousarray(values, "<f8").tobytes()).hexdigest()[:12]


def validate_excitation(excitation: Any) -> Excitation:
    """Return the argument if it is an excitation; raise ValueError otherwise."""
    return validation.validate_instance(
        "excitation", excitation, Excitation, "vijax.Harmonics(...), Record(...) or Noise(...)"
    )


def count_periods(periods: Any, excitation: Excitation | None, transient: int = 0) -> int:
    """Return a number of forcing periods; "all" gives the whole periods of a record after a transient.

    Args:
        periods: The number, or "all".
        excitation: The excitation, in the units of a pair; None is the sine.
        transient: Number of forcing periods before the measured ones.

    Raises:
        ValueError: If the number is not admissible, no record ends the run, or the record ends within the transient.
    """
    if not isinstance(periods, str):
        return validation.validate_integer("periods", periods, 1)
    validation.validate_choice("periods", periods, ("all",), "or a whole number of at least 1")
    # Only signals that are not looped end, and so determine the length of a run.
    waves = [] if excitation is None else [wave for wave in excitation.of(Waveform) if not wave.looped]
    if not waves:
        raise ValueError(see("excitation", 'periods must be a number unless a record ends the run; got "all"'))
    # int() rounds down, because a mean over a partial period would be biased.
    count = int(min(wave.periods for wave in waves)) - transient
    if count < 1:
        must = f"transient must leave a whole period of the record, {count + transient} periods; got {transient}"
        raise ValueError(see("excitation", must))
    return count


def check_run_excitation(excitation: Any, periods: int, *, repeats: bool = False) -> Excitation | None:
    """Return an excitation in the units of a pair if a run can use it; None is the sine.

    Args:
        excitation: The argument to check.
        periods: Number of forcing periods of the run.
        repeats: Whether the run searches for attractors, which requires a periodic excitation.

    Raises:
        ValueError: If the excitation is in SI units, does not repeat although `repeats` is set, or ends before the run.
    """
    if excitation is None:
        return None
    # Without a device the conversion to the units of the pair is unknown.
    if validate_excitation(excitation).of(Record):
        raise ValueError(
            see(
                "excitation",
                "excitation must be in the units of the pair; got a Record, in SI units; "
                "record.waveform(device) brings it into those of a device",
            )
        )
    if repeats and not excitation.is_periodic:
        raise ValueError(
            see(
                "excitation",
                f'until must be "window" with an excitation that does not repeat every period; got "attractor" with '
                f"{excitation}",
            )
        )
    for wave in excitation.of(Waveform):
        # A looped signal never ends.
        if not wave.looped and periods > wave.periods:
            raise ValueError(
                see(
                    "excitation",
                    f"periods and transient must end within the record, {wave.periods:.6g} periods; got {periods}; "
                    'periods="all" takes all of it, looped=True begins it again',
                )
            )
    return excitation
