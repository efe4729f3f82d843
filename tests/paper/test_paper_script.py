"""`scripts/paper`: which figures it draws and where, the table of claims, and nothing at all after bad input."""

import pytest

from scripts.paper import __main__ as script
from scripts.paper import claims, figures
from vijax.cli import process


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """Numbers and files instead of pictures."""
    monkeypatch.chdir(tmp_path)
    asked = []
    monkeypatch.setattr(figures, "draw", lambda number, file: asked.append((number, str(file))))
    return asked


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        ([], "figure must be given unless --claims is"),
        (["--figure", "2"], "figure must be all, or among 3, 4, 5"),
        (["--figure", "3;4"], "got '3;4'"),
        (["--figure", "3", "--into", "nowhere"], "folder that exists"),
    ],
)
def test_bad_input_draws_nothing(drawn, capsys, arguments, say):
    assert process.run(script.paper, arguments) == 2
    assert say in capsys.readouterr().err
    assert not drawn


def test_all_figures_and_some(drawn):
    assert process.run(script.paper, ["--figure", "3, 16"]) == 0
    assert drawn == [(3, "figure_3.png"), (16, "figure_16.png")]
    drawn.clear()
    assert process.run(script.paper, ["--figure", "all"]) == 0
    assert [number for number, _ in drawn] == list(range(3, 17))


def test_claims_are_printed_and_written(drawn, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(claims, "CLAIMS", {"T2-mu": claims.CLAIMS["T2-mu"]})
    assert process.run(script.paper, ["--claims"]) == 0
    assert "verdict    reproduced" in capsys.readouterr().out
    assert (tmp_path / "claims.md").read_text().rstrip().endswith("| 172.363 | 172.36301 | 172.36301 | reproduced |")
    assert process.run(script.paper, ["--claims"]) == 2  # it is there
