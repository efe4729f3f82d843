"""Labels of attractors: counts and period in words, motions without a label, mirror images."""

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from vijax.model.label import label, order_counts
from vijax.model.records import Status

OK = Status.OK


@pytest.mark.parametrize(
    ("period", "left", "right", "status", "word"),
    [
        (1, 1, 1, OK, "1:1"),
        (1, 2, 1, OK, "2:1"),
        (2, 1, 2, OK, "1:2/2T"),
        (3, 2, 0, OK, "2:0/3T"),
        (1, 5, 6, Status.STICKING, "5:6"),
        (0, -1, -1, OK, "aperiodic"),
        (-1, -1, -1, Status.SLOW, "undecided"),
        (1, 0, 0, Status.NO_IMPACT, "no impact"),
        (1, 0, 0, Status.PERMANENT_CONTACT, "permanent contact"),
        (-1, -1, -1, Status.EVENT_BUDGET, "failed"),
        (-1, -1, -1, Status.NONFINITE, "failed"),
    ],
)
def test_words(period, left, right, status, word):
    assert label(period, left, right, status) == word


def test_mirror_images_take_the_smaller_count_first_where_they_are_merged():
    left, right = np.array([2, 1, 2, 1]), np.array([1, 2, 1, 1])
    assert label(2, left, right).tolist() == ["2:1/2T", "1:2/2T", "2:1/2T", "1:1/2T"]
    assert label(2, left, right, merge_mirrors=True).tolist() == ["1:2/2T", "1:2/2T", "1:2/2T", "1:1/2T"]
    assert label(2, left, right, merge_mirrors=[True, True, False, False]).tolist()[2] == "2:1/2T"


def test_shapes_broadcast_and_elements_remain_in_place():
    period = np.array([[1], [2], [0]])
    words = label(period, np.where(period > 0, 1, -1), np.where(period > 0, [[3, 4]], -1))
    assert words.tolist() == [["1:3", "1:4"], ["1:3/2T", "1:4/2T"], ["aperiodic", "aperiodic"]]


def test_counts_of_labelled_arrays_are_ordered_along_their_dimensions():
    left, right = xr.DataArray([3, 1], dims="d"), xr.DataArray([2, 2], dims="d")
    few, many = order_counts(left, right, xr.DataArray([True, False], dims="gamma"))
    assert few.transpose("gamma", "d").values.tolist() == [[2, 1], [3, 1]]
    assert many.transpose("gamma", "d").values.tolist() == [[3, 2], [2, 2]]


COUNTS = st.integers(0, 40)
ORBITS = st.tuples(st.integers(1, 32), COUNTS, COUNTS).filter(lambda orbit: orbit[1] + orbit[2] > 0)


@given(orbits=st.lists(ORBITS, min_size=1, max_size=8))
def test_a_label_identifies_its_orbit(orbits):
    period, left, right = np.array(orbits).T
    for name, orbit in zip(label(period, left, right), orbits, strict=True):
        counts, _, turns = name.partition("/")
        assert (int(turns.rstrip("T") or 1), *map(int, counts.split(":"))) == orbit
    merged = label(period, left, right, merge_mirrors=True)
    np.testing.assert_array_equal(merged, label(period, right, left, merge_mirrors=True))
    np.testing.assert_array_equal(merged, label(period, np.minimum(left, right), np.maximum(left, right)))
