"""`--csv` of all commands that compute a table: a row for each element, units in the header."""

import click
import numpy as np
import pandas as pd
import pytest
import xarray as xr

from scripts import grid
from tests.helpers import no_cell_runs
from vijax.cli import main as command
from vijax.cli.commands.design import _write_optima
from vijax.cli.options.output_files import targets
from vijax.maps import sweep
from vijax.runtime.text_tables import dataset_rows, write_dataset


@pytest.mark.parametrize("name", ["curves", *command.vijax.list_commands(None)])
def test_commands_that_write_files_write_a_table(name):
    page = command.vijax.get_command(click.Context(command.vijax), name)
    options = {option.name for option in page.params}
    assert ("csv" in options) == ("out" in options)
    assert "csv" in options or name in ("docs", "doctor", "explore")


def test_a_map_has_a_row_per_cell(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with no_cell_runs():
        assert grid.main(["--d", "0.1,0.2,0.3", "--kappa", "20,30", "--csv", "map.csv"]) == 0
        dataset = sweep.sweep(d=[0.1, 0.2, 0.3], kappa=[20.0, 30.0])
        assert grid.main(["--d", "0.1", "--kappa", "20", "--csv", "map.csv"]) == 2
    assert "wrote map.csv" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["map.csv"]
    rows = pd.read_csv("map.csv")
    assert rows.shape[0] == 6
    np.testing.assert_allclose(rows["P [J]"], dataset["P"].values.ravel(), rtol=1e-14)
    np.testing.assert_array_equal(rows["d"], np.repeat([0.1, 0.2, 0.3], 2))
    assert (rows["omega [rad s-1]"] == np.pi).all()


def test_rows_of_a_variable_leave_out_padding_and_other_dimensions(tmp_path):
    dataset = xr.Dataset(
        {"v": (("d", "impact"), [[1.0, 2.0], [3.0, np.nan]], {"units": "m"}), "P": ("d", [5.0, 6.0])}
        | {"u": (("d", "strobe"), np.zeros((2, 3)))},
        {"d": [0.1, 0.2], "r": 0.5},
    )
    rows = dataset_rows(dataset, "v")
    assert rows[["d", "impact", "v", "P", "r"]].values.tolist() == [
        [0.1, 0, 1, 5, 0.5],
        [0.1, 1, 2, 5, 0.5],
        [0.2, 0, 3, 6, 0.5],
    ]
    assert "u" not in rows
    assert dataset_rows(dataset.isel(d=0)[["P"]]).to_dict("records") == [{"P": 5.0, "d": 0.1, "r": 0.5}]
    write_dataset(dataset, tmp_path / "v.csv", "v")
    assert (tmp_path / "v.csv").read_text().splitlines()[0] == "d,impact,v [m],P,r"


def test_designs_have_a_row_per_optimum(tmp_path):
    optimum = {"values": {"omega0": 40.0}, "label": "1:1", "P": 1e-5, "P_stderr": 0.0, "power": 2e-5}
    optimum |= {"penetration": [1e-3, 2e-3], "energy_ratio": [0.1, 0.2]}
    _write_optima({"best": optimum, "others": [optimum]}, tmp_path / "one.csv")
    header, first, second = (tmp_path / "one.csv").read_text().splitlines()
    assert header == "omega0 [rad/s],label,P [J],P_stderr [J],power [W],penetration [m],energy_ratio"
    assert first == second == "40.0,1:1,1e-05,0.0,2e-05,0.002,0.2"
    over = {"over": {"name": "s", "values": [0.1, 0.2]}, "designs": [{"best": optimum}, {"best": None}]}
    _write_optima(over, tmp_path / "over.csv")
    assert (tmp_path / "over.csv").read_text().splitlines()[2] == "0.2,,,,,,,"
    _write_optima({"best": None, "others": []}, tmp_path / "none.csv")


def test_a_table_may_be_the_only_file_and_its_name_is_validated(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert targets(None, None, ("a.zarr", "a.png"), False, csv="rows.csv")[:2] == (None, None)
    assert all(targets(None, None, ("a.zarr", "a.png"), False)[:2])
    with pytest.raises(ValueError, match="csv must end in"):
        targets(None, None, ("a.zarr", "a.png"), False, csv="rows.txt")
