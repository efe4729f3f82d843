"""What an accelerator is measured by: kernels of a trip, and figures that become rows as they come."""

from benchmarks import accelerator as tool

PROGRAM = """HloModule jit_tile

%step (p: (s64[], f64[8])) -> (s64[], f64[8]) {
  %first = f64[8]{0} fusion(%a, %b), kind=kLoop, calls=%fused_one
  %copy.1 = f64[8]{0} copy(%a)
  %second = (f64[8]{0}, f64[8]{0}) fusion(%first), kind=kLoop, calls=%fused_two
}

%short (p: (s64[], f64[8])) -> (s64[], f64[8]) {
  %only = f64[8]{0} fusion(%a), kind=kLoop, calls=%fused_three
}

ENTRY %main {
  %while.1 = (s64[], f64[8]{0}) while(%t), condition=%c, body=%step, backend_config={"known_trip_count":{"n":"8"}}
  %while.2 = (s64[], f64[8]{0}) while(%t), condition=%c, body=%short, backend_config={"known_trip_count":{"n":"2"}}
  %while.3 = (s64[], f64[8]{0}) while(%t), condition=%c, body=%other
}
"""


def test_kernels_of_a_trip_are_those_of_the_longest_loop_of_known_length():
    assert tool.kernels_of_a_trip(PROGRAM) == (2, 1)
    assert tool.kernels_of_a_trip("HloModule empty\n") is None


def test_a_part_that_fails_says_why_and_the_next_one_follows(monkeypatch, capsys):
    def broken():
        yield "one figure", 1.0, "s"
        raise RuntimeError("no more")

    monkeypatch.setitem(tool.PARTS, "kernels", broken)
    monkeypatch.setitem(tool.PARTS, "orbits", lambda: iter([("starts", 2.0, "s")]))
    rows = list(tool.rows(["kernels", "orbits"], 60.0, "here"))
    assert [row[:2] for row in rows[1:]] == [("kernels", "one figure"), ("orbits", "starts")]
    assert "kernels: RuntimeError: no more" in capsys.readouterr().out
