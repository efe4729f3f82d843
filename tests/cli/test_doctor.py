"""`vijax doctor`: it names what vijax runs on, and tells right numbers from wrong ones."""

import subprocess
import sys

import numpy as np
import pytest

from vijax.cli import doctor, main
from vijax.runtime import cache_folder, xla


def test_known_numbers_come_out_right_to_eleven_digits(capsys):
    assert main.main(["doctor"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if line[:1] != "r")
    assert f"numpy {np.__version__}" in lines["packages"]
    assert "cpu" in lines["devices"]
    assert lines["kernels"].startswith("on")
    assert all(one.right and one.error < 1e-11 for one in doctor._checks())


@pytest.mark.parametrize("found", [1 + 1e-9, float("nan")])
def test_a_wrong_number_is_named_and_ends_with_1(capsys, monkeypatch, found):
    monkeypatch.setattr(doctor, "_checks", lambda: [doctor._Check("a number", 1.0, found, 1e-11)])
    assert main.main(["doctor"]) == 1
    shown = capsys.readouterr()
    assert "WRONG         a number" in shown.out
    assert "computes wrong numbers" in shown.err


def test_it_says_why_nothing_is_kept_and_why_kernels_are_off(monkeypatch):
    monkeypatch.setattr(cache_folder, "kept", lambda: None)
    monkeypatch.setattr(xla, "KERNELS", False)
    about = dict(doctor._programs())
    assert about["kept programs"].startswith("none: ")
    assert about["kernels"] == "off: VIJAX_KERNELS is 0"


def test_it_says_why_xla_makes_no_kernels(monkeypatch):
    monkeypatch.setattr(xla, "kernel_failure", lambda: "XLA ignores the mark of kernels")
    assert doctor._kernels() == "off, planes take longer: XLA ignores the mark of kernels"


def test_the_self_test_loads_no_tables():
    """To load xarray takes longer than the cell that is computed."""
    code = "import sys; from vijax.cli import doctor; doctor._checks(); sys.exit('xarray' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_the_folder_counts_programs_alone(tmp_path):
    (tmp_path / f"jit_f-{64 * 'a'}-cache").write_bytes(b"12345")
    (tmp_path / "notes.txt").write_bytes(b"1")
    assert cache_folder.content(tmp_path) == (1, 5)
