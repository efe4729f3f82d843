"""Stores of released versions: they load with the values of a sweep, and unfinished maps resume.

`tests/data/stores` contains a store of every version; its README.md describes how the stores were made.
"""

import json
import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest

import vijax
from tests.data.stores.make import PLANE
from tests.helpers import stand_in
from vijax.model.records import Status
from vijax.simulation import simulate

STORES = sorted((Path(__file__).parent.parent / "data" / "stores").glob("*.zip"))
# Computed by `vijax.sweep(**PLANE, method="ode")`; the solver of diffrax uses no closed form of the exact engine.
P = [
    [5.57132049e-03, 2.15425472e-04, 2.07292377e-05, 8.82774363e-07],
    [9.97100268e-03, 3.48214283e-04, 3.48511523e-05, 1.39401481e-06],
]
IMPACTS_LEFT = [[1, 4, 3, 3], [1, 1, 1, 1]]
PERIOD = [[1, 2, 2, 2], [1, 1, 1, 1]]


@pytest.fixture(params=STORES, ids=lambda path: path.stem)
def out(request, tmp_path) -> Path:
    """Unpack the store of one version."""
    path = tmp_path / "map.zarr"
    with zipfile.ZipFile(request.param) as packed:
        packed.extractall(path)
    return path


def test_all_released_versions_have_a_small_store():
    changelog = Path(vijax.__file__).parent.parent / "CHANGELOG.md"
    released = [line[3:] for line in changelog.read_text(encoding="utf-8").splitlines() if line.startswith("## ")]
    assert {path.stem for path in STORES} == {name.lower() for name in released}
    assert all(path.stat().st_size < 20_000 for path in STORES)


def test_store_of_a_released_version_loads_with_the_right_values(out):
    result = vijax.load(out)
    ran = (result["status"] == Status.OK).values
    assert ran.sum() == 4
    assert ((result["status"] == Status.NOT_RUN).values != ran).all()
    np.testing.assert_allclose(result["P"].values[ran], np.array(P)[ran], rtol=2e-7)
    np.testing.assert_array_equal(result["impacts_left"].values[ran], np.array(IMPACTS_LEFT)[ran])
    np.testing.assert_array_equal(result["period"].values[ran], np.array(PERIOD)[ran])
    assert np.isnan(result["P"].values[~ran]).all()


def test_a_store_of_a_released_version_is_resumed(out, monkeypatch):
    """A stand-in for the engine counts the cells that this test runs."""
    ran = []

    def summarise(*arguments, count, **settings):
        ran.append(count)
        return stand_in(*arguments, count=count, **settings)

    monkeypatch.setattr(simulate, "summarise", summarise)
    monkeypatch.setattr("vijax.maps.execution.dispatch.tile_devices", lambda: jax.devices()[:1])
    before = vijax.load(out)
    completed = (before["status"] == Status.OK).values
    result = vijax.sweep(**PLANE, out=out).load()
    assert sum(ran) == 4
    for name in before:
        np.testing.assert_array_equal(result[name].values[completed], before[name].values[completed])
    assert (result["status"] != Status.NOT_RUN).all()
    assert result.identical(vijax.load(out))
    with pytest.raises(FileExistsError, match=r"r is 0.5, and not 0.4; allow overwriting"):
        vijax.sweep(**PLANE, r=0.4, out=out)


def test_store_id_is_read_under_its_former_name(out, tmp_path, monkeypatch):
    """Versions up to 0.2.0 wrote the entry `birth` into the list and the tile records; its name is `store_id` now."""
    monkeypatch.setattr(simulate, "summarise", stand_in)
    new = tmp_path / "new.zarr"
    vijax.sweep(**PLANE, out=new)
    for file in (new / "vijax.json", *(new / "status" / "tiles").glob("*.json")):
        assert json.loads(file.read_text())["store_id"] == (new / "status" / "tiles" / "lock").read_text()
    list_bytes = (out / "vijax.json").read_bytes()
    store_id = json.loads(list_bytes)["birth"]
    # Without a lock, and for metadata that are written again, the id comes from the list.
    (out / "status" / "tiles" / "lock").write_bytes(b"")
    (out / "d" / "c" / "0").unlink()
    vijax.sweep(**PLANE, out=out)
    assert (out / "status" / "tiles" / "lock").read_text() == store_id
    assert (out / "vijax.json").read_bytes() == list_bytes
    records = [json.loads(file.read_text()) for file in (out / "status" / "tiles").glob("*.json")]
    names = [("birth" in record, "store_id" in record) for record in records]
    assert sorted(names) == [(False, True), (True, False)]
    assert {record.get("birth", record.get("store_id")) for record in records} == {store_id}
