"""Make the pictures of the README and the pages in `scripts/gallery`, each by the command listed here.

    python scripts/pictures.py                  # all: several minutes
    python scripts/pictures.py power_map        # the named pictures
    python scripts/pictures.py --list           # the commands

Pictures of pages with executed code are not included: they are outputs of `python docs --execute`.
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
    "first_map": "-m vijax sweep --kappa 75:400:128:log --energy-ratio-limit 0.1 --plot {}",
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
"""Arguments of Python by picture; {} is the path of the picture, or the folder for a figure of the paper."""


def lines(names: list[str]) -> Iterator[str]:
    """Yield the command of each picture."""
    yield from (f"{name}.png: python {PICTURES[name].format(f'{name}.png')}" for name in names)


def make(name: str) -> None:
    """Run the command of a picture in an empty folder, and move the picture into the gallery."""
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / f"{name}.png"
        target = folder if name.startswith("paper") else str(drawn)
        arguments = [part.format(target) for part in shlex.split(PICTURES[name])]
        subprocess.run([sys.executable, *arguments], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        (made,) = Path(folder).glob("*.png")
        made.replace(GALLERY / f"{name}.png")


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PICTURES)}; all unless given")
    parser.add_argument("--list", action="store_true", help="print the commands, and run none")
    options = parser.parse_args()
    if unknown := set(options.names) - set(PICTURES):
        parser.error(f"there is no picture {', '.join(sorted(unknown))}")
    for name, line in zip(names := options.names or list(PICTURES), lines(names), strict=True):
        print(line, flush=True)
        if not options.list:
            make(name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
