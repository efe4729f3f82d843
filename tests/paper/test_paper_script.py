"""`scripts/paper`: the drawn figures and their files, the table of claims, and no output after bad input."""

import pytest

from scripts.paper import __main__ as script
from scripts.paper import claims, figures
from vijax.cli import process


@pytest.fixture
def draw_calls(tmp_path, monkeypatch):
    """Record the numbers and files of figures instead of drawing them."""
    monkeypatch.chdir(tmp_path)
    calls = []
    monkeypatch.setattr(figures, "draw", lambda number, file: calls.append((number, str(file))))
    return calls


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "figure must be given unless --claims is"),
        (["--figure", "2"], "figure must be all, or among 3, 4, 5"),
        (["--figure", "3;4"], "got '3;4'"),
        (["--figure", "3", "--into", "nowhere"], "folder that exists"),
    ],
)
def test_bad_input_draws_nothing(draw_calls, capsys, arguments, message):
    assert process.run(script.paper, arguments) == 2
    assert message in capsys.readouterr().err
    assert not draw_calls


def test_all_or_selected_figures_are_drawn(draw_calls):
    assert process.run(script.paper, ["--figure", "3, 16"]) == 0
    assert draw_calls == [(3, "figure_3.png"), (16, "figure_16.png")]
    draw_calls.clear()
    assert process.run(script.paper, ["--figure", "all"]) == 0
    assert [number for number, _ in draw_calls] == list(range(3, 17))


def test_claims_are_printed_and_written(draw_calls, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(claims, "CLAIMS", {"T2-mu": claims.CLAIMS["T2-mu"]})
    assert process.run(script.paper, ["--claims"]) == 0
    assert "verdict    reproduced" in capsys.readouterr().out
    assert (tmp_path / "claims.md").read_text().rstrip().endswith("| 172.363 | 172.36301 | 172.36301 | reproduced |")
    assert process.run(script.paper, ["--claims"]) == 2  # claims.md exists
