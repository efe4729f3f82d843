"""Settings of a design: all of them take effect, and invalid values raise."""

import dataclasses
import inspect
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax.design import optimise, optimum
from vijax.design.ascent import Box, Evaluation, ascend
from vijax.design.design_settings import DesignSettings
from vijax.design.survey import device_survey, orbit_candidates

# The motion is chaotic for kappa from 22 to 23 and periodic at most other values.
UNIT = vijax.Harvester(A=2.460536, omega=9.218106, r=0.854762)
DEVICE = dataclasses.replace(UNIT, s=0.073195 * UNIT.length_unit)
WIDE = dataclasses.replace(UNIT, s=3.0 * UNIT.length_unit)

# Another value of each setting, and the further arguments with which it takes effect.
SURVEY_SETTINGS = {
    "max_period": (2, {}),
    "survey_levels": (2, {}),
    "max_local_maxima": (1, {"tune": ("kappa",), "points": 128}),
    "max_unconditional_impacts": (1, {"min_score_share": 1.0}),
    "min_score_share": (1e-6, {"max_unconditional_impacts": 1}),
    "survey_refinement": (1, {}),
    "max_wide_start_factor": (1, {"device": WIDE}),
}
ASCENT_SETTINGS = {
    "max_step": (0.05, {}),
    "max_approach": (0.5, {}),
    "curvature_pairs": (1, {}),
    "first_barrier": (0.3, {}),
    "last_barrier": (1e-7, {}),
    "barrier_factor": (0.5, {"barrier_power": 1.0}),
    "barrier_power": (1.1, {}),
}
COMPETITION_SETTINGS = {
    "min_competitive_share": (1.0, {}),
    "max_violation": (1e-6, {}),
    "max_violation_steps": (15, {"tune": ("kappa",), "points": 256}),
    "first_periods": (5, {}),
}
CHANGED_SETTINGS = SURVEY_SETTINGS | ASCENT_SETTINGS | COMPETITION_SETTINGS | {"active_margin": (0.9, {})}
# Settings of aperiodic motion; other files test them.
APERIODIC_SETTINGS = (
    "max_rounds",
    "max_ascents",
    "min_aperiodic_share",
    "max_places",
    "place_spacing",
    "violation_exponent",
    "ensemble_samples",
    "ensemble_periods",
    "ensemble_radius",
    "last_radius",
    "max_ensembles",
    "min_gain",
    "confirm_samples",
    "confirm_periods",
    "expected_samples",
    "limit_reserve",
    "max_confirmations",
)


@cache
def survey_starts(tune=("kappa", "r"), points=64, orbits_only=True, device=DEVICE, **settings):
    """Return the start points of ascents, and two counts of the survey."""
    box = optimise.validate_bounds([device], tune, {"kappa": (3.0, 400.0)}, "P", ())
    effort = optimise.make_effort(points, 1, 16)._replace(settings=DesignSettings(**({"survey_levels": 6} | settings)))
    task = device_survey.SurveyTask([device], tune, box, "P", effort)
    survey = device_survey.survey_devices(task, orbits_only=orbits_only)
    candidates = orbit_candidates.OrbitCandidates(survey, orbits_only).take(None)
    return candidates and candidates.z.tolist(), survey.summaries[0].orbits, survey.summaries[0].starts


@cache
def survey_any_motion(**settings):
    """Return the results of `survey_starts` if motions of all kinds compete."""
    return survey_starts(orbits_only=False, **settings)


@cache
def climb_ridge(**settings):
    """Return all points of an ascent along a curved ridge within a disc."""
    chosen = DesignSettings(**settings)

    def height(z):
        return -((z[0] - 1) ** 2) - 10 * (z[1] - z[0] ** 2) ** 2

    def evaluate(z, near, memory):
        value, gradient = jax.vmap(jax.value_and_grad(height))(z)
        margin = 1 - (z**2).sum(axis=1, keepdims=True)
        return Evaluation(value, gradient, margin, -2 * z[:, None], jnp.isfinite(value), memory)

    z = jnp.array([[-0.5, 0.3]])
    box = Box(jnp.full((1, 2), -2.0), jnp.full((1, 2), 2.0), chosen.max_step)
    end = jax.jit(lambda z: ascend(evaluate, z, jnp.zeros(1), box, 60, chosen))(z)
    return np.nan_to_num(np.asarray(end.path)).tolist()


def design_constraints(**settings):
    """Return the active constraints of all optima."""
    # Other tests compile the same ascents.
    design = vijax.optimise(
        vijax.Harvester(s=0.2),
        survey_points=16,
        starts=2,
        max_impacts=2,
        motion="periodic",
        settings=DesignSettings(**settings),
    )
    return [entry.active for entry in design.optima]


def test_all_settings_are_documented_and_tested():
    fields = [field.name for field in dataclasses.fields(DesignSettings)]
    # Other files test the settings of aperiodic motion.
    assert sorted(fields) == sorted([*CHANGED_SETTINGS, "same_optimum", *APERIODIC_SETTINGS])
    assert [name for name in fields if f"\n    {name}: " not in inspect.getdoc(DesignSettings)] == []


@pytest.mark.parametrize("name", CHANGED_SETTINGS)
def test_all_settings_take_effect(name):
    value, others = CHANGED_SETTINGS[name]
    kinds = (
        (SURVEY_SETTINGS, survey_starts),
        (ASCENT_SETTINGS, climb_ridge),
        (COMPETITION_SETTINGS, survey_any_motion),
    )
    evaluate = next((evaluate for kind, evaluate in kinds if name in kind), design_constraints)
    assert evaluate(**others) != evaluate(**others, **{name: value})


@pytest.mark.parametrize(("same", "expected"), [(1e-4, [[1, 0], [3]]), (0.9, [[1], [3]]), (1e-7, [[1, 2, 0], [3]])])
def test_ends_closer_than_same_optimum_are_merged(same, expected):
    blank = optimum.AscentEnd(np.zeros(1), 0.0, *np.zeros((3, 1)), False, True, 1, np.zeros((1, 1)), np.zeros(1))
    places = [(1.0, 2.0), (1.5, 4.0), (1.5 + 1e-5, 3.0), (1.5, 1.0)]
    ends = [blank._replace(z=np.array([z]), objective_value=height) for z, height in places]
    assert list(optimum.distinct_ends(list(range(4)), ends, np.array([0, 0, 0, 1]), same)) == expected


def test_all_values_are_validated():
    for field in dataclasses.fields(DesignSettings):
        with pytest.raises(ValueError, match=f"{field.name} must "):
            DesignSettings(**{field.name: "many"})
    with pytest.raises(ValueError, match="settings must be of the kind DesignSettings"):
        vijax.optimise(vijax.Harvester(), settings={"max_step": 0.1})  # type: ignore[arg-type]
    with pytest.raises(dataclasses.FrozenInstanceError):
        DesignSettings().max_step = 1.0  # type: ignore[misc]
