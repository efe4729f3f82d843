"""What shakes the capsule, where it is not the sine: harmonics, a measured record, noise, and sums of them.

Times and accelerations are those of the pair: half forcing periods pi/omega, and the amplitude A. A `Record` alone is
in SI units, as it was measured.
"""

import hashlib
import math
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from vijax.model import units
from vijax.model.device import Harvester, check_device
from vijax.model.units import Given
from vijax.runtime import checks
from vijax.runtime.arrays import AnyArray
from vijax.runtime.context import door
from vijax.runtime.pages import see

Samples = Float[AnyArray, "sample"]

# Samples of a measured time may be off so much of their spacing.
_EVEN = 1e-3
# Samples a forcing period, at most.
_MOST = 10**6


class Excitation(eqx.Module):
    """What shakes the capsule. Excitations are added: `Harmonics() + Noise(0.05, 32)` is the sine with noise on it."""

    def __add__(self, other: "Excitation") -> "Excitation":
        return Sum((*self.parts, *instance(other).parts))

    def __radd__(self, other: object) -> "Excitation":
        # `sum` begins with 0.
        return self if isinstance(other, int) and other == 0 else instance(other) + self

    @property
    def parts(self) -> tuple["Excitation", ...]:
        """List what it is the sum of."""
        return (self,)

    @property
    def periodic(self) -> bool:
        """Say whether it repeats after every forcing period, so that a motion can."""
        return all(isinstance(part, Harmonics) or (isinstance(part, Noise) and not part.level) for part in self.parts)

    @property
    def mirrored(self) -> bool:
        """Say whether it is its own opposite half a period later: then mirror images of motions are motions."""
        odd = [not any(part.amplitudes[1::2]) for part in self.of(Harmonics)]
        return self.periodic and all(odd)

    @property
    def sine(self) -> bool:
        """Say whether it is the forcing of the paper, cos(pi t)."""
        return False

    def of(self, kind: type) -> list[Any]:
        """List its parts of a kind."""
        return [part for part in self.parts if isinstance(part, kind)]

    def scaled(self, device: Harvester) -> "Excitation":
        """Bring it into the units of a device: records become waveforms, all else has these units already."""
        check_device(device)
        parts = tuple(part.waveform(device) if isinstance(part, Record) else part for part in self.parts)
        return parts[0] if len(parts) == 1 else Sum(parts)


class Harmonics(Excitation):
    """Several harmonics: sum over k = 1, 2, ... of amplitudes_k cos(k pi t + phases_k). By default the sine itself.

    Attributes:
        amplitudes: Of every multiple of the forcing frequency, in units of A.
        phases: Of every harmonic, or one for all [rad]; 0 unless given.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """

    amplitudes: tuple[float, ...]
    phases: tuple[float, ...]

    def __init__(self, amplitudes: Given = 1.0, phases: Given = 0.0):
        own = np.atleast_1d(checks.finite("amplitudes", amplitudes)).astype(float)
        turned = np.atleast_1d(checks.finite("phases", units.plain("angle", phases, "phases"))).astype(float)
        if own.ndim > 1 or not own.any():
            raise ValueError(f"amplitudes must be one number a harmonic, not all 0; got {checks.shown(amplitudes)}")
        if turned.shape not in ((1,), own.shape):
            raise ValueError(f"phases must be one number, or one a harmonic, {own.size}; got {turned.size}")
        self.amplitudes = tuple(own.tolist())
        self.phases = tuple(np.broadcast_to(turned, own.shape).tolist())

    @property
    def sine(self) -> bool:
        """Say whether it is the forcing of the paper, cos(pi t)."""
        return self.amplitudes == (1.0,) and self.phases == (0.0,)

    def __str__(self) -> str:
        """Name it and its numbers, as maps do in their attributes."""
        each = zip(self.amplitudes, self.phases, strict=True)
        return "harmonics " + ", ".join(f"{a!r}" + (f" at {phase!r} rad" if phase else "") for a, phase in each)


