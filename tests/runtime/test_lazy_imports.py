"""Public names are loaded one by one; their locations are read from the imports that a type checker sees."""

import subprocess
import sys
from pathlib import Path

import pytest

import vijax
from vijax import public
from vijax.runtime.lazy_imports import NameLocation, load, name_locations

SOURCE = '''
"""Says `from vijax.model.units import unread`."""
import sys
import vijax.plots as plots
import vijax.model
from pathlib import Path
from vijax.maps.sweep import sweep
from vijax.orbits.orbit_search import search as find_orbits, orbits_from_states
if NEVER:
    from vijax.model.walls.sides import Sides
'''
# A name, and folders of the package that its modules do not import.
SPARED = {
    "impact_pair": {"simulation", "design", "orbits", "continuation", "maps"},
    "trajectory": {"design", "orbits", "continuation", "maps"},
    "find_orbits": {"design", "continuation", "maps"},
    "sweep": {"design", "orbits", "continuation"},
}


def test_locations_are_read_without_running_the_source(tmp_path):
    path = tmp_path / "public.py"
    path.write_text(SOURCE)
    assert name_locations("vijax", path) == {
        "plots": NameLocation("vijax.plots", None),
        "sweep": NameLocation("vijax.maps.sweep", "sweep"),
        "find_orbits": NameLocation("vijax.orbits.orbit_search", "search"),
        "orbits_from_states": NameLocation("vijax.orbits.orbit_search", "orbits_from_states"),
        "Sides": NameLocation("vijax.model.walls.sides", "Sides"),
    }


def test_a_location_is_loaded():
    assert load(NameLocation("vijax.plots", None)) is vijax.plots
    assert load(NameLocation("vijax.maps.sweep", "sweep")) is vijax.sweep


def test_all_public_names_have_a_location():
    assert (
        set(name_locations("vijax", Path(vijax.__file__).with_name("public.py")))
        == set(public.__all__)
        == set(vijax.__all__)
    )
    assert set(name_locations("vijax.plots", Path(vijax.plots.__file__))) == set(vijax.plots.__all__)


@pytest.mark.parametrize("name", SPARED)
def test_a_name_loads_only_the_folders_that_it_needs(name):
    code = f"import sys, vijax; vijax.{name}; print(*sys.modules)"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    loaded = {module.split(".")[1] for module in output.split() if module.startswith("vijax.")}
    assert "model" in loaded
    assert not loaded & SPARED[name]
