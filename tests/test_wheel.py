"""What is built is what a user needs and no more: the sdist, the wheel, and the wheel alone with what it asks for."""

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
from scripts import constraints, house

ROOT = Path(__file__).parent.parent
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
BESIDE = {"CHANGELOG.md", "CONTRIBUTING.md", "PKG-INFO", "README.md", "pyproject.toml", ".gitignore"}
BESIDE |= {"constraints.txt", "constraints-3.13.txt"}

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
    assert {name for name in names if not name.startswith("vijax/")} == BESIDE
    assert {name for name in names if name.startswith("vijax/")} == package()


def test_the_wheel_holds_the_package_alone(built):
    (file,) = built.glob("*.whl")
    with zipfile.ZipFile(file) as archive:
        names = {name for name in archive.namelist() if not name.startswith(f"vijax-{VERSION}.dist-info/")}
    assert names == package()
    assert "vijax/py.typed" in names


def package() -> set[str]:
    """The files of the package, as they stand in an archive."""
    files = (path for path in (ROOT / "vijax").rglob("*") if path.is_file() and path.suffix != ".pyc")
    return {path.relative_to(ROOT).as_posix() for path in files}


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory) -> Path:
    """The Python of an environment with the wheel, and with the distributions that it asks for, in the pinned versions.

    These are links to those of the environment of the tests: to install them anew takes half a minute.
    """
    place = tmp_path_factory.mktemp("environment")
    venv.create(place, symlinks=True)
    (site,) = place.glob("lib/python*/site-packages")
    python = place / "bin" / "python"
    (wheel,) = built.glob("*.whl")
    quiet = ["--quiet", "--disable-pip-version-check", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([sys.executable, "-m", "pip", "--python", str(python), "install", *quiet, str(wheel)], check=True)
    (record,) = site.glob("vijax-*.dist-info")
    for distribution in needed(metadata.Distribution.at(record)):
        tops = {file.parts[0] for file in distribution.files or () if file.parts[0] not in ("..", "__pycache__")}
        for top in tops:
            if not (site / top).exists():
                (site / top).symlink_to(Path(str(distribution.locate_file(top))).resolve())
    return python


def needed(of: metadata.Distribution) -> Iterator[metadata.Distribution]:
    """The distributions that one asks for, with theirs."""
    pinned = constraints.pinned(constraints.file_for(sys.version_info[:2]))
    newest = "VIJAX_NEWEST" in os.environ  # scripts/check.sh --newest: whatever is the newest is right
    known: dict[str, metadata.Distribution] = {}
    waiting = [(text, frozenset({""})) for text in of.requires or ()]
    while waiting:
        text, extras = waiting.pop()
        asked = Requirement(text)
        if asked.marker and not any(asked.marker.evaluate({"extra": extra}) for extra in extras):
            continue
        name = canonicalize_name(asked.name)
        if name not in known:
            known[name] = metadata.distribution(name)
            assert newest or known[name].version == pinned[name], f"{name} is not the version of the constraints"
        waiting += [(more, frozenset({"", *asked.extras})) for more in known[name].requires or ()]
    yield from known.values()


def alone(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command that sees no environment but its own."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON") and name != "MYPYPATH"}
    return subprocess.run(command, cwd=folder, env=kept, capture_output=True, text=True)


def test_the_wheel_alone_knows_its_version(installed, tmp_path):
    done = alone([str(installed), "-c", "import vijax; print(vijax.__version__)"], tmp_path)
    assert (done.stdout, done.stderr) == (f"{VERSION}\n", "")


def test_the_wheel_alone_maps_a_plane(installed, tmp_path):
    plane = ["--d", "0.05:0.3:8", "--kappa", "3:400:8:log", "--plot", "map.png"]
    done = alone([str(installed.parent / "vijax"), "sweep", *plane], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "largest admissible P" in done.stdout
    assert (tmp_path / "map.png").stat().st_size > 10_000


def test_the_wheel_alone_asks_for_all_that_it_imports(installed, tmp_path):
    files = (ROOT / "vijax").rglob("*.py")
    names = {name.partition(".")[0] for file in files for name in house.imported(ast.parse(file.read_text()))}
    asked = sorted(names - sys.stdlib_module_names - EXTRAS)
    code = "import importlib, sys; print(len([importlib.import_module(name) for name in sys.argv[1:]]))"
    done = alone([str(installed), "-c", code, *asked], tmp_path)
    assert done.stdout == f"{len(asked)}\n", done.stderr
    assert {"jax", "matplotlib", "vijax"} < set(asked)


def test_types_reach_a_user_of_the_wheel(installed, tmp_path):
    (tmp_path / "user.py").write_text(USER)
    (tmp_path / "mistakes.py").write_text(MISTAKES)
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(installed)]
    # A table of pandas, which tells no types.
    asked = [f"reveal_type(vijax.{name})" for name in vijax.__all__ if name != "curve_rows"]
    asked += [f"reveal_type(vijax.plots.{name})" for name in vijax.plots.__all__]
    (tmp_path / "names.py").write_text("\n".join(["import vijax", *asked, ""]))
    files = ["user.py", "mistakes.py", "names.py"]
    done = alone([*command, "--cache-dir", str(tmp_path / "cache"), *files], tmp_path)
    found = re.findall(r"^(\w+)\.py:(\d+): error", done.stdout, re.M)
    lines = [n for n, line in enumerate(MISTAKES.splitlines(), 1) if line.startswith("vijax.")]
    assert found == [("mistakes", str(line)) for line in lines], done.stdout + done.stderr
    revealed = re.findall(r'^names.py:\d+: note: Revealed type is "(.*)"$', done.stdout, re.M)
    assert len(revealed) == len(asked)
    assert not [kind for kind in revealed if re.search(r"^Any$|: Any( =|[,)])|-> Any$", kind)]
