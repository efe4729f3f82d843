"""Settings of a continuation: every setting has an effect, and invalid values raise."""

import dataclasses
import inspect

import numpy as np
import pytest

import vijax
from vijax.continuation import branch_continuation, branch_switching
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.orbits import orbit_search, symmetry

SPAN = (0.1, 0.3)
# Another value of every setting, and other settings under which it has an effect.
CHANGED: dict[str, tuple[float, dict[str, float]]] = {
    "first_step": (1e-4, {}),
    "max_step": (0.02, {}),
    "min_step": (9e-4, {}),
    "growth": (1.2, {}),
    "max_corrections_for_growth": (2, {}),
    "max_bend_for_growth": (0.9, {"max_step": 0.1}),
    "min_cosine": (0.9999, {}),
    "event_separation_step": (0.01, {}),
    "newton_tolerance": (1e-4, {}),
    "max_corrections": (2, {}),
    "max_narrowings": (3, {}),
    "zero_share": (1e-30, {}),
    "asymmetry": (1e-13, {}),
    "closing_steps": (1, {}),
    "max_grazings": (0, {}),
}


@pytest.fixture(scope="module")
def starts():
    """Return starts of branches: with a fold and a graze, with a pitchfork, and with a grazing switch.

    The key is the setting that needs the start; the start of the empty key serves all other settings.
    """
    folding = orbit_search.find_orbits(vijax.impact_pair(0.19, None, 0.5), "RLL", guesses=32)[:1]
    rigid = orbit_search.find_orbits(vijax.impact_pair(0.19, None, 0.5), "RL", guesses=64)
    soft = orbit_search.find_orbits(vijax.impact_pair(0.2, 40.0, 0.5), "RL", guesses=64)
    mirrored, grazing = (
        orbits[np.flatnonzero(~np.asarray(symmetry.is_symmetric(orbits)))[:1]] for orbits in (rigid, soft)
    )
    return {"": folding, "asymmetry": mirrored, "max_grazings": grazing}


def branch_summary(start, **settings):
    """Return the values of a branch to the last digit, its events and its ends."""
    (branch,) = branch_continuation.follow_orbits(
        start, "d", SPAN, direction="up", settings=ContinuationSettings(**settings)
    )
    return branch.values.tolist(), [point[:2] for point in branch.points], branch.ends


def test_all_settings_are_documented_and_tested():
    fields = [field.name for field in dataclasses.fields(ContinuationSettings)]
    assert fields == list(CHANGED)
    assert [name for name in fields if f"\n    {name}: " not in inspect.getdoc(ContinuationSettings)] == []


@pytest.mark.parametrize("name", CHANGED)
def test_all_settings_have_an_effect(starts, name):
    value, others = CHANGED[name]
    start = starts.get(name, starts[""])
    assert branch_summary(start, **others) != branch_summary(start, **others, **{name: value})


def test_effects_of_selected_settings(starts):
    folding, mirrored = starts[""], starts["asymmetry"]
    assert branch_summary(folding)[1][0][0] == "fold"
    assert branch_summary(folding, min_step=9e-4)[2] == ("start", "lost")
    assert branch_summary(folding, closing_steps=1)[2] == ("start", "closed")
    kinds, strict = (
        [kind for kind, _ in branch_summary(mirrored, **settings)[1]] for settings in ({}, {"asymmetry": 1e-13})
    )
    assert {"pitchfork", "flip"} <= set(kinds)
    assert "flip" not in [kind for kind, _ in branch_summary(mirrored, zero_share=1e-30)[1]]
    assert strict == [kind.replace("pitchfork", "fold") for kind in kinds]
    with pytest.raises(dataclasses.FrozenInstanceError):
        ContinuationSettings().max_step = 1.0  # type: ignore[misc]


@pytest.mark.long
def test_settings_apply_to_bifurcating_branches(starts):
    plain, longer = (
        branch_switching.follow_families(starts["asymmetry"], "d", SPAN, settings=settings)
        for settings in (ContinuationSettings(), ContinuationSettings(first_step=1e-4, max_step=0.005))
    )
    assert [coarser.ends for coarser in plain] == [coarser.ends for coarser in longer]
    assert len(plain) > 1
    assert all(len(coarser.values) < len(finer.values) for coarser, finer in zip(plain, longer, strict=True))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_step": 0.0}, "max_step must be an arclength between 0 and 1; got 0.0"),
        ({"growth": 1.0}, "growth must be a finite number above 1; got 1.0"),
        ({"min_cosine": 1.5}, "min_cosine must be a number between 0 and 1; got 1.5"),
        ({"max_corrections": 2.5}, "max_corrections must be a whole number of at least 1; got 2.5"),
        ({"max_grazings": -1}, "max_grazings must be a whole number of at least 0; got -1"),
        ({"closing_steps": 0}, "closing_steps must be a whole number of at least 1; got 0"),
        ({"asymmetry": float("nan")}, "asymmetry must be a positive finite number; got nan"),
        ({"first_step": 0.1}, "first_step must lie between min_step and max_step; got 0.1 with 1e-09 and 0.01"),
    ],
)
def test_invalid_settings_raise(change, message):
    with pytest.raises(ValueError, match=message):
        ContinuationSettings(**change)


def test_all_settings_are_validated():
    for field in dataclasses.fields(ContinuationSettings):
        with pytest.raises(ValueError, match=f"{field.name} must "):
            ContinuationSettings(**{field.name: "many"})


@pytest.mark.parametrize("settings", [None, {"max_step": 0.02}])
def test_settings_of_another_type_raise(starts, settings):
    for function in (branch_continuation.follow_orbits, branch_switching.follow_families):
        with pytest.raises(ValueError, match="settings must be of the kind ContinuationSettings"):
            function(starts[""], "d", SPAN, settings=settings)
