"""Units at all public parameters: each function, record and method rejects quantities of a wrong dimension."""

import re

import numpy as np
import pint
import pytest

from benchmarks import public_calls
from vijax.model.quantities import QUANTITIES

U = pint.UnitRegistry()
CALLS = public_calls.calls()
# One unit of each dimension that a quantity of this package has, and of some unused dimensions.
UNITS = ("kg", "m", "s", "m/s", "m/s^2", "rad", "rad/s", "N/m", "V", "F", "F/m", "s/m", "K")

# Units of parameters that differ from the unit of a quantity of the same name in the table.
UNITS_OF_PARAMETERS = {
    ("Harmonics", "phases"): "rad",
    ("HuntCrossley", "chi"): "s/m",
    ("HuntCrossley", "depth"): "m",
    ("Hyperelastic", "radius"): "m",
    ("Record", "acceleration"): "m/s^2",
    ("Record", "time"): "s",
    ("Sides", "left"): "rad/s",
    ("Sides", "right"): "rad/s",
    ("fit", "speed_error"): "m/s",
    ("fit", "speeds"): "m/s",
    ("fit", "times"): "s",
    ("fit", "timing_error"): "s",
    ("harvested_energy", "depth"): "m",
}


def expected_unit(name: str, parameter: str) -> str:
    """Return the unit that a parameter accepts; "" if it accepts none."""
    table_unit = QUANTITIES[parameter].unit if parameter in QUANTITIES else ""
    return UNITS_OF_PARAMETERS.get((name, parameter), table_unit)


def test_all_public_functions_have_a_valid_call():
    assert set(public_calls.names()) == set(CALLS)
    for name, call in CALLS.items():
        assert set(call.right) <= set(call.parameters), name
    assert {name for name, _ in UNITS_OF_PARAMETERS} <= set(CALLS)


@pytest.mark.filterwarnings("ignore:.* is up to .* rad, which is beyond pi/2")
@pytest.mark.parametrize("name", CALLS)
def test_a_quantity_of_a_wrong_dimension_is_rejected(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call = CALLS[name]
    for parameter in call.parameters:
        right = expected_unit(name, parameter)
        for unit in UNITS:
            if unit == right:
                continue
            for value in (U.Quantity(0.3, unit), U.Quantity(np.array([0.2, 0.3]), unit)):
                with pytest.raises(ValueError) as error:  # noqa: PT011  any message with the name of the parameter
                    call.function(**{**call.right, parameter: value})
                assert re.search(rf"(?<![^\W_]){parameter}(?!\w)", str(error.value)), (
                    parameter,
                    unit,
                    str(error.value),
                )


RECORDS = [name for name in CALLS if name[0].isupper() and "." not in name and name not in ("Sides", "ImpactPair")]


@pytest.mark.parametrize("name", RECORDS)
def test_a_quantity_of_the_right_dimension_is_converted(name):
    call = CALLS[name]
    for parameter in call.parameters:
        right, value = expected_unit(name, parameter), call.right.get(parameter, 0.004)
        if not right or parameter in ("r_b", "R0"):
            continue
        plain = getattr(call.function(**{**call.right, parameter: value}), parameter)
        scaled = getattr(
            call.function(**{**call.right, parameter: np.multiply(1e-3, value) * U(f"1000 {right}")}), parameter
        )
        np.testing.assert_allclose(np.asarray(scaled, float), np.asarray(plain, float), rtol=1e-12, err_msg=parameter)


def test_ratios_of_units_are_numbers():
    import vijax

    assert float(vijax.impact_pair(U.Quantity(200, "mm/m"), 40.0, 0.5).d) == pytest.approx(0.2, rel=1e-15)
    with pytest.raises(
        ValueError, match="d must be a number without a unit; got one in degree; with a unit there is s"
    ):
        vijax.impact_pair(U.Quantity(0.2, "degree"), 40.0, 0.5)
