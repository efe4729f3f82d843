"""Where the scripts are, a stand-in for the engine, and cases of which some are long."""

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

import vijax
from vijax.batch import simulate

SCRIPTS = Path(__file__).parent.parent / "scripts"


def stand_in(pair, u0, v0, scale, device, *, count, **settings) -> simulate.Summary:
    """In place of `simulate.summarise`: at once, and every field tells which cell it is."""
    kappa = np.ones_like(pair.d) if pair.kappa is None else np.asarray(pair.at(1).kappa)
    mark = np.asarray(pair.d) + 10 * kappa + 1e4 * np.asarray(pair.gamma) + 1e5 * np.asarray(u0) + 0 * np.asarray(v0)
    energy = mark[:, None] * np.asarray(scale.length)[:, None] * np.asarray(scale.length_variant)
    whole = np.arange(mark.size, dtype=np.int32)
    wide, narrow = ("P", "P_stderr", "energy_ratio"), ("period", "impacts_left", "impacts_right", "status")
    fields = {name: mark for name in simulate.Summary.__dataclass_fields__}
    return simulate.Summary(**fields | dict.fromkeys(wide, energy) | dict.fromkeys(narrow, 0 * whole))


@contextmanager
def no_cell_runs() -> Iterator[None]:
    """Make maps whose cells are not run, where what a cell does is not asked."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "summarise", stand_in)
        yield


def described_gpu() -> AbstractContextManager[Any]:
    """Return a context to trace in before a kernel of Triton is lowered where no GPU is; JAX 0.12 asks for which."""
    return use_abstract_mesh(AbstractMesh((), (), abstract_device=AbstractDevice("NVIDIA H100", None, "gpu")))


def cases(every: Iterable[str], long: tuple[str, ...]) -> list[Any]:
    """List the cases of a test by name, some of them marked long."""
    return [pytest.param(one, marks=pytest.mark.long) if one in long else one for one in every]


def refusals(own: vijax.ImpactPair) -> list[str]:
    """Return the errors of functions that compute motions, for the pair of an orbit with a membrane or a forcing."""
    errors = []
    for call in (
        lambda: vijax.trajectory(own, 0.0, 0.1, 2),
        lambda: vijax.find_orbits(own, "LR"),
        lambda: vijax.orbits_from_states(own, 0.0, 0.1),
    ):
        with pytest.raises(ValueError) as raised:  # noqa: PT011  the caller compares the text
            call()
        errors.append(str(raised.value))
    return errors


class Plain(vijax.MembraneLaw):
    """The linear membrane, by hand."""

    def acceleration(self, pair, w, z):
        """Spring and damper."""
        return -(pair.kappa**2 * w + pair.mu * z)


class Cubic(vijax.MembraneLaw):
    """One that stiffens."""

    beta: float

    def acceleration(self, pair, w, z):
        """A cubic spring."""
        return -(pair.kappa**2 * (w + self.beta * w**3) + pair.mu * z)
