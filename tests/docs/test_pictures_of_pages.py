"""The stored pictures: each is on a page, and has a command that makes it."""

import re
import shlex
from pathlib import Path

import click
import pytest

from scripts import pictures
from vijax.cli.main import vijax as command

PAGES = [
    pictures.ROOT / "README.md",
    *(pictures.ROOT / "docs").glob("*.md"),
    *(pictures.ROOT / "docs/tutorials").glob("*.md"),
]


def test_all_pictures_have_a_command_and_are_on_a_page():
    stored = {path.stem for path in pictures.GALLERY.iterdir()}
    pages = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert stored == set(pictures.PICTURES)
    assert set(re.findall(r"scripts/gallery/(\w+)\.png", pages)) == stored


@pytest.mark.parametrize("name", pictures.PICTURES)
def test_the_commands_of_pictures_are_valid(name):
    program, *arguments = shlex.split(pictures.PICTURES[name].format("picture.png"))
    if program != "-m":
        assert (pictures.ROOT / program).exists()
    elif arguments[0] == "vijax":
        page = command.get_command(click.Context(command), arguments[1])
        page.make_context(arguments[1], arguments[2:])
    else:
        assert (pictures.ROOT / arguments[0].replace(".", "/")).with_suffix(".py").exists()


def test_a_picture_is_made_and_moved_into_the_gallery(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "GALLERY", tmp_path)
    monkeypatch.setitem(
        pictures.PICTURES, "small", f"-c 'import shutil, sys; shutil.copy(*sys.argv[1:])' {__file__} {{}}"
    )
    pictures.make("small")
    assert (tmp_path / "small.png").read_bytes() == Path(__file__).read_bytes()
