"""Stores of released versions: they open with the numbers of a sweep, and their unfinished planes go on.

`tests/data/stores` holds a store of each version; README.md there states how each was made.
"""

import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest

import vijax
from tests.data.stores.make import PLANE
from tests.helpers import stand_in
from vijax.batch import simulate
from vijax.model.records import Status

STORES = sorted((Path(__file__).parent.parent / "data" / "stores").glob("*.zip"))
# By `vijax.sweep(**PLANE, method="ode")`: diffrax's solver shares no closed form with the exact engine.
P = [
    [5.57132049e-03, 2.15425472e-04, 2.07292377e-05, 8.82774363e-07],
    [9.97100268e-03, 3.48214283e-04, 3.48511523e-05, 1.39401481e-06],
]
IMPACTS_LEFT = [[1, 4, 3, 3], [1, 1, 1, 1]]
PERIOD = [[1, 2, 2, 2], [1, 1, 1, 1]]


@pytest.fixture(params=STORES, ids=lambda path: path.stem)
def out(request, tmp_path) -> Path:
    """The store of a version, unpacked."""
    path = tmp_path / "map.zarr"
    with zipfile.ZipFile(request.param) as packed:
        packed.extractall(path)
    return path


def test_every_released_version_has_a_small_store():
    pages = Path(vijax.__file__).parent.parent / "CHANGELOG.md"
    released = [line[3:] for line in pages.read_text(encoding="utf-8").splitlines() if line.startswith("## ")]
    assert {path.stem for path in STORES} == {name.lower() for name in released}
    assert all(path.stat().st_size < 20_000 for path in STORES)


def test_a_store_of_a_released_version_opens_with_right_numbers(out):
    found = vijax.load(out)
    ran = (found["status"] == Status.OK).values
    assert ran.sum() == 4
    assert ((found["status"] == Status.NOT_RUN).values != ran).all()
    np.testing.assert_allclose(found["P"].values[ran], np.array(P)[ran], rtol=2e-7)
    np.testing.assert_array_equal(found["impacts_left"].values[ran], np.array(IMPACTS_LEFT)[ran])
    np.testing.assert_array_equal(found["period"].values[ran], np.array(PERIOD)[ran])
    assert np.isnan(found["P"].values[~ran]).all()


def test_a_store_of_a_released_version_goes_on(out, monkeypatch):
    """A stand-in for the engine marks the cells that are run here."""
    ran = []

    def summarise(*given, count, **settings):
        ran.append(count)
        return stand_in(*given, count=count, **settings)

    monkeypatch.setattr(simulate, "summarise", summarise)
    monkeypatch.setattr("vijax.planes.dispatch.places", lambda: jax.devices()[:1])
    before = vijax.load(out)
    there = (before["status"] == Status.OK).values
    found = vijax.sweep(**PLANE, out=out).load()
    assert sum(ran) == 4
    for name in before:
        np.testing.assert_array_equal(found[name].values[there], before[name].values[there])
    assert (found["status"] != Status.NOT_RUN).all()
    assert found.identical(vijax.load(out))
    with pytest.raises(FileExistsError, match=r"r is 0.5, and not 0.4; allow overwriting"):
        vijax.sweep(**PLANE, r=0.4, out=out)
