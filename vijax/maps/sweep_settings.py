"""Settings of a simulation of cells: fields that a user may set, their defaults, and their validation.

The import of this module does not load JAX (only the creation of a `SweepSettings` does), so that the command prints
defaults and choices in its help without delay.
"""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from vijax.model.choices import Direction, MethodName, Precision, SolverName, Until, Walls

if TYPE_CHECKING:
    from vijax.impact.method import Method
    from vijax.model.device import Harvester
    from vijax.model.forcing.excitation import Excitation
    from vijax.model.walls.membrane import Laws

# Default number of starts per cell: fractions over random starts then have a standard error of at most 0.5/sqrt(64) =
# 0.0625.
STARTS = 64
# Maximum number of starts per cell; a larger number is taken for a typing error.
MOST_STARTS = 10**7
# Default number of starts along each side of a (u0, v0) plane.
START_POINTS = 256
# Default largest speed of starts, the usual range of basin plots in the literature.
SPEED = 0.6

# Options of integration methods; each method accepts some of them.
_OPTIONS = ("solver", "rtol", "atol", "membrane", "friction", "steps")
# Settings that `impact.method_choice.method_attributes` writes to the attributes of a dataset.
_RECORDED_BY_METHOD = (*_OPTIONS, "excitation")
# Settings that an orbit diagram reads, in the order of its attributes.
_DIAGRAM_FIELDS = ("direction", "periods", "recorded_periods", "wall", "dtype", "excitation")


