"""Checks of the paths of output files before a run begins, so that no run ends with an unwritable file."""

import math
from collections.abc import Mapping
from pathlib import Path


def targets(
    out: str | None,
    plot: str | None,
    defaults: tuple[str, str],
    overwrite: bool,
    ending: str = ".zarr",
    resumable: bool = False,
    csv: str | None = None,
) -> tuple[Path | None, Path | None, Path | None]:
    """Return the validated paths of store, picture and table; None for a file that is not written.

    If none of the three options is specified, store and picture are written at their default paths.

    Args:
        out, plot, csv: Values of the options of store, picture and table.
        defaults: Default paths of store and picture.
        overwrite: Whether existing files may be replaced.
        ending: File name extension of the file of --out.
        resumable: Whether a run can continue an existing store. If so, this function accepts an existing store, which
            `tiled_store.check_writable` validates later, and accepts an existing picture only if vijax drew it.

    Raises:
        ValueError, OSError: If a file cannot be written.
    """
    if out is None and plot is None and csv is None:
        out, plot = defaults
    store = None if out is None else _store(out, ending, overwrite, resumable)
    again = resumable and not overwrite and store is not None and store.exists()
    return store, None if plot is None else _picture(plot, overwrite, again), table_path(csv, overwrite)


def table_path(csv: str | None, overwrite: bool) -> Path | None:
    """Return the validated path of the table; None without the option.

    Raises:
        ValueError, OSError: If the table cannot be written.
    """
    from vijax.runtime.files import check_ending, check_output

    if csv is None:
        return None
    check_ending("csv", csv, ".csv")
    return check_output("csv", csv, overwrite)


def drawn(plot: Path | None, option: str | None, sizes: Mapping[str, int]) -> Path | None:
    """Return the path of the picture; None if the map is a single cell and the user did not specify --plot.

    `option` is the text of --plot, and `sizes` are the numbers of values of the axes.
    """
    # A single cell cannot be drawn. If --plot is specified, the later check of the picture raises the error.
    return None if option is None and math.prod(sizes.values()) == 1 else plot


def _store(out: str, ending: str, overwrite: bool, resumable: bool) -> Path:
    from vijax.maps.storage.store_folder import validate_new_store_path, validate_store_path
    from vijax.runtime.files import check_ending, check_output

    if ending != ".zarr":
        check_ending("out", out, ending)
        return check_output("out", out, overwrite)
    place = validate_store_path("out", out)
    return place if resumable and not overwrite and place.exists() else validate_new_store_path("out", out, overwrite)


def _picture(plot: str, overwrite: bool, again: bool) -> Path:
    from vijax.plots.style import is_drawn
    from vijax.runtime.files import check_output

    picture = check_output("plot", plot, overwrite or again)
    if again and picture.exists() and not is_drawn(picture):
        raise FileExistsError(f"plot must be new or a picture drawn by vijax; got {plot}; take another name")
    return picture
