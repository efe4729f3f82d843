"""How the cells of a plane are run: what a user may set, its defaults, and what is wrong with a setting.

Nothing here loads JAX until a record is made, so that help of the command can tell defaults and choices at once.
"""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from vijax.model.choices import Direction, MethodName, Precision, SolverName, Until, Walls

if TYPE_CHECKING:
    from vijax.engine.method import Method
    from vijax.model.device import Harvester
    from vijax.model.excitation import Excitation
    from vijax.model.membrane import Laws

# Starts in every cell unless told otherwise: shares of random ones have a standard error of 0.0625 at most.
STARTS = 64
# The most starts of a cell: more are taken for a slip of the finger.
MOST_STARTS = 10**7
# Starts along either side of a plane of them unless told otherwise.
START_POINTS = 256
# Speed up to which starts lie unless told otherwise: the one that basins are drawn to in the field.
SPEED = 0.6

# Settings that methods are told, each its own ones.
_OPTIONS = ("solver", "rtol", "atol", "membrane", "friction", "steps")
# What `engine.method_choice.record` tells of a run.
_TOLD_ELSEWHERE = (*_OPTIONS, "excitation")
# Settings that an orbit diagram reads, in the order of its attributes.
_OF_DIAGRAMS = ("direction", "periods", "recorded_periods", "wall", "dtype", "excitation")


@dataclass(frozen=True)
class SweepSettings:
    """How cells are run, whatever plane they are of; each is an argument of `vijax.sweep` too.

    Attributes:
        periods: Forcing periods to run, 400: at most (until="attractor"), or after the transient (until="window").
            A cell without a verdict then goes on for up to three times as many, less sceptical of what recurs, and if
            that finds its orbit its status is CONVERGING; else SLOW. An aperiodic cell with fewer than 200 impacts in
            its window (below 300 periods: two in three periods) runs on, to 4 or 16 times as many periods; with fewer
            than half of that then it has FEW_IMPACTS.
        until: "attractor" stops when the attractor is certain and measures over whole periods of it; "window" drops
            `transient` periods and measures over the next `periods`.
        transient: Forcing periods to drop before a window, 0. The search for an attractor begins at once and takes
            none; where it finds nothing, averages leave out the first quarter of `periods`.
        wall: "soft", "rigid", "rigid_left" or "rigid_right".
        method: "exact", the event-driven engine; "ode", an adaptive solver of diffrax with located events; "rk4", the
            paper's fixed steps without event location.
        solver: Of "ode", one of `SolverName`; Tsit5 if None.
        rtol, atol: Of "ode": tolerances of position and velocity step by step; 1e-8 and 1e-10 if None, in single
            precision 1e-4 and 1e-6.
        membrane: Of "ode" and "rk4": a `HuntCrossley`, a law of your own, or `Sides` of two of a kind; the linear one
            if None.
        friction: Of "ode": dry friction along the capsule over the forcing's amplitude; none if None.
        steps: Of "rk4": steps per forcing period; 1000 if None.
        dtype: "float64", or "float32" with tolerances to match.
        excitation: What shakes the capsule, `Harmonics`, a `Record`, `Noise` or a sum; the sine if None.

    Raises:
        ValueError: Which setting, what must hold, what came.
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
        from vijax.model.excitation import Record, instance
        from vijax.runtime import checks

        for name, allowed in choices(type(self)).items():
            checks.choice(name, getattr(self, name), allowed)
        self._count("periods", 1)
        self._count("transient", 0)
        if self.transient and self.until == "attractor":
            raise ValueError(
                f"transient must be 0 with until='attractor', whose search begins at once; got {self.transient}; "
                "until='window' drops a transient"
            )
        if self.excitation is None or not instance(self.excitation).of(Record):
            self.integrator()  # else when the device is known, in whose units the record is told

    def _count(self, name: str, least: int) -> None:
        """Put a number of periods in place of what was given for it, as a frozen record lets only itself do."""
        import numpy as np

        from vijax.runtime import checks

        # Two such numbers together are still counted one by one by the floats of the program.
        most = min(checks.MOST, 1 << int(np.finfo(self.dtype).nmant))
        object.__setattr__(self, name, checks.whole(name, getattr(self, name), least, most))

    def integrator(self, device: "Harvester | None" = None) -> "Method | None":
        """Give the method with what it is told; None for the exact one.

        Args:
            device: Its units are those of a record, and its constants those of the membrane; Tables I and II unless
                given.
        """
        from vijax.engine.method_choice import choose
        from vijax.model.device import Harvester
        from vijax.model.excitation import check_excitation
        from vijax.model.membrane import check_laws, of_device

        told = {name: getattr(self, name) for name in _OPTIONS}
        if self.membrane is not None:
            told["membrane"] = of_device(check_laws(self.membrane), device or Harvester())
        excitation = self.excitation and self.excitation.scaled(device or Harvester())
        check_excitation(excitation, self.periods + self.transient, repeats=self.until == "attractor")
        return choose(self.method, told, wall=self.wall, dtype=self.dtype, excitation=excitation)

    @property
    def told(self) -> dict[str, Any]:
        """Name the settings, as attributes of a dataset; `engine.method_choice.record` has what a method is told."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name not in _TOLD_ELSEWHERE}

    def only(self, of: str, *names: str) -> None:
        """Raise ValueError if a setting besides these differs from its default: `of` would not read it."""
        from vijax.runtime import checks

        for field in fields(self):
            if field.name not in names and (given := getattr(self, field.name)) != field.default:
                raise ValueError(f"{field.name} must be left out of {of}; got {checks.shown(given)}")


@dataclass(frozen=True)
class DiagramSettings(SweepSettings):
    """How the points of an orbit diagram are run: of a sweep's settings periods, wall, dtype, excitation, and two more.

    Attributes:
        direction: Ways along the axis that is swept, "down", "up" or "both"; "down".
        recorded_periods: How many of the periods, at the end, are recorded, 25.

    Raises:
        ValueError: Which setting, what must hold, what came.
    """

    direction: Direction = "down"
    recorded_periods: int = 25

    def __post_init__(self) -> None:
        super().__post_init__()
        self.only("an orbit diagram", *_OF_DIAGRAMS)
        self._count("recorded_periods", 1)
        if self.recorded_periods > self.periods:
            raise ValueError(f"recorded_periods must be at most periods; got {self.recorded_periods} of {self.periods}")

    @property
    def told(self) -> dict[str, Any]:
        """Name the settings that a diagram reads, as attributes of a dataset."""
        return {name: getattr(self, name) for name in _OF_DIAGRAMS if name not in _TOLD_ELSEWHERE}


def choices(settings: type[SweepSettings]) -> dict[str, tuple[str, ...]]:
    """Find the settings that are one of a few words, and the words."""
    return {field.name: get_args(field.type) for field in fields(settings) if get_origin(field.type) is Literal}
