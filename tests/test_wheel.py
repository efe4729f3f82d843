"""The sdist and the wheel contain only the package; the wheel works with its requirements alone."""

import ast
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import vijax
from scripts import constraints, import_layers

ROOT = Path(__file__).parent.parent
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
OTHER_FILES = {"CHANGELOG.md", "CONTRIBUTING.md", "PKG-INFO", "README.md", "pyproject.toml", ".gitignore"}
OTHER_FILES |= {"constraints.txt", "constraints-3.13.txt"}

EXTRAS = {"dask", "distributed", "IPython", "bokeh", "jinja2", "tornado"}  # of `cluster`, of notebooks, of `explore`

USER = """
import numpy as np
import xarray as xr

import vijax

plane: xr.Dataset = vijax.sweep(d=np.linspace(0.1, 0.3, 4), kappa=[3.0, 40.0], wall="rigid", progress=print)
device = vijax.Harvester(s=0.2)
pair: vijax.ImpactPair = device.pair()
path = vijax.trajectory(pair, 0.02, 0.3, periods=10, method="ode")
speed: float = float(path.impacts.v_in[0])
version: str = vijax.__version__
"""
MISTAKES = """
import vijax

vijax.sweep(d="wide")
vijax.sweep(depth=0.2)
vijax.swep(d=0.2)
vijax.load(3)
vijax.sweep(d=0.2, wall="hard")
vijax.optimise(steps=3)
"""


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with an sdist and a wheel."""
    place = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-d", str(place)], cwd=ROOT, check=True)
    return place


def test_the_sdist_holds_the_package_alone(built):
    (file,) = built.glob("*.tar.gz")
    with tarfile.open(file) as archive:
        names = {member.name.removeprefix(f"vijax-{VERSION}/") for member in archive.getmembers() if member.isfile()}
    assert {name for name in names if not name.startswith("vijax/")} == OTHER_FILES
    assert {name for name in names if name.startswith("vijax/")} == package()


def test_the_wheel_holds_the_package_alone(built):
    (file,) = built.glob("*.whl")
    with zipfile.ZipFile(file) as archive:
        names = {name for name in archive.namelist() if not name.startswith(f"vijax-{VERSION}.dist-info/")}
    assert names == package()
    assert "vijax/py.typed" in names


def package() -> set[str]:
    """Return the files of the package, by their paths in an archive."""
    files = (path for path in (ROOT / "vijax").rglob("*") if path.is_file() and path.suffix != ".pyc")
    return {path.relative_to(ROOT).as_posix() for path in files}


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory) -> Path:
    """The Python of an environment with the wheel, and with its required distributions in the pinned versions.

    The distributions are links into the environment of the tests, as a new installation takes half a minute.
    """
    place = tmp_path_factory.mktemp("environment")
    venv.create(place, symlinks=True)
    (site,) = place.glob("lib/python*/site-packages")
    python = place / "bin" / "python"
    (wheel,) = built.glob("*.whl")
    options = ["--quiet", "--disable-pip-version-check", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([sys.executable, "-m", "pip", "--python", str(python), "install", *options, str(wheel)], check=True)
    (record,) = site.glob("vijax-*.dist-info")
    for distribution in needed(metadata.Distribution.at(record)):
        tops = {file.parts[0] for file in distribution.files or () if file.parts[0] not in ("..", "__pycache__")}
        for top in tops:
            if not (site / top).exists():
                (site / top).symlink_to(Path(str(distribution.locate_file(top))).resolve())
    return python


def needed(of: metadata.Distribution) -> Iterator[metadata.Distribution]:
    """Yield the distributions that a distribution requires, with their requirements."""
    pinned = constraints.pinned(constraints.file_for(sys.version_info[:2]))
    newest = "VIJAX_NEWEST" in os.environ  # scripts/check.sh --newest: the newest versions are right
    distributions: dict[str, metadata.Distribution] = {}
    waiting = [(text, frozenset({""})) for text in of.requires or ()]
    while waiting:
        text, extras = waiting.pop()
        requirement = Requirement(text)
        if requirement.marker and not any(requirement.marker.evaluate({"extra": extra}) for extra in extras):
            continue
        name = canonicalize_name(requirement.name)
        if name not in distributions:
            distributions[name] = metadata.distribution(name)
            assert newest or distributions[name].version == pinned[name], (
                f"{name} is not the version of the constraints"
            )
        waiting += [(more, frozenset({"", *requirement.extras})) for more in distributions[name].requires or ()]
    yield from distributions.values()


def alone(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command without the settings of the environment of the tests."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("PYTHON") and name != "MYPYPATH"
    }
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


def test_the_wheel_alone_has_its_version(installed, tmp_path):
    result = alone([str(installed), "-c", "import vijax; print(vijax.__version__)"], tmp_path)
    assert (result.stdout, result.stderr) == (f"{VERSION}\n", "")


def test_the_wheel_alone_maps_a_plane(installed, tmp_path):
    plane = ["--d", "0.05:0.3:8", "--kappa", "3:400:8:log", "--plot", "map.png"]
    result = alone([str(installed.parent / "vijax"), "sweep", *plane], tmp_path)
    assert result.returncode == 0, result.stderr
    assert "largest admissible P" in result.stdout
    assert (tmp_path / "map.png").stat().st_size > 10_000


def test_the_wheel_alone_requires_all_that_it_imports(installed, tmp_path):
    files = (ROOT / "vijax").rglob("*.py")
    names = {
        name.partition(".")[0] for file in files for name in import_layers.imported_names(ast.parse(file.read_text()))
    }
    packages = sorted(names - sys.stdlib_module_names - EXTRAS)
    code = "import importlib, sys; print(len([importlib.import_module(name) for name in sys.argv[1:]]))"
    result = alone([str(installed), "-c", code, *packages], tmp_path)
    assert result.stdout == f"{len(packages)}\n", result.stderr
    assert {"jax", "matplotlib", "vijax"} < set(packages)


def test_a_user_of_the_wheel_has_the_types(installed, tmp_path):
    (tmp_path / "user.py").write_text(USER)
    (tmp_path / "mistakes.py").write_text(MISTAKES)
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(installed)]
    # A table of pandas, which has no types.
    reveals = [f"reveal_type(vijax.{name})" for name in vijax.__all__ if name != "curve_rows"]
    reveals += [f"reveal_type(vijax.plots.{name})" for name in vijax.plots.__all__]
    (tmp_path / "names.py").write_text("\n".join(["import vijax", *reveals, ""]))
    files = ["user.py", "mistakes.py", "names.py"]
    result = alone([*command, "--cache-dir", str(tmp_path / "cache"), *files], tmp_path)
    errors = re.findall(r"^(\w+)\.py:(\d+): error", result.stdout, re.M)
    lines = [n for n, line in enumerate(MISTAKES.splitlines(), 1) if line.startswith("vijax.")]
    assert errors == [("mistakes", str(line)) for line in lines], result.stdout + result.stderr
    revealed = re.findall(r'^names.py:\d+: note: Revealed type is "(.*)"$', result.stdout, re.M)
    assert len(revealed) == len(reveals)
    assert not [kind for kind in revealed if re.search(r"^Any$|: Any( =|[,)])|-> Any$", kind)]
