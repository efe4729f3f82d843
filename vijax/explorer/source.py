"""Source of a page's map and curves: datasets or stores. The store of a map may change while pages are open."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vijax.explorer import overlay
from vijax.explorer.plane import ExploredPlane, explored
from vijax.explorer.server.worker import error_line
from vijax.maps.storage import store_names
from vijax.maps.storage.store import load
from vijax.maps.sweep import sweep

if TYPE_CHECKING:
    import xarray as xr


class Source:
    """A map and, optionally, its bifurcation curves. The map is read again when its store changes, the curves are not.

    The attribute `name` is a short description of the map for the user.

    Args:
        dataset: A dataset, the path of a store, or None for a small plane that is computed when it is first read.
        curves: Result of `curve_dataset`, the path of its store, or None.

    Raises:
        ValueError, OSError: The curves are invalid.
    """

    def __init__(
        self, dataset: "xr.Dataset | str | Path | None", curves: "xr.Dataset | str | Path | None" = None
    ) -> None:
        self.path = Path(dataset) if isinstance(dataset, str | Path) else None
        self._dataset: xr.Dataset | None = None if isinstance(dataset, str | Path) else dataset
        self.name = self.path.name if self.path else "the default plane" if dataset is None else "a dataset"
        self.curves = None if curves is None else overlay.read_curves(curves)
        self._read: tuple[tuple[int, int], ExploredPlane] | None = None

    def stamp(self) -> tuple[int, int]:
        """Return a value that changes when the map's store changes; (0, 0) without a store.

        The value is the number of finished tiles and the latest modification time of the files in ns.
        """
        if self.path is None:
            return 0, 0
        records = [file for file in (self.path / store_names.TILES).glob("[0-9]*.json")]
        files = [*records, self.path / "zarr.json", self.path / store_names.LIST]
        return len(records), max((file.stat().st_mtime_ns for file in files if file.exists()), default=0)

    def plane(self) -> ExploredPlane:
        """Return the map; it is read again only if its store has changed.

        Raises:
            ValueError, OSError: The map cannot be read. Other errors, of a damaged or hostile store, are converted to
                ValueError.
        """
        stamp = self.stamp()
        if self._read is None or self._read[0] != stamp:
            try:
                self._read = stamp, explored(self._read_dataset())
            except MemoryError as error:
                raise ValueError(f"the map must fit in memory; got {self.name} ({error_line(error)})") from None
            except (ValueError, OSError):
                raise
            except Exception as error:
                cause = f"{type(error).__name__}: {error_line(error)}"
                raise ValueError(f"the map must be one that vijax.sweep made; got {self.name} ({cause})") from error
        return self._read[1]

    def check(self) -> None:
        """Read the map; raise ValueError or OSError unless the page can show it and the curves belong to it."""
        try:
            plane = self.plane()
        except (ValueError, OSError) as error:
            raise type(error)(f"source: {error}") from None
        if self.curves is not None:
            overlay.check(self.curves, plane, self.path)

    def _read_dataset(self) -> "xr.Dataset":
        if self.path is not None:
            return load(self.path)
        if self._dataset is None:
            self._dataset = sweep(d=np.linspace(0.05, 0.3, 64), kappa=np.geomspace(3.0, 400.0, 64))
        return self._dataset
