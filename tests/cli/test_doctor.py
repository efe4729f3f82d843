"""`vijax doctor`: it prints the environment of vijax, and detects wrong numbers."""

import subprocess
import sys

import numpy as np
import pytest

from vijax.cli import main
from vijax.cli.commands import doctor
from vijax.runtime.compilation import cache_folder, xla


def test_reference_numbers_are_right_to_eleven_digits(capsys):
    assert main.main(["doctor"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if line[:1] != "r")
    assert f"numpy {np.__version__}" in lines["packages"]
    assert "cpu" in lines["devices"]
    assert lines["kernels"].startswith("on")
    assert all(check.right and check.error < 1e-11 for check in doctor._checks())


@pytest.mark.parametrize("value", [1 + 1e-9, float("nan")])
def test_a_wrong_number_is_named_with_exit_code_1(capsys, monkeypatch, value):
    monkeypatch.setattr(doctor, "_checks", lambda: [doctor._Check("a number", 1.0, value, 1e-11)])
    assert main.main(["doctor"]) == 1
    streams = capsys.readouterr()
    assert "WRONG         a number" in streams.out
    assert "computes wrong numbers" in streams.err


def test_doctor_prints_the_reasons_for_no_cache_and_no_kernels(monkeypatch):
    monkeypatch.setattr(cache_folder, "program_folder", lambda: None)
    monkeypatch.setattr(xla, "KERNELS", False)
    about = dict(doctor._programs())
    assert about["kept programs"].startswith("none: ")
    assert about["kernels"] == "off: VIJAX_KERNELS is 0"


def test_doctor_prints_why_xla_makes_no_kernels(monkeypatch):
    monkeypatch.setattr(xla, "kernel_failure", lambda: "XLA ignores the mark of kernels")
    assert doctor._kernels() == "off, planes take longer: XLA ignores the mark of kernels"


def test_the_self_test_does_not_import_xarray():
    """The import of xarray takes longer than the simulation of the cell."""
    code = "import sys; from vijax.cli.commands import doctor; doctor._checks(); sys.exit('xarray' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_only_programs_of_the_folder_are_counted(tmp_path):
    (tmp_path / f"jit_f-{64 * 'a'}-cache").write_bytes(b"12345")
    (tmp_path / "notes.txt").write_bytes(b"1")
    assert cache_folder.content(tmp_path) == (1, 5)
