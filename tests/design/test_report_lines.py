"""Values in a report have the unit prefix that fits their size."""

import math

import numpy as np
import pytest
import xarray as xr

from vijax import Harvester, Sides
from vijax.design.optimise import Design
from vijax.design.optimum import AperiodicOptimum
from vijax.design.report import describe
from vijax.design.report_lines import format_amount, format_report
from vijax.design.survey.device_survey import SurveySummary
from vijax.simulation.simulate import Starts


@pytest.mark.parametrize(
    ("power", "prefix"),
    [(9, "G"), (6, "M"), (3, "k"), (0, ""), (-3, "m"), (-6, "u"), (-9, "n"), (-12, "p"), (-15, "f")],
)
def test_prefixes_begin_at_their_factors(power, prefix):
    assert format_amount(float(f"1e{power}"), "J") == f"1 {prefix}J"
    assert format_amount(float(f"-2.5e{power}"), "J") == f"-2.5 {prefix}J"


def test_a_value_that_rounds_up_to_a_factor_has_its_prefix():
    assert format_amount(9.9996e-4, "J", 4) == "1 mJ"
    assert format_amount(9.994e-4, "J", 4) == "999.4 uJ"


def test_values_below_all_factors_have_the_smallest_prefix():
    assert format_amount(2e-17, "J") == "0.02 fJ"


@pytest.mark.parametrize(("value", "text"), [(0.0, "0 W"), (math.nan, "nan W"), (math.inf, "inf W")])
def test_zero_and_non_finite_values_have_no_prefix(value, text):
    assert format_amount(value, "W") == text


def design_with_unequal_radii():
    """Return a design of a device with different R0 at its walls."""
    nothing = np.zeros(1)
    best = AperiodicOptimum(
        values={"d": 0.2},
        device=Harvester(s=0.02, R0=Sides(0.006, 0.007)),
        label="aperiodic",
        objective_value=1e-5,
        P=1e-5,
        P_stderr=1e-8,
        gradient={"d": 0.1},
        active=(),
        stopped="maximum",
        path=np.array([[0.2]]),
        path_objective=np.array([1e-5]),
        power=1e-4,
        speed=0.5,
        max_penetration=0.005,
        energy_ratio=0.3,
        lyapunov=0.4,
        admissible=1.0,
        shares={"aperiodic": 1.0},
        gradient_stderr={"d": 0.01},
        predicted=1e-5,
        ensembles=3,
        confirmation_size=(64, 5000),
        starts=Starts(nothing, nothing, nothing),
    )
    summary = SurveySummary(8, 0, 0, 1, 1e-5, {"d": 0.2}, "", 0.0, 0.0, 0.0, 0.0)
    return Design((best,), ("d",), {"d": (0.1, 0.3)}, "P", (), summary, 0, 1)


def test_report_states_the_penetration_limits_of_both_walls():
    text = "\n".join(format_report(describe(design_with_unequal_radii())))
    assert "penetration 5 mm of 6 (left wall) and 7 (right wall) allowed" in text


@pytest.mark.parametrize(("depth", "unphysical"), [(0.0065, False), (0.0075, True)])
def test_penetration_above_the_larger_radius_is_unphysical(depth, unphysical):
    peak = {"P": 2e-5, "max_penetration": depth, "energy_ratio": 0.5, "admissible": False}
    values = {name: (("direction", "d"), [[value]]) for name, value in peak.items()}
    attributes = {"along": "d", "harvester_R0_left": 0.006, "harvester_R0_right": 0.007}
    report = describe(design_with_unequal_radii(), diagram=xr.Dataset(values, {"d": [0.25]}, attributes))
    assert report["highest"]["unphysical"] is unphysical
