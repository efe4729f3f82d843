"""What a package offers is loaded name by name: where it stands is read from the imports that a type checker sees."""

import subprocess
import sys
from pathlib import Path

import pytest

import vijax
from vijax import public
from vijax.runtime.offered import Home, homes, load

SOURCE = '''
"""Says `from vijax.model.units import unread`."""
import sys
import vijax.plots as plots
import vijax.model
from pathlib import Path
from vijax.planes.sweep import sweep
from vijax.orbits.orbit_search import search as find_orbits, from_state
if NEVER:
    from vijax.model.sides import Sides
'''
# A name, and folders of the package that no room of its own needs.
SPARED = {
    "impact_pair": {"batch", "design", "orbits", "planes"},
    "trajectory": {"design", "orbits", "planes"},
    "find_orbits": {"design", "planes"},
    "sweep": {"design", "orbits"},
}


def test_places_are_read_and_not_run(tmp_path):
    path = tmp_path / "public.py"
    path.write_text(SOURCE)
    assert homes("vijax", path) == {
        "plots": Home("vijax.plots", None),
        "sweep": Home("vijax.planes.sweep", "sweep"),
        "find_orbits": Home("vijax.orbits.orbit_search", "search"),
        "from_state": Home("vijax.orbits.orbit_search", "from_state"),
        "Sides": Home("vijax.model.sides", "Sides"),
    }


def test_what_stands_there_is_loaded():
    assert load(Home("vijax.plots", None)) is vijax.plots
    assert load(Home("vijax.planes.sweep", "sweep")) is vijax.sweep


def test_all_that_is_offered_is_read():
    assert set(homes("vijax", Path(vijax.__file__).with_name("public.py"))) == set(public.__all__) == set(vijax.__all__)
    assert set(homes("vijax.plots", Path(vijax.plots.__file__))) == set(vijax.plots.__all__)


@pytest.mark.parametrize("name", SPARED)
def test_a_name_loads_its_rooms_alone(name):
    code = f"import sys, vijax; vijax.{name}; print(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    loaded = {room.split(".")[1] for room in said.split() if room.startswith("vijax.")}
    assert "model" in loaded
    assert not loaded & SPARED[name]
