"""Recomputed claims: fast checks against reference values, the table, mirror images of a diagram."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from scripts.paper import claims, evidence, figures
from scripts.paper.cached import diagram
from scripts.paper.captions import RIGID, Source

REFERENCE = {c["id"]: c for c in json.loads((Path(__file__).parents[1] / "data" / "claims.json").read_text())}


def test_all_claims_of_the_reference_are_checked():
    renamed = {"F11a": "F8b"}  # one check covers both
    assert {renamed.get(name, name) for name in REFERENCE} <= set(claims.CLAIMS)
    assert {"F13a", "F13b", "F13c", "F14", "F16", "S2"} <= set(claims.CLAIMS)


@pytest.mark.parametrize("name", ["T2-mu", "E1", "E2", "P1"])
def test_fast_checks_match_the_reference(name):
    finding = claims.CLAIMS[name].check()
    expected = "cannot be meant" if name == "E1" else "reproduced"
    assert finding.verdict.startswith(expected)
    if name == "T2-mu":
        assert float(finding.converged) == pytest.approx(REFERENCE[name]["oracle_accurate"], rel=1e-7)
    if name == "E1":
        assert finding.swept.startswith("1:1 1.13 to 1.68 microjoules")  # 1.12 at the flip itself


@pytest.mark.parametrize(
    ("name", "at", "stretch"),
    [("1:1", 0.25, (0.3, 0.188)), ("2:4/2T", 0.182, (0.186, 0.178)), ("2:2", 0.08, (0.09, 0.068))],
)
def test_stretches_of_the_rigid_sweep_match_the_reference(name, at, stretch):
    assert evidence.stretch(evidence.labels(RIGID), name, at) == pytest.approx(stretch)


def test_bands_cover_all_points_in_order():
    bands = list(evidence.bands(evidence.labels(RIGID)))
    assert (bands[0][1], bands[-1][2]) == (0.3, 0.05)
    assert all(before[0] != after[0] for before, after in itertools.pairwise(bands))


def test_table_escapes_separators_of_cells():
    claim = claims.Claim("X", "Fig. 0", "|u'| grows", "1", lambda: claims.Finding("", "", ""))
    row = claims.markdown([(claim, claims.Finding("a|b", "c", "d"))]).splitlines()[-1]
    assert row == r"| Fig. 0: \|u'\| grows | 1 | a\|b | c | d |"


def test_mirror_image_equals_the_orbit_only_if_it_is_symmetric():
    dataset, image = diagram(RIGID), figures.selected(Source(RIGID, {}, "purple", mirror=True))
    symmetric = {"d": 0}  # at d = 0.3
    for name in ("u_strobe", "v_strobe"):
        actual, mirrored = (source[name].isel(symmetric).values[1:] for source in (dataset, image))
        np.testing.assert_allclose(actual, mirrored, atol=1e-9)
    asymmetric = {"d": 60}  # at d = 0.18
    assert float(np.abs(dataset["v_strobe"] - image["v_strobe"]).isel(asymmetric).min()) > 1e-3
    np.testing.assert_array_equal(image["v_in"], -dataset["v_in"])
    phase = image["phase"].values[image["phase"].notnull().values]
    assert 0 <= phase.min() <= phase.max() < 2


def test_time_series_mark_only_repeated_impacts():
    assert [panel.layers[-1].x.size > 0 for panel in figures.panels(4).values()] == [False, True]
