"""Make the store of an unfinished plane with the version of vijax that is installed: of its two tiles one is done.

    python make.py 0.2.0.zip

This file runs under every released version, so it uses nothing that one of them lacks.
"""

import os
import sys
import tempfile
import zipfile
from contextlib import suppress
from pathlib import Path

import vijax

PLANE = {
    "d": [0.15, 0.25],
    "kappa": [10.0, 40.0, 100.0, 400.0],
    "outputs": ["P", "period", "impacts_left", "impacts_right"],
}


class Stop(BaseException):
    """End of the run after the first tile."""


def stop(done, total):
    """Stop once a tile is done."""
    if 0 < done < total:
        raise Stop


def make_tiles_small():
    """Set the number of cells of a tile; 0.1.0 does not read VIJAX_TILE."""
    os.environ["VIJAX_TILE"] = "4"
    try:
        from vijax import study
    except ImportError:
        return
    study.SMALLEST_TILE = study.LARGEST_TILE = 4


def main(target):
    """Make the store, and pack it."""
    make_tiles_small()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "map.zarr")
        with suppress(Stop):
            vijax.sweep(**PLANE, out=out, progress=stop)
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as packed:
            for path in sorted(out.rglob("*")):
                if path.is_file():
                    packed.write(path, path.relative_to(out).as_posix())


if __name__ == "__main__":
    main(sys.argv[1])
