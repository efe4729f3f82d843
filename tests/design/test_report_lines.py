"""Amounts of a report have the prefix of their unit that fits their size."""

import math

import pytest

from vijax.design.report_lines import amount


@pytest.mark.parametrize(
    ("power", "prefix"),
    [(9, "G"), (6, "M"), (3, "k"), (0, ""), (-3, "m"), (-6, "u"), (-9, "n"), (-12, "p"), (-15, "f")],
)
def test_every_prefix_begins_at_its_factor(power, prefix):
    assert amount(float(f"1e{power}"), "J") == f"1 {prefix}J"
    assert amount(float(f"-2.5e{power}"), "J") == f"-2.5 {prefix}J"


def test_a_value_that_rounds_up_to_a_factor_has_its_prefix():
    assert amount(9.9996e-4, "J", 4) == "1 mJ"
    assert amount(9.994e-4, "J", 4) == "999.4 uJ"


def test_what_is_smaller_than_all_prefixes_has_the_smallest():
    assert amount(2e-17, "J") == "0.02 fJ"


@pytest.mark.parametrize(("value", "text"), [(0.0, "0 W"), (math.nan, "nan W"), (math.inf, "inf W")])
def test_what_has_no_size_has_no_prefix(value, text):
    assert amount(value, "W") == text
