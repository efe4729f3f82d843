"""Settings of a design: each of them is read, none is taken that cannot be."""

import dataclasses
import inspect
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vijax
from vijax.design import candidates, multistart, optimise, optimum
from vijax.design.ascent import Box, Look, ascend
from vijax.design.design_settings import DesignSettings

# Its motion is chaotic from kappa 22 to 23, periodic at most others.
UNIT = vijax.Harvester(A=2.460536, omega=9.218106, r=0.854762)
DEVICE = dataclasses.replace(UNIT, s=0.073195 * UNIT.length_unit)
WIDE = dataclasses.replace(UNIT, s=3.0 * UNIT.length_unit)

# Of each setting another value, and what else is set so that it matters.
SURVEYED = {
    "max_period": (2, {}),
    "survey_levels": (2, {}),
    "max_hills": (1, {"tune": ("kappa",), "points": 128}),
    "max_sure_impacts": (1, {"min_promise": 1.0}),
    "min_promise": (1e-6, {"max_sure_impacts": 1}),
    "survey_refinement": (1, {}),
    "max_wide_starts": (1, {"device": WIDE}),
}
CLIMBED = {
    "max_step": (0.05, {}),
    "max_approach": (0.5, {}),
    "curvature_pairs": (1, {}),
    "first_barrier": (0.3, {}),
    "last_barrier": (1e-7, {}),
    "barrier_factor": (0.5, {"barrier_power": 1.0}),
    "barrier_power": (1.1, {}),
}
RIVALS = {
    "min_rival": (1.0, {}),
    "max_excess": (1e-6, {}),
    "max_excess_steps": (15, {"tune": ("kappa",), "points": 256}),
    "first_periods": (5, {}),
}
CHANGED = SURVEYED | CLIMBED | RIVALS | {"active_margin": (0.9, {})}
# Changed where designs of aperiodic motion are tested.
ELSEWHERE = (
    "max_turns",
    "max_ascents",
    "min_chaos",
    "max_places",
    "places_apart",
    "limit_price",
    "ensemble_balls",
    "ensemble_periods",
    "ensemble_radius",
    "last_radius",
    "max_ensembles",
    "min_gain",
    "confirm_balls",
    "confirm_periods",
    "expected_balls",
    "limit_room",
    "max_confirmations",
)


@cache
def surveyed(tune=("kappa", "r"), points=64, orbits_alone=True, device=DEVICE, **settings):
    """Where ascents begin."""
    box = optimise.check([device], tune, {"kappa": (3.0, 400.0)}, "P", ())
    far = optimise.effort(points, 1, 16)._replace(settings=DesignSettings(**({"survey_levels": 6} | settings)))
    task = multistart.SurveyTask([device], tune, box, "P", far)
    found = multistart.find(task, orbits_alone=orbits_alone)
    begun = candidates.OrbitCandidates(found, orbits_alone).take(None)
    return begun and begun.z.tolist(), found.looked[0].orbits, found.looked[0].starts


@cache
def rivalled(**settings):
    """Where ascents begin, where any motion may win."""
    return surveyed(orbits_alone=False, **settings)


@cache
def climbed(**settings):
    """Every point of an ascent along a curved ridge, up to a disc."""
    chosen = DesignSettings(**settings)

    def height(z):
        return -((z[0] - 1) ** 2) - 10 * (z[1] - z[0] ** 2) ** 2

    def look(z, near, memory):
        value, gradient = jax.vmap(jax.value_and_grad(height))(z)
        room = 1 - (z**2).sum(axis=1, keepdims=True)
        return Look(value, gradient, room, -2 * z[:, None], jnp.isfinite(value), memory)

    z = jnp.array([[-0.5, 0.3]])
    box = Box(jnp.full((1, 2), -2.0), jnp.full((1, 2), 2.0), chosen.max_step)
    end = jax.jit(lambda z: ascend(look, z, jnp.zeros(1), box, 60, chosen))(z)
    return np.nan_to_num(np.asarray(end.path)).tolist()


def designed(**settings):
    """How many optima there are, and what is said to hold them."""
    # Such ascents other tests compile as well.
    found = vijax.optimise(
        vijax.Harvester(s=0.2),
        survey_points=16,
        starts=2,
        max_impacts=2,
        motion="periodic",
        settings=DesignSettings(**settings),
    )
    return [one.active for one in found.optima]


def test_every_setting_has_a_sentence_and_is_changed_here():
    fields = [field.name for field in dataclasses.fields(DesignSettings)]
    # Those of aperiodic motion are changed where such designs are tested.
    assert sorted(fields) == sorted([*CHANGED, "same_optimum", *ELSEWHERE])
    assert [name for name in fields if f"\n    {name}: " not in inspect.getdoc(DesignSettings)] == []


@pytest.mark.parametrize("name", CHANGED)
def test_every_setting_is_read(name):
    value, others = CHANGED[name]
    kinds = ((SURVEYED, surveyed), (CLIMBED, climbed), (RIVALS, rivalled))
    told = next((told for kind, told in kinds if name in kind), designed)
    assert told(**others) != told(**others, **{name: value})


@pytest.mark.parametrize(("same", "kept"), [(1e-4, [[1, 0], [3]]), (0.9, [[1], [3]]), (1e-7, [[1, 2, 0], [3]])])
def test_ends_of_one_device_nearer_than_same_optimum_are_one(same, kept):
    blank = optimum.End(np.zeros(1), 0.0, *np.zeros((3, 1)), False, True, 1, np.zeros((1, 1)), np.zeros(1))
    places = [(1.0, 2.0), (1.5, 4.0), (1.5 + 1e-5, 3.0), (1.5, 1.0)]
    ends = [blank._replace(z=np.array([z]), height=height) for z, height in places]
    assert list(optimum.apart(list(range(4)), ends, np.array([0, 0, 0, 1]), same)) == kept


def test_every_value_is_checked():
    for field in dataclasses.fields(DesignSettings):
        with pytest.raises(ValueError, match=f"{field.name} must "):
            DesignSettings(**{field.name: "many"})
    with pytest.raises(ValueError, match="settings must be of the kind DesignSettings"):
        vijax.optimise(vijax.Harvester(), settings={"max_step": 0.1})  # type: ignore[arg-type]
    with pytest.raises(dataclasses.FrozenInstanceError):
        DesignSettings().max_step = 1.0  # type: ignore[misc]
