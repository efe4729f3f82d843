"""Settings of a continuation: each of them is read, none is taken that cannot be."""

import dataclasses
import inspect

import numpy as np
import pytest

import vijax
from vijax.orbits import continuation, orbit_search, switching, symmetry
from vijax.orbits.continuation_settings import ContinuationSettings

SPAN = (0.1, 0.3)
# Of each setting another value, and what else is set so that it matters.
CHANGED: dict[str, tuple[float, dict[str, float]]] = {
    "first_step": (1e-4, {}),
    "max_step": (0.02, {}),
    "min_step": (9e-4, {}),
    "growth": (1.2, {}),
    "easy_corrections": (2, {}),
    "easy_bend": (0.9, {"max_step": 0.1}),
    "min_cosine": (0.9999, {}),
    "crowded_step": (0.01, {}),
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
    """Orbits whose branch folds and grazes, meets its mirror image at a pitchfork, goes through a graze.

    Each with the name of the setting that it is for; the first one is for all others.
    """
    folding = orbit_search.search(vijax.impact_pair(0.19, None, 0.5), "RLL", guesses=32)[:1]
    two = orbit_search.search(vijax.impact_pair(0.19, None, 0.5), "RL", guesses=64)
    soft = orbit_search.search(vijax.impact_pair(0.2, 40.0, 0.5), "RL", guesses=64)
    mirrored, through = (one[np.flatnonzero(~np.asarray(symmetry.symmetric(one)))[:1]] for one in (two, soft))
    return {"": folding, "asymmetry": mirrored, "max_grazings": through}


def told(start, **settings):
    """What a branch says: its values to the last digit, what it met, and how it ends."""
    (one,) = continuation.follow(start, "d", SPAN, direction="up", settings=ContinuationSettings(**settings))
    return one.values.tolist(), [point[:2] for point in one.points], one.ends


def test_every_setting_has_a_sentence_and_is_changed_here():
    fields = [field.name for field in dataclasses.fields(ContinuationSettings)]
    assert fields == list(CHANGED)
    assert [name for name in fields if f"\n    {name}: " not in inspect.getdoc(ContinuationSettings)] == []


@pytest.mark.parametrize("name", CHANGED)
def test_every_setting_is_read(starts, name):
    value, others = CHANGED[name]
    start = starts.get(name, starts[""])
    assert told(start, **others) != told(start, **others, **{name: value})


def test_what_some_settings_change_is_what_they_say(starts):
    folding, mirrored = starts[""], starts["asymmetry"]
    assert told(folding)[1][0][0] == "fold"
    assert told(folding, min_step=9e-4)[2] == ("start", "lost")
    assert told(folding, closing_steps=1)[2] == ("start", "closed")
    kinds, strict = ([kind for kind, _ in told(mirrored, **one)[1]] for one in ({}, {"asymmetry": 1e-13}))
    assert {"pitchfork", "flip"} <= set(kinds)
    assert "flip" not in [kind for kind, _ in told(mirrored, zero_share=1e-30)[1]]
    assert strict == [kind.replace("pitchfork", "fold") for kind in kinds]
    with pytest.raises(dataclasses.FrozenInstanceError):
        ContinuationSettings().max_step = 1.0  # type: ignore[misc]


@pytest.mark.long
def test_those_that_begin_on_a_branch_are_followed_alike(starts):
    plain, longer = (
        switching.family(starts["asymmetry"], "d", SPAN, settings=settings)
        for settings in (ContinuationSettings(), ContinuationSettings(first_step=1e-4, max_step=0.005))
    )
    assert [one.ends for one in plain] == [one.ends for one in longer]
    assert len(plain) > 1
    assert all(len(one.values) < len(finer.values) for one, finer in zip(plain, longer, strict=True))


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
def test_settings_that_cannot_be_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        ContinuationSettings(**change)


def test_every_value_is_checked():
    for field in dataclasses.fields(ContinuationSettings):
        with pytest.raises(ValueError, match=f"{field.name} must "):
            ContinuationSettings(**{field.name: "many"})


@pytest.mark.parametrize("settings", [None, {"max_step": 0.02}])
def test_what_is_no_record_of_settings_is_refused(starts, settings):
    for door in (continuation.follow, switching.family):
        with pytest.raises(ValueError, match="settings must be of the kind ContinuationSettings"):
            door(starts[""], "d", SPAN, settings=settings)
