"""Make the pictures that README and the pages keep in `scripts/gallery`, each by the command that stands here.

    python scripts/pictures.py                  # all: several minutes
    python scripts/pictures.py power_map        # some
    python scripts/pictures.py --list           # the commands

Pictures of pages whose code is executed are no part of it: they are outputs, which `python docs --execute` makes anew.
"""

import argparse
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
GALLERY = Path(__file__).parent / "gallery"

PICTURES = {
    "power_map": "-m vijax sweep --plot {}",
    "explorer": "-m benchmarks.explore --picture {}",
    "curves": "-m vijax curves --plot {}",
    "design_paper": "-m vijax design --d 0.2 --plot {}",
    "design_small": "-m vijax design --d 0.2 --r 0.5 --A 3 --omega 10pi --set V=1700 --tolerance omega0=5% --plot {}",
    "averages": "-m benchmarks.averages --chart {}",
    "rk4_stability": "-m benchmarks.failures --plot {}",
    "work_precision": "-m benchmarks.work_precision --redraw --chart {}",
    "paper_8": "scripts/paper --figure 8 --into {}",
}
"""What Python is told after its name; {} is the picture, or for a figure of the paper its folder."""


def lines(names: list[str]) -> Iterator[str]:
    """Say the command of each picture."""
    yield from (f"{name}.png: python {PICTURES[name].format(f'{name}.png')}" for name in names)


def make(name: str) -> None:
    """Run the command of a picture in an empty folder, and put what it drew into the gallery."""
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / f"{name}.png"
        target = folder if name.startswith("paper") else str(drawn)
        arguments = [one.format(target) for one in shlex.split(PICTURES[name])]
        subprocess.run([sys.executable, *arguments], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        (made,) = Path(folder).glob("*.png")
        made.replace(GALLERY / f"{name}.png")


def main() -> int:
    """Make what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PICTURES)}; all unless given")
    parser.add_argument("--list", action="store_true", help="say the commands, and run none")
    given = parser.parse_args()
    if unknown := set(given.names) - set(PICTURES):
        parser.error(f"there is no picture {', '.join(sorted(unknown))}")
    for name, line in zip(names := given.names or list(PICTURES), lines(names), strict=True):
        print(line, flush=True)
        if not given.list:
            make(name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
