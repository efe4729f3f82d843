"""`scripts/tests_for.py` lists the test files that depend on a module; recorded seconds order the files."""

import subprocess
import sys
from types import SimpleNamespace

import pytest

from scripts import tests_for
from tests import seconds

IMPORTS = {
    "package.low": set(),
    "package.middle": {"package.low"},
    "package.other": set(),
    "tests.helpers": {"package.middle"},
    "tests.test_low": {"package.low"},
    "tests.test_cheap": {"package.middle"},
    "tests.test_dear": {"package.middle", "package.other"},
    "tests.test_helped": {"tests.helpers"},
    "tests.test_apart": {"package.other"},
}


def test_files_are_ordered_by_distance_then_by_seconds(monkeypatch):
    monkeypatch.setattr(tests_for, "recorded", lambda: {"tests/test_dear.py": 9.0, "tests/test_cheap.py": 1.5})
    assert tests_for.dependent_files("package.low", IMPORTS) == [
        ("tests/test_low.py", 1, 0.0),
        ("tests/test_cheap.py", 2, 1.5),
        ("tests/test_dear.py", 2, 9.0),
        ("tests/test_helped.py", 3, 0.0),
    ]
    with pytest.raises(ValueError, match=r"MODULE must be .*; got 'package\.high'"):
        tests_for.dependent_files("package.high", IMPORTS)


def test_a_test_of_a_public_name_depends_on_the_module_that_defines_it():
    nearest = tests_for.dependent_files("vijax.orbits.steady")
    assert ("tests/orbits/test_steady.py", 1) in [file[:2] for file in nearest]
    assert "tests/continuation/test_curves.py" in [
        file.path for file in tests_for.dependent_files("vijax.continuation.criticality")
    ]


def test_the_command_runs_the_nearest_files(monkeypatch, capsys):
    started = []
    monkeypatch.setattr(
        subprocess, "run", lambda command, **_: started.append(command) or SimpleNamespace(returncode=3)
    )
    monkeypatch.setattr(sys, "argv", ["tests_for.py", "vijax/runtime/numerics/low_discrepancy.py", "--run", "-x", "-q"])
    assert tests_for.main() == 3
    ((_, _, pytest_name, *arguments),) = started
    assert (pytest_name, arguments[-2:]) == ("pytest", ["-x", "-q"])
    assert "tests/runtime/test_low_discrepancy.py" in arguments
    assert f"{len(arguments) - 2} files" in capsys.readouterr().out


def test_seconds_are_recorded_for_files_that_exist(tmp_path, monkeypatch):
    assert not [path for path in seconds.recorded() if not (tests_for.ROOT / path).exists()]
    monkeypatch.setattr(seconds, "RECORD", tmp_path / "seconds.json")
    seconds.record({"tests/test_b.py": 2.345, "tests/test_a.py": 0.01})
    assert list(seconds.recorded().items()) == [("tests/test_a.py", 0.0), ("tests/test_b.py", 2.3)]
