"""Where the map of a page and its curves come from: datasets, or stores; that of the map may grow, be damaged or go."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vijax.explorer import overlay
from vijax.explorer.plane import ExploredPlane, explored
from vijax.explorer.worker import one_line
from vijax.planes import store_names
from vijax.planes.store import load
from vijax.planes.sweep import sweep

if TYPE_CHECKING:
    import xarray as xr


class Source:
    """A map, read again when its files have changed, and curves over it, which are read once.

    `name` says what it is in a few words.

    Args:
        given: A dataset, the path of a store, or None for a small plane that is made when it is first read.
        curves: What `curve_dataset` returned, the path of a store of it, or None.

    Raises:
        ValueError, OSError: What is wrong with the curves.
    """

    def __init__(
        self, given: "xr.Dataset | str | Path | None", curves: "xr.Dataset | str | Path | None" = None
    ) -> None:
        self.path = Path(given) if isinstance(given, str | Path) else None
        self._dataset: xr.Dataset | None = None if isinstance(given, str | Path) else given
        self.name = self.path.name if self.path else "the default plane" if given is None else "a dataset"
        self.curves = None if curves is None else overlay.taken(curves)
        self._read: tuple[tuple[int, int], ExploredPlane] | None = None

    def stamp(self) -> tuple[int, int]:
        """Tell a state of the store from any other: how many tiles are done, and when a file of it was last written."""
        if self.path is None:
            return 0, 0
        records = [file for file in (self.path / store_names.TILES).glob("[0-9]*.json")]
        files = [*records, self.path / "zarr.json", self.path / store_names.LIST]
        return len(records), max((file.stat().st_mtime_ns for file in files if file.exists()), default=0)

    def plane(self) -> ExploredPlane:
        """Read the map, or return what was read if nothing has changed since.

        Raises:
            ValueError, OSError: What is wrong with it, in one line: a damaged or hostile store raises anything.
        """
        stamp = self.stamp()
        if self._read is None or self._read[0] != stamp:
            try:
                self._read = stamp, explored(self._found())
            except MemoryError as error:
                raise ValueError(f"the map must fit in memory; got {self.name} ({one_line(error)})") from None
            except (ValueError, OSError):
                raise
            except Exception as error:
                cause = f"{type(error).__name__}: {one_line(error)}"
                raise ValueError(f"the map must be one that vijax.sweep made; got {self.name} ({cause})") from error
        return self._read[1]

    def check(self) -> None:
        """Read the map, and raise ValueError or OSError unless it can be shown, and the curves are of it."""
        try:
            plane = self.plane()
        except (ValueError, OSError) as error:
            raise type(error)(f"source: {error}") from None
        if self.curves is not None:
            overlay.check(self.curves, plane, self.path)

    def _found(self) -> "xr.Dataset":
        if self.path is not None:
            return load(self.path)
        if self._dataset is None:
            self._dataset = sweep(d=np.linspace(0.05, 0.3, 64), kappa=np.geomspace(3.0, 400.0, 64))
        return self._dataset