class Waveform(Excitation):
    """Samples at even spaces, straight lines between them, which scale with the device's A and omega.

    Attributes:
        values: Accelerations in units of A [sample].
        samples: How many there are a forcing period; not necessarily whole.
        looped: Whether the first follows the last again, for ever; else no run may be longer than they are.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """

    values: Samples
    samples: float
    looped: bool

    def __init__(self, values: Given, samples: float, looped: bool = True):
        self.values = _samples("values", values)
        must = f"a number from 2 to {_MOST:,}, samples a forcing period"
        self.samples = checks.real("samples", samples, must, lambda x: 2 <= x <= _MOST)
        self.looped = checks.flag("looped", looped)

    @property
    def periods(self) -> float:
        """Compute how many forcing periods they last, once."""
        return (self.values.size - (not self.looped)) / self.samples

    def __str__(self) -> str:
        """Name it, as maps do in their attributes."""
        times = "looped" if self.looped else "once"
        return f"waveform of {self.values.size} samples, {self.samples!r} a period, {times}, {_digest(self.values)}"


class Record(Excitation):
    """A measured acceleration of the capsule along its axis, in SI units: straight lines between its samples.

    It takes the place of A cos(omega tau). A and omega of the device are then units alone, of displacement, time and of
    the "half period" that P is counted by: no power in watts depends on them.

    Attributes:
        time: When each sample was taken [s], evenly spaced [sample].
        acceleration: [m/s^2] [sample].
        looped: Whether the first sample follows the last again, for ever; else no run may be longer than it is.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """

    time: Samples
    acceleration: Samples
    looped: bool

    def __init__(self, time: Given, acceleration: Given, looped: bool = False):
        self.time = _samples("time", units.plain("time", time))
        self.acceleration = _samples("acceleration", units.plain("acceleration", acceleration))
        self.looped = checks.flag("looped", looped)
        if self.time.size != self.acceleration.size:
            raise ValueError(
                f"acceleration must hold one number a time, {self.time.size}; got {self.acceleration.size}"
            )
        steps = np.diff(self.time)
        if not (steps.min() > 0 and np.ptp(steps) <= _EVEN * self.step):
            raise ValueError(
                see(
                    "excitation",
                    f"time must rise by even steps, to {_EVEN:g} of one; got steps from {steps.min():g} to "
                    f"{steps.max():g} s; numpy.interp brings a record to even ones",
                )
            )

    @property
    def step(self) -> float:
        """Compute the time between two samples [s]."""
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    @door
    def waveform(self, device: Harvester) -> Waveform:
        """Bring the record into the units of a device, whose A and omega it is told in.

        Args:
            device: One device, or arrays of them that share A and omega.

        Raises:
            ValueError: Several A or omega, or an omega with less than two samples a period.
        """
        scales = {}
        for name in ("A", "omega"):
            values = np.unique(checks.known(name, getattr(check_device(device), name)))
            if values.size > 1:
                raise ValueError(see("excitation", f"{name} must be one number with a record; got {values.size}"))
            scales[name] = float(values[0])
        samples = 2 * math.pi / (scales["omega"] * self.step)
        if not 2 <= samples <= _MOST:
            advice = "lower it" if samples < 2 else "raise it"
            raise ValueError(
                see(
                    "excitation",
                    f"omega must give the record 2 to {_MOST:,} samples a period 2 pi/omega, as it is but a unit of "
                    f"time; got {samples:.3g} at omega = {scales['omega']:g} rad/s; {advice}",
                )
            )
        return Waveform(self.acceleration / scales["A"], samples, self.looped)

    def __str__(self) -> str:
        """Name it, as maps do in their attributes."""
        times = "looped" if self.looped else "once"
        return f"record of {self.time.size} samples every {self.step!r} s, {times}, {_digest(self.acceleration)}"


class Noise(Excitation):
    """White noise up to a frequency: a waveform of independent normal values, made as it is needed.

    A ball that meets no wall gains a velocity of variance level^2 t from it in a time t, whatever the bandwidth. Which
    noise a cell meets is made of the seed, the time, and seven digits of its d, kappa, r, gamma and start: it is the
    same in every plane, on every device, and another for any other cell or start.

    Attributes:
        level: Velocity over the root of time, in units of A times the root of a half forcing period; >= 0.
        bandwidth: Highest frequency, in units of the forcing frequency: twice as many values are drawn a period.
        seed: What numbers its realisation, a whole number of 32 bits.

    Raises:
        ValueError: Which argument, what must hold, what came.
    """

    level: float
    bandwidth: float
    seed: int

    def __init__(self, level: float, bandwidth: float, seed: int = 0):
        self.level = checks.real("level", level, "a finite number of at least 0", lambda x: 0 <= x < math.inf)
        must = "a number from 1 to 10^5, in units of the forcing frequency"
        self.bandwidth = checks.real("bandwidth", bandwidth, must, lambda x: 1 <= x <= 1e5)
        self.seed = checks.whole("seed", seed, 0, 2**32 - 1)

    def __str__(self) -> str:
        """Name it and its numbers, as maps do in their attributes."""
        return f"noise of level {self.level!r} up to {self.bandwidth!r} times the frequency, seed {self.seed}"