@dataclass(frozen=True)
class SweepSettings:
    """Settings of a simulation of cells, common to sweeps, basins and comparisons.

    Each field is also an argument of `vijax.sweep`.

    Attributes:
        periods: Forcing periods to run, 400 by default: the maximum with until="attractor", the number after the
            transient with until="window". With until="attractor", an undecided cell then continues for up to three
            times as many periods with a weaker test of recurrence. Its status is CONVERGING if this test finds an
            orbit, else SLOW. An aperiodic cell with fewer than 200 impacts in its averages (below 300 periods: two
            impacts in three periods) continues to 4 or 16 times as many periods. If it has fewer than half of these
            impacts even then, its status is FEW_IMPACTS.
        until: "attractor" stops when the attractor is certified and measures over whole periods of it; "window" drops
            `transient` periods and measures over the next `periods`.
        transient: Forcing periods to drop before a window, 0 by default. It must be 0 with until="attractor", because
            the search for an attractor starts at once. If that search finds none, averages omit the first quarter of
            `periods`.
        wall: "soft", "rigid", "rigid_left" or "rigid_right".
        method: "exact", the event-driven engine; "ode", an adaptive solver of diffrax with located events; "rk4", the
            paper's fixed steps without event location.
        solver: For "ode", one of `SolverName`; Tsit5 if None.
        rtol, atol: For "ode": tolerances of position and velocity per step; 1e-8 and 1e-10 if None, in single precision
            1e-4 and 1e-6.
        membrane: For "ode" and "rk4": a `HuntCrossley`, a custom law, or `Sides` of two laws of one class; the linear
            membrane if None.
        friction: For "ode": dry friction between ball and capsule, divided by the amplitude of the forcing; no friction
            if None.
        steps: For "rk4": steps per forcing period; 1000 if None.
        dtype: "float64", or "float32" with wider tolerances.
        excitation: Excitation of the capsule, `Harmonics`, a `Record`, `Noise` or a sum; the sine if None.

    Raises:
        ValueError: If a setting is invalid; the message states the requirement and the value.
    """

    periods: int = 400
    until: Until = "attractor"
    transient: int = 0
    wall: Walls = "soft"
    method: MethodName = "exact"
    solver: SolverName | None = None
    rtol: float | None = None
    atol: float | None = None
    membrane: "Laws | None" = None
    friction: float | None = None
    steps: int | None = None
    dtype: Precision = "float64"
    excitation: "Excitation | None" = None

    def __post_init__(self) -> None:
        # These imports load JAX, see the docstring of the module.
        from vijax.model.forcing.excitation import Record, validate_excitation
        from vijax.runtime import validation

        for name, allowed in choices(type(self)).items():
            validation.validate_choice(name, getattr(self, name), allowed)
        self._count("periods", 1)
        self._count("transient", 0)
        # A transient would only delay the search for an attractor, which detects when the motion has converged.
        if self.transient and self.until == "attractor":
            raise ValueError(
                f"transient must be 0 with until='attractor', whose search begins at once; got {self.transient}; "
                "until='window' drops a transient"
            )
        if self.excitation is None or not validate_excitation(self.excitation).of(Record):
            self.integrator()  # a record is validated once the device, which defines its units, is known

    def _count(self, name: str, minimum: int) -> None:
        """Validate a number of periods, and replace the field by an int although the record is frozen."""
        import numpy as np

        from vijax.runtime import validation

        # The program counts periods in floats of this dtype. Up to this maximum, the sum of two numbers is exact.
        maximum = min(validation.MAX_COUNT, 1 << int(np.finfo(self.dtype).nmant))
        object.__setattr__(self, name, validation.validate_integer(name, getattr(self, name), minimum, maximum))

    def integrator(self, device: "Harvester | None" = None) -> "Method | None":
        """Return the integration method with its options; None for the exact engine.

        Args:
            device: Defines the units of a record and the constants of the membrane; Tables I and II by default.
        """
        from vijax.impact.method_choice import choose_method
        from vijax.model.device import Harvester
        from vijax.model.forcing.excitation import check_run_excitation
        from vijax.model.walls.membrane import check_laws, of_device

        options = {name: getattr(self, name) for name in _OPTIONS}
        if self.membrane is not None:
            options["membrane"] = of_device(check_laws(self.membrane), device or Harvester())
        # A record is converted to the units of the device here, so that the engine sees dimensionless numbers alone.
        excitation = self.excitation and self.excitation.nondimensional(device or Harvester())
        check_run_excitation(excitation, self.periods + self.transient, repeats=self.until == "attractor")
        return choose_method(self.method, options, wall=self.wall, dtype=self.dtype, excitation=excitation)

    @property
    def dataset_attributes(self) -> dict[str, Any]:
        """Settings as attributes of a dataset; options of a method are added by `method_attributes`."""
        return {
            field.name: getattr(self, field.name) for field in fields(self) if field.name not in _RECORDED_BY_METHOD
        }

    def require_defaults_except(self, of: str, *names: str) -> None:
        """Raise ValueError if a setting not in `names` differs from its default, because `of` would ignore it."""
        from vijax.runtime import validation

        for field in fields(self):
            if field.name not in names and (value := getattr(self, field.name)) != field.default:
                raise ValueError(f"{field.name} must be left out of {of}; got {validation.value_text(value)}")


@dataclass(frozen=True)
class DiagramSettings(SweepSettings):
    """Settings of an orbit diagram: periods, wall, dtype, excitation of a sweep, and two more.

    Attributes:
        direction: Directions along the axis to sweep, "down", "up" or "both"; "down" by default.
        recorded_periods: Number of recorded periods at the end of every point, 25 by default.

    Raises:
        ValueError: If a setting is invalid; the message states the requirement and the value.
    """

    direction: Direction = "down"
    recorded_periods: int = 25

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_defaults_except("an orbit diagram", *_DIAGRAM_FIELDS)
        self._count("recorded_periods", 1)
        if self.recorded_periods > self.periods:
            raise ValueError(f"recorded_periods must be at most periods; got {self.recorded_periods} of {self.periods}")

    @property
    def dataset_attributes(self) -> dict[str, Any]:
        """Settings that a diagram reads, as attributes of a dataset."""
        return {name: getattr(self, name) for name in _DIAGRAM_FIELDS if name not in _RECORDED_BY_METHOD}


def choices(settings: type[SweepSettings]) -> dict[str, tuple[str, ...]]:
    """Return the settings that accept one of a few words, and these words."""
    return {field.name: get_args(field.type) for field in fields(settings) if get_origin(field.type) is Literal}
