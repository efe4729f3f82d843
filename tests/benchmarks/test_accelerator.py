"""`benchmarks/accelerator.py` writes a row for every figure and continues after a part that fails."""

from benchmarks import accelerator as tool


def test_failed_part_is_reported_and_the_next_part_runs(monkeypatch, capsys):
    def broken():
        yield "one figure", 1.0, "s"
        raise RuntimeError("no more")

    monkeypatch.setitem(tool.PARTS, "kernels", broken)
    monkeypatch.setitem(tool.PARTS, "orbits", lambda: iter([("starts", 2.0, "s")]))
    rows = list(tool.record_rows(["kernels", "orbits"], 60.0, "here"))
    assert [row[:2] for row in rows[1:]] == [("kernels", "one figure"), ("orbits", "starts")]
    assert "kernels: RuntimeError: no more" in capsys.readouterr().out
