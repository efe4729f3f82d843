"""Programs for a GPU, tested without a GPU: all programs that public functions compile are lowered for CUDA."""

import jax
import numpy as np
import pytest
from jax import export

import vijax
from tests.helpers import cases, described_gpu
from tests.runtime.test_programs import CALLS, attracting_orbit  # noqa: F401  a fixture
from vijax.maps.execution import tile_size
from vijax.runtime.compilation import export_cache, xla
from vijax.runtime.compilation.export_cache import TracedProgram
from vijax.simulation.cell.cell import Plan
from vijax.simulation.scheduler import lane_scheduler, remaining_cells

# Functions without a stored program: they are a part of the caller's program, or use NumPy.
WITHOUT = (
    "impact_pair",
    "harvested_energy",
    "steady, vmap",
    "trajectory, grad",
    "orbit_properties.orbit_labels",
    "orbit_properties.orbit_power",
    "curve",
)
PROGRAMS = [name for name in CALLS if name not in WITHOUT]
# Programs that CI lowers, of a map and of an orbit; the others take minutes.
FEW = ("sweep", "steady")
# In half of the inclined cells gravity prolongs the contacts; on a GPU, a program for them once did not end.
PLANES = {
    "rigid": {"wall": "rigid"},
    "level": {"kappa": 40.0},
    "inclined": {"kappa": 40.0, "gamma": np.array([0.3, 1.2])},
}


@pytest.fixture
def called(monkeypatch):
    """The distinct traced programs that are called, with the shapes of their arguments."""
    programs = {}
    call = TracedProgram.__call__

    def noted(self, *args, **kwargs):
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), leaf.dtype), args)
        programs[self._name, str(shapes)] = self, shapes
        return call(self, *args, **kwargs)

    monkeypatch.setattr(TracedProgram, "__call__", noted)
    return programs


@pytest.mark.parametrize("name", cases(PROGRAMS, long=tuple(set(PROGRAMS) - set(FEW))))
def test_programs_are_lowered_for_a_gpu(name, attracting_orbit, called, on_gpu):  # noqa: F811
    CALLS[name](0, attracting_orbit)
    on_gpu()
    assert called
    for program, shapes in called.values():
        check_lowered(program, shapes)


def check_lowered(program, shapes):
    """Lower a program for CUDA, check its text, and return the text."""
    leaves, tree = jax.tree.flatten(shapes)

    def flat(*leaves):
        return jax.tree.leaves(program._work(*jax.tree.unflatten(tree, leaves)))

    with described_gpu():
        exported = export.export(jax.jit(flat), platforms=["cuda"], disabled_checks=[export_cache.KERNEL])(*leaves)
    text = exported.mlir_module()
    assert "callback" not in text  # the host is never called
    assert "lapack" not in text
    assert "xla_cpu" not in text
    assert any(value.dtype == np.float64 for value in exported.out_avals)
    assert not any(value.dtype == np.float32 for value in exported.out_avals)
    return text


@pytest.mark.long
def test_the_program_that_stops_at_few_remaining_cells_is_lowered_for_a_gpu(attracting_orbit, called, on_gpu):  # noqa: F811
    """Public functions call it on a GPU, and the program of a whole tile on a CPU; both take the same arguments."""
    CALLS["sweep"](0, attracting_orbit)
    on_gpu()
    (shapes,) = (shapes for (name, _), (_, shapes) in called.items() if "tile" in name)
    text = check_lowered(
        remaining_cells._compiled_until_few(Plan(deep=True, work=True, energies=True), 256, 16), shapes
    )
    assert "__gpu$xla.gpu.triton" in text  # lanes stay in registers


def test_a_gpu_has_larger_tiles_and_more_lanes(monkeypatch):
    monkeypatch.delenv("VIJAX_TILE", raising=False)
    assert tile_size.max_cells() == lane_scheduler.TABLE_ROWS == 32_768
    assert [lane_scheduler.width_of(cells) for cells in (10, 64, 65, 4_096, 10**6)] == [16, 16, 64, 64, 64]
    assert [lane_scheduler.table_rows(cells, 1) for cells in (10, 65, 32_768, 10**6)] == [64, 32_768, 32_768, 10**6]
    assert [lane_scheduler.table_rows(cells, 64) for cells in (10, 65, 1_024)] == [64, 512, 1_024]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert tile_size.max_cells() == 4_194_304
    assert lane_scheduler.table_rows(10, 1) == 10
    assert [lane_scheduler.width_of(cells) for cells in (100, 10**4, 10**5, 10**7)] == [256, 8_192, 12_544, 131_072]


def test_gpu_options_in_xla_flags_take_precedence(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    name = "xla_gpu_enable_command_buffer"
    assert "WHILE" in xla.compiler_options()[name]
    assert xla.compiler_options(brief=True) == xla.compiler_options()
    monkeypatch.setenv("XLA_FLAGS", f"--{name}=")
    assert name not in xla.compiler_options()


@pytest.mark.long
@pytest.mark.parametrize("name", PLANES)
def test_a_map_by_the_programs_of_a_gpu_is_the_same(name, on_gpu, monkeypatch):
    """Run on a CPU: the loops, lookups and fallbacks of a GPU; the cores of the CPU simulate the last cells."""
    arguments = {"d": np.linspace(0.12, 0.3, 8), "r": np.linspace(0.4, 0.7, 6)} | PLANES[name]
    plain = vijax.sweep(**arguments)
    on_gpu()
    monkeypatch.setattr(export_cache.export, "default_export_platform", lambda: "cpu")
    monkeypatch.setattr(remaining_cells, "_CELLS_PER_CORE", 4)
    lowered = vijax.sweep(**arguments)
    remaining_cells._compiled.cache_clear()
    remaining_cells._compiled_until_few.cache_clear()
    settled = plain.period.values > 0
    assert settled.mean() > 0.3
    np.testing.assert_array_equal(lowered.period.values[settled], plain.period.values[settled])
    np.testing.assert_allclose(lowered.P.values[settled], plain.P.values[settled], rtol=1e-9)
