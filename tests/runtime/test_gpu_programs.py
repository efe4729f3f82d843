"""Programs for a GPU, without one: all that public functions compile is lowered for CUDA, as an accelerator has it."""

import jax
import numpy as np
import pytest
from jax import export

import vijax
from tests.helpers import cases, described_gpu
from tests.runtime.test_programs import CALLS, known  # noqa: F401  a fixture
from vijax.batch import lanes, stragglers
from vijax.batch.cell import Plan
from vijax.planes import tile_size
from vijax.runtime import export_cache, xla
from vijax.runtime.export_cache import TracedProgram

# What calls no program that is kept: it is a part of the caller's, or NumPy's.
WITHOUT = (
    "impact_pair",
    "harvested_energy",
    "steady, vmap",
    "trajectory, grad",
    "orbit_properties.labels",
    "orbit_properties.power",
    "curve",
)
PROGRAMS = [name for name in CALLS if name not in WITHOUT]
# What CI lowers, the others taking minutes: a plane and an orbit.
FEW = ("sweep", "steady")
# Of the inclined ones half are those on which gravity holds the ball, which a GPU once never came back from.
PLANES = {
    "rigid": {"wall": "rigid"},
    "level": {"kappa": 40.0},
    "inclined": {"kappa": 40.0, "gamma": np.array([0.3, 1.2])},
}


@pytest.fixture
def called(monkeypatch):
    """The traced programs that are called, with the shapes of their arguments, each once."""
    found = {}
    call = TracedProgram.__call__

    def noted(self, *args, **kwargs):
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), leaf.dtype), args)
        found[self._name, str(shapes)] = self, shapes
        return call(self, *args, **kwargs)

    monkeypatch.setattr(TracedProgram, "__call__", noted)
    return found


@pytest.mark.parametrize("name", cases(PROGRAMS, long=tuple(set(PROGRAMS) - set(FEW))))
def test_every_program_is_lowered_for_a_gpu(name, known, called, on_gpu):  # noqa: F811
    CALLS[name](0, known)
    on_gpu()
    assert called
    for program, shapes in called.values():
        check_lowered(program, shapes)


def check_lowered(program, shapes):
    """Look at what a program becomes for CUDA, and give it."""
    leaves, tree = jax.tree.flatten(shapes)

    def flat(*leaves):
        return jax.tree.leaves(program._work(*jax.tree.unflatten(tree, leaves)))

    with described_gpu():
        made = export.export(jax.jit(flat), platforms=["cuda"], disabled_checks=[export_cache.KERNEL])(*leaves)
    text = made.mlir_module()
    assert "callback" not in text  # the host is never called
    assert "lapack" not in text
    assert "xla_cpu" not in text
    assert any(value.dtype == np.float64 for value in made.out_avals)
    assert not any(value.dtype == np.float32 for value in made.out_avals)
    return text


@pytest.mark.long
def test_the_program_that_leaves_its_last_cells_is_lowered_for_a_gpu(known, called, on_gpu):  # noqa: F811
    """Public functions call it there, and the program of a whole tile here: the same arguments go into both."""
    CALLS["sweep"](0, known)
    on_gpu()
    (shapes,) = (shapes for (name, _), (_, shapes) in called.items() if "tile" in name)
    text = check_lowered(stragglers._compiled_most(Plan(deep=True, work=True, energies=True), 256, 16), shapes)
    assert "__gpu$xla.gpu.triton" in text  # lanes stay in registers


def test_a_gpu_has_larger_tiles_and_more_lanes(monkeypatch):
    monkeypatch.delenv("VIJAX_TILE", raising=False)
    assert tile_size.largest() == lanes.TABLE == 32_768
    assert [lanes.width_of(cells) for cells in (10, 64, 65, 4_096, 10**6)] == [16, 16, 64, 64, 64]
    assert [lanes.table_rows(cells, 1) for cells in (10, 65, 32_768, 10**6)] == [64, 32_768, 32_768, 10**6]
    assert [lanes.table_rows(cells, 64) for cells in (10, 65, 1_024)] == [64, 512, 1_024]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert tile_size.largest() == 4_194_304
    assert lanes.table_rows(10, 1) == 10
    assert [lanes.width_of(cells) for cells in (100, 10**4, 10**5, 10**7)] == [256, 8_192, 12_544, 131_072]


def test_a_gpu_is_given_what_it_is_asked_for_in_xla_flags(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    name = "xla_gpu_enable_command_buffer"
    assert "WHILE" in xla.compiler_options()[name]
    assert xla.compiler_options(brief=True) == xla.compiler_options()
    monkeypatch.setenv("XLA_FLAGS", f"--{name}=")
    assert name not in xla.compiler_options()


@pytest.mark.long
@pytest.mark.parametrize("name", PLANES)
def test_a_plane_as_a_gpu_has_it_comes_out_the_same(name, on_gpu, monkeypatch):
    """Run here: other loops, lookups and services of what the quick step declines; the cores fly the last cells."""
    asked = {"d": np.linspace(0.12, 0.3, 8), "r": np.linspace(0.4, 0.7, 6)} | PLANES[name]
    plain = vijax.sweep(**asked)
    on_gpu()
    monkeypatch.setattr(export_cache.export, "default_export_platform", lambda: "cpu")
    monkeypatch.setattr(stragglers, "_EACH", 4)
    found = vijax.sweep(**asked)
    stragglers._compiled.cache_clear()
    stragglers._compiled_most.cache_clear()
    settled = plain.period.values > 0
    assert settled.mean() > 0.3
    np.testing.assert_array_equal(found.period.values[settled], plain.period.values[settled])
    np.testing.assert_allclose(found.P.values[settled], plain.P.values[settled], rtol=1e-9)
