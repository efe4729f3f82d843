"""The store and the picture that a run will write, looked at before it begins."""

import math
from collections.abc import Mapping
from pathlib import Path


def targets(
    out: str | None,
    plot: str | None,
    defaults: tuple[str, str],
    overwrite: bool,
    ending: str = ".zarr",
    goes_on: bool = False,
    csv: str | None = None,
) -> tuple[Path | None, Path | None, Path | None]:
    """Return the store, the picture and the table to write; without any the defaults of the first two.

    With `goes_on` a store that is there is left to `tiled_store.check`; its picture is drawn again if vijax drew it.

    Raises:
        ValueError, OSError: One of them cannot be written.
    """
    if out is None and plot is None and csv is None:
        out, plot = defaults
    store = None if out is None else _store(out, ending, overwrite, goes_on)
    again = goes_on and not overwrite and store is not None and store.exists()
    return store, None if plot is None else _picture(plot, overwrite, again), table_target(csv, overwrite)


def table_target(csv: str | None, overwrite: bool) -> Path | None:
    """Return the table to write, if there is one; raise unless it can be written."""
    from vijax.runtime.files import check_ending, check_output

    if csv is None:
        return None
    check_ending("csv", csv, ".csv")
    return check_output("csv", csv, overwrite)


def drawn(plot: Path | None, given: str | None, sizes: Mapping[str, int]) -> Path | None:
    """Leave out a picture that nobody asked for where there is but one cell, of which none can be drawn."""
    return None if given is None and math.prod(sizes.values()) == 1 else plot


def _store(out: str, ending: str, overwrite: bool, goes_on: bool) -> Path:
    from vijax.planes.store_folder import check_place, check_store
    from vijax.runtime.files import check_ending, check_output

    if ending != ".zarr":
        check_ending("out", out, ending)
        return check_output("out", out, overwrite)
    place = check_place("out", out)
    return place if goes_on and not overwrite and place.exists() else check_store("out", out, overwrite)


def _picture(plot: str, overwrite: bool, again: bool) -> Path:
    from vijax.plots.style import is_drawn
    from vijax.runtime.files import check_output

    picture = check_output("plot", plot, overwrite or again)
    if again and picture.exists() and not is_drawn(picture):
        raise FileExistsError(f"plot must be new or a picture drawn by vijax; got {plot}; take another name")
    return picture
