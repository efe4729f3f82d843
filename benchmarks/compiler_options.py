"""Do the results depend on the compiler? A million impacts of each kind under the shipped and under other options.

    python benchmarks/compiler_options.py                 # all kinds; exit status 1 if a bound is exceeded
    python benchmarks/compiler_options.py --only level    # some kinds
    python benchmarks/compiler_options.py --cells 12      # planes of 12 x 12 cells: does it run?

Each variant computes the same planes in a process of its own: with the options that users get, with XLA's optimisation
off (as the tests compile), and without kernels (`VIJAX_KERNELS=0`). Cells are compared with those of the first variant:

labels: cells whose period, numbers of impacts or status differ. Rounding decides between attractors where a start lies
on the border of their basins, so one cell in a thousand may differ.
P, periodic: the largest relative difference of P where the label is the same and the status is ok; at most 1e-9.
P, aperiodic: the root mean square of the difference over its standard error; at most 1.2, as chaos makes different
motions of different rounding.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import vijax

CELLS = 72  # along each axis: a million impacts of every kind
PLANES: dict[str, dict[str, Any]] = {
    "level": {},
    "inclined": {"gamma": 0.1},
    "two walls": {"kappa_right": 40.0},
    "harmonics": {"excitation": vijax.Harmonics([1.0, 0.3])},
}
VARIANTS: dict[str, dict[str, str]] = {
    "as shipped": {},
    "optimisation off": {"XLA_FLAGS": "--xla_backend_optimization_level=0"},
    "kernels off": {"VIJAX_KERNELS": "0"},
}
LABEL = ("period", "impacts_left", "impacts_right", "status")
OUTPUTS = [*LABEL, "P", "P_stderr", "periods_run", "impacts_per_period"]
MOST_LABELS, MOST_PERIODIC, MOST_APERIODIC = 1e-3, 1e-9, 1.2


class Row(NamedTuple):
    """How a variant differs from the options that users get.

    Attributes:
        kind: One of `PLANES`.
        variant: One of `VARIANTS`.
        impacts: Number of impacts that the variant computed.
        cells: Number of cells.
        labels: Cells whose labels differ.
        periodic: Largest relative difference of P of periodic cells.
        aperiodic: Root mean square of differences of P over their standard error; NaN without aperiodic cells.
    """

    kind: str
    variant: str
    impacts: int
    cells: int
    labels: int
    periodic: float
    aperiodic: float

    @property
    def within_bounds(self) -> bool:
        """Return whether no bound is exceeded."""
        few = self.labels <= max(MOST_LABELS * self.cells, 1)
        return few and self.periodic <= MOST_PERIODIC and not self.aperiodic > MOST_APERIODIC


def plane(kind: str, cells: int) -> dict[str, np.ndarray]:
    """Compute the plane of a kind with the options of this process; arrays by name, [cell]."""
    stiffness: dict[str, Any] = {"kappa_left" if kind == "two walls" else "kappa": np.geomspace(4, 300, cells)}
    axes: dict[str, Any] = {"d": np.linspace(0.05, 0.35, cells), "r": 0.5}
    dataset = vijax.sweep(**axes, **stiffness, outputs=OUTPUTS, **PLANES[kind])
    return {name: np.ravel(dataset[name].values) for name in OUTPUTS}


def compared(kind: str, variant: str, reference: dict[str, np.ndarray], arrays: dict[str, np.ndarray]) -> Row:
    """Compare a plane with the plane of the first variant."""
    same = np.all([reference[name] == arrays[name] for name in LABEL], axis=0)
    is_ok = same & (reference["status"] == 0)
    periodic, aperiodic = is_ok & (reference["period"] > 0) & (reference["P"] > 0), is_ok & (reference["period"] == 0)
    difference = arrays["P"] - reference["P"]
    relative = np.abs(difference[periodic] / reference["P"][periodic])
    z = difference[aperiodic] / np.hypot(reference["P_stderr"], arrays["P_stderr"])[aperiodic]
    impacts = int(np.nansum(arrays["periods_run"] * arrays["impacts_per_period"]))
    error = float(np.sqrt(np.mean(z**2))) if z.size else np.nan
    return Row(kind, variant, impacts, same.size, int(np.sum(~same)), float(relative.max(initial=0.0)), error)


def rows(kinds: Iterable[str], cells: int) -> Iterator[Row]:
    """Compute the planes under each variant and yield how they differ."""
    for kind in kinds:
        first: dict[str, np.ndarray] | None = None
        for variant in VARIANTS:
            arrays = _in_process(kind, variant, cells)
            first = first or arrays
            yield compared(kind, variant, first, arrays)


def _in_process(kind: str, variant: str, cells: int) -> dict[str, np.ndarray]:
    """Compute a plane in a separate process, as the compiler reads the environment only once."""
    environment = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "VIJAX_KERNELS")}
    environment |= VARIANTS[variant] | {"PYTHONPATH": str(Path(__file__).parents[1])}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plane.npz"
        command = [sys.executable, __file__, "--only", kind, "--cells", str(cells), "--compute", str(file)]
        subprocess.run(command, env=environment, check=True)
        with np.load(file) as arrays:
            return dict(arrays)


def main() -> int:
    """Print the comparison; the exit status is 1 if a bound is exceeded."""
    description, _, details = str(__doc__).partition("\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=details, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=PLANES, default=list(PLANES), metavar="KIND")
    parser.add_argument("--cells", type=int, default=CELLS, help="cells along each axis (default: %(default)s)")
    parser.add_argument("--compute", help=argparse.SUPPRESS)  # for the processes: a plane, to a file
    options = parser.parse_args()
    if options.compute:
        np.savez(options.compute, **plane(options.only[0], options.cells))  # type: ignore[arg-type]
        return 0
    print(f"{'kind':<11}{'variant':<18}{'impacts':>10}{'labels':>14}{'P, periodic':>14}{'P, aperiodic':>14}")
    exceeded = 0
    for row in rows(options.only, options.cells):
        labels = f"{row.labels} of {row.cells}"
        end = "" if row.within_bounds else "  EXCEEDS A BOUND"
        columns = f"{row.impacts:>10,}{labels:>14}{row.periodic:>14.1e}{row.aperiodic:>14.2f}"
        print(f"{row.kind:<11}{row.variant:<18}{columns}{end}", flush=True)
        exceeded += not row.within_bounds
    return int(exceeded > 0)


if __name__ == "__main__":
    sys.exit(main())
