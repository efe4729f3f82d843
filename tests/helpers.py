"""Folder of the scripts, a substitute for the simulation, and lists of test cases with some marked long."""

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

import vijax
from vijax.simulation import simulate

SCRIPTS = Path(__file__).parent.parent / "scripts"


def stand_in(pair, u0, v0, scale, device, *, count, **settings) -> simulate.Summary:
    """Replace `simulate.summarise` without a simulation; each field of the result identifies its cell."""
    kappa = np.ones_like(pair.d) if pair.kappa is None else np.asarray(pair.at(1).kappa)
    mark = np.asarray(pair.d) + 10 * kappa + 1e4 * np.asarray(pair.gamma) + 1e5 * np.asarray(u0) + 0 * np.asarray(v0)
    energy = mark[:, None] * np.asarray(scale.length)[:, None] * np.asarray(scale.length_variant)
    counts = np.arange(mark.size, dtype=np.int32)
    wide, narrow = ("P", "P_stderr", "energy_ratio"), ("period", "impacts_left", "impacts_right", "status")
    fields = {name: mark for name in simulate.Summary.__dataclass_fields__}
    return simulate.Summary(**fields | dict.fromkeys(wide, energy) | dict.fromkeys(narrow, 0 * counts))


@contextmanager
def no_cell_runs() -> Iterator[None]:
    """Replace the simulation of cells by `stand_in`, for tests of maps that do not depend on the motions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "summarise", stand_in)
        yield


def described_gpu() -> AbstractContextManager[Any]:
    """Return a context in which Triton kernels lower without a GPU; JAX 0.12 requires the name of the device."""
    return use_abstract_mesh(AbstractMesh((), (), abstract_device=AbstractDevice("NVIDIA H100", None, "gpu")))


def cases(names: Iterable[str], long: tuple[str, ...]) -> list[Any]:
    """Return the names as cases of a test; the names in `long` are marked long."""
    return [pytest.param(name, marks=pytest.mark.long) if name in long else name for name in names]


def refusals(pair: vijax.ImpactPair) -> list[str]:
    """Return the errors of functions that compute motions, for the pair of an orbit with a membrane or a forcing."""
    errors = []
    for call in (
        lambda: vijax.trajectory(pair, 0.0, 0.1, 2),
        lambda: vijax.find_orbits(pair, "LR"),
        lambda: vijax.orbits_from_states(pair, 0.0, 0.1),
    ):
        with pytest.raises(ValueError) as raised:  # noqa: PT011  the caller compares the text
            call()
        errors.append(str(raised.value))
    return errors


class Plain(vijax.MembraneLaw):
    """The linear membrane, written as a user's law."""

    def acceleration(self, pair, w, z):
        """Return the acceleration by a spring and a damper."""
        return -(pair.kappa**2 * w + pair.mu * z)


class Cubic(vijax.MembraneLaw):
    """A membrane with a cubic spring, which stiffens."""

    beta: float

    def acceleration(self, pair, w, z):
        """Return the acceleration by a cubic spring and a damper."""
        return -(pair.kappa**2 * (w + self.beta * w**3) + pair.mu * z)
