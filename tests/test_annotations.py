"""Shapes and types that annotations name are those that come when vijax runs."""

import subprocess
import sys
from pathlib import Path


def test_annotations_are_true_of_a_run_of_every_kind():
    tour = Path(__file__).parent / "tour.py"
    done = subprocess.run([sys.executable, tour], capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr[-4000:]
