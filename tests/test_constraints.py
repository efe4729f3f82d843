"""The files of tested versions name all that the package requires, in versions that it accepts."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from scripts import constraints

ROOT = Path(__file__).parent.parent
FILES = ("constraints.txt", "constraints-3.13.txt")


@pytest.mark.parametrize(
    ("version", "file"), [((3, 11), FILES[0]), ((3, 12), FILES[0]), ((3, 13), FILES[1]), ((3, 14), FILES[1])]
)
def test_the_file_fits_the_version_of_python(version, file):
    assert constraints.file_for(version) == file


def test_the_module_prints_the_file_for_the_python_that_runs_it():
    process = subprocess.run([sys.executable, "-m", "scripts.constraints"], cwd=ROOT, capture_output=True, text=True)
    assert process.stdout == f"{constraints.file_for(sys.version_info[:2])}\n"


@pytest.mark.parametrize("file", FILES)
def test_all_requirements_have_a_version_that_the_package_accepts(file):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    texts = [*project["dependencies"], *(text for extra in project["optional-dependencies"].values() for text in extra)]
    pinned = constraints.pinned(file)
    for requirement in map(Requirement, texts):
        name = canonicalize_name(requirement.name)
        if name != "vijax":
            assert pinned[name] in requirement.specifier, name


@pytest.mark.parametrize("file", FILES)
def test_all_lines_are_comments_or_single_versions(file):
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    assert len(constraints.pinned(file)) == len(pins)
    assert not any(character in line for line in pins for character in "/@; ")
