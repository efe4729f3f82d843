"""What an accelerator is measured by: figures that become rows as they come."""

from benchmarks import accelerator as tool


def test_a_part_that_fails_says_why_and_the_next_one_follows(monkeypatch, capsys):
    def broken():
        yield "one figure", 1.0, "s"
        raise RuntimeError("no more")

    monkeypatch.setitem(tool.PARTS, "kernels", broken)
    monkeypatch.setitem(tool.PARTS, "orbits", lambda: iter([("starts", 2.0, "s")]))
    rows = list(tool.rows(["kernels", "orbits"], 60.0, "here"))
    assert [row[:2] for row in rows[1:]] == [("kernels", "one figure"), ("orbits", "starts")]
    assert "kernels: RuntimeError: no more" in capsys.readouterr().out
