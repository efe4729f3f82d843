"""Shapes and types in annotations agree with the values at run time."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import cases


# The other kinds take more than a minute: `python tests/annotations/tour.py` runs all kinds.
@pytest.mark.parametrize("kind", cases(["planes", "motions", "orbits"], long=("motions", "orbits")))
def test_annotations_agree_with_a_run(kind):
    tour = Path(__file__).parent / "tour.py"
    process = subprocess.run([sys.executable, tour, kind], capture_output=True, text=True, check=False)
    assert not process.returncode, process.stderr[-4000:]