class Sum(Excitation):
    """Several excitations at once."""

    addends: tuple[Excitation, ...]

    def __init__(self, addends: tuple[Excitation, ...]):
        self.addends = addends
        for kinds, what in (((Waveform, Record), "records and waveforms"), ((Noise,), "noises")):
            number = sum(isinstance(part, kinds) for part in addends)
            if number > 1:
                raise ValueError(f"excitation must hold at most one of {what}; got {number}")

    @property
    def parts(self) -> tuple[Excitation, ...]:
        """List what it is the sum of."""
        return self.addends

    def __str__(self) -> str:
        """Name its parts, as maps do in their attributes."""
        return " + ".join(map(str, self.addends))


def _samples(name: str, values: Any) -> Any:
    """Take at least two finite numbers in a row."""
    array = np.asarray(checks.finite(name, values), float)
    if array.ndim != 1 or array.size < 2:
        raise ValueError(f"{name} must be a row of at least two numbers; got shape {array.shape}")
    return array


def _digest(values: Any) -> str:
    """Tell one row of samples from another in a few letters."""
    return hashlib.sha256(np.ascontiguousarray(values, "<f8").tobytes()).hexdigest()[:12]


def instance(excitation: Any) -> Excitation:
    """Pass an excitation, or raise ValueError."""
    return checks.instance("excitation", excitation, Excitation, "vijax.Harmonics(...), Record(...) or Noise(...)")


def counted(periods: Any, excitation: Excitation | None, transient: int = 0) -> int:
    """Return a number of forcing periods; for "all" the whole ones that a record holds after a transient.

    Args:
        periods: The number, or "all".
        excitation: The excitation, in the units of a pair; None is the sine.
        transient: Forcing periods before.

    Raises:
        ValueError: No such number, no record that ends, or one that ends within the transient.
    """
    if not isinstance(periods, str):
        return checks.whole("periods", periods, 1)
    checks.choice("periods", periods, ("all",), "or a whole number of at least 1")
    waves = [] if excitation is None else [wave for wave in excitation.of(Waveform) if not wave.looped]
    if not waves:
        raise ValueError(see("excitation", 'periods must be a number unless a record ends the run; got "all"'))
    count = int(min(wave.periods for wave in waves)) - transient
    if count < 1:
        must = f"transient must leave a whole period of the record, {count + transient} periods; got {transient}"
        raise ValueError(see("excitation", must))
    return count


def check_excitation(excitation: Any, periods: int, *, repeats: bool = False) -> Excitation | None:
    """Pass an excitation in the units of a pair, if a run can have it; None is the sine.

    Args:
        excitation: What came.
        periods: Forcing periods of the run.
        repeats: Whether attractors are looked for.

    Raises:
        ValueError: What must hold, what came.
    """
    if excitation is None:
        return None
    if instance(excitation).of(Record):
        raise ValueError(
            see(
                "excitation",
                "excitation must be in the units of the pair; got a Record, in SI units; "
                "record.waveform(device) brings it into those of a device",
            )
        )
    if repeats and not excitation.periodic:
        raise ValueError(
            see(
                "excitation",
                f'until must be "window" with an excitation that does not repeat every period; got "attractor" with '
                f"{excitation}",
            )
        )
    for wave in excitation.of(Waveform):
        if not wave.looped and periods > wave.periods:
            raise ValueError(
                see(
                    "excitation",
                    f"periods and transient must end within the record, {wave.periods:.6g} periods; got {periods}; "
                    'periods="all" takes all of it, looped=True begins it again',
                )
            )
    return excitation
