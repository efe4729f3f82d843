"""Shapes and types that annotations name are those that come when vijax runs."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import cases


# The other kinds take a minute and more: `python tests/annotations/tour.py` is the whole tour.
@pytest.mark.parametrize("kind", cases(["planes", "motions", "orbits"], long=("motions", "orbits")))
def test_annotations_are_true_of_a_run(kind):
    tour = Path(__file__).parent / "tour.py"
    done = subprocess.run([sys.executable, tour, kind], capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr[-4000:]
