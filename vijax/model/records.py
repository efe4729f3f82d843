"""Records of one ball: state, impact, and the status that classifies the end of a simulation."""

import enum
from collections import Counter

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from vijax.runtime.arrays import AnyArray
from vijax.runtime.record_text import PrintedRecord, printed
from vijax.runtime.validation import is_concrete


class Status(enum.IntEnum):
    """Status of a cell at the end of its simulation, with advice; the variable `status` of a map stores the values."""

    # The values are stored in datasets and must not change.
    OK = 0  # a periodic attractor, or averages with a standard error over an aperiodic attractor
    NO_IMPACT = 1  # the motion has no impact any more: neutral or free flight
    PERMANENT_CONTACT = 2  # the ball stays in or on one wall forever
    STICKING = 3  # as OK, but the attractor chatters into sticking on a rigid wall
    SLOW = 4  # neither periodic nor confirmed aperiodic after all simulated periods
    EVENT_BUDGET = 5  # more impacts than the budget allows
    NONFINITE = 6  # the state became infinite or NaN
    NO_ORBIT = 7  # Newton's method did not converge to a periodic orbit from the guess
    VIRTUAL = 8  # solves the equations of an orbit, but the ball would hit a wall between its impacts
    UNSTABLE = 9  # the orbit is unstable, or at a bifurcation
    NOT_RUN = 10  # the cell of an unfinished store has not been simulated
    CONVERGING = 11  # as OK: the motion still approaches its orbit, which Newton's method computed
    FEW_IMPACTS = 12  # aperiodic, with averages over too few impacts for a valid standard error

    @property
    def advice(self) -> str:
        """Return the advice for the status, in one sentence."""
        return _ADVICE[self]

    def __repr__(self) -> str:
        return f"<Status.{self.name}: {self.value}, {self.advice}>"


_ADVICE = {
    Status.OK: "use it: the motion is periodic, or its averages have a standard error",
    Status.NO_IMPACT: "narrow the gap, force more strongly, or start elsewhere: the motion has no impact any more",
    Status.PERMANENT_CONTACT: "force more strongly, or incline less: the ball never leaves a wall again",
    Status.STICKING: "use it as an attractor: the ball rests on a rigid wall for a while, and no orbit can be followed",
    Status.SLOW: "run more periods: the motion is neither periodic yet nor confirmed aperiodic",
    Status.EVENT_BUDGET: "allow more impacts, or look at fewer periods: the ball chatters",
    Status.NONFINITE: "take shorter steps or tighter tolerances, or the exact method: the numbers overflowed",
    Status.NO_ORBIT: "begin nearer to an orbit, by a search or in smaller steps: the equations have no solution there",
    Status.VIRTUAL: "search for orbits with other impacts: the ball would hit a wall in between",
    Status.UNSTABLE: "follow it as a branch, or find an attractor by a sweep: no motion stays on this orbit",
    Status.CONVERGING: "use it: the motion is slow to arrive, and Newton's method found the orbit that it approaches",
    Status.FEW_IMPACTS: "run more periods: the averages are over too few impacts for their standard error to hold",
    Status.NOT_RUN: "run the same command again: it resumes with the remaining cells",
}


USABLE_STATUSES = Status.OK, Status.CONVERGING, Status.STICKING
"""Statuses with a usable result: an orbit, or averages with a standard error."""


class WithStatus(PrintedRecord):
    """Base class of records that print their `status` by name."""

    def __repr__(self) -> str:
        status = getattr(self, "status", None)
        if not isinstance(status, np.ndarray | np.generic | jax.Array) or not is_concrete(status):
            return printed(self)
        # Arrays of many cells print the number of cells with each status.
        names = Counter(Status(int(code)).name for code in np.ravel(status))
        return printed(self, status=repr(dict(names) if np.ndim(status) else Status(int(status))))


class State(eqx.Module):
    """State of the ball: displacement, velocity, phase t in [0, 2), completed periods n, mode (-1, 0, +1)."""

    # mode: -1 in contact with the left wall, +1 with the right wall, 0 in flight. The separate period counter n keeps
    # the digits of t in long runs.
    u: Float[AnyArray, "..."]
    v: Float[AnyArray, "..."]
    t: Float[AnyArray, "..."]
    n: Int[AnyArray, "..."]
    mode: Int[AnyArray, "..."]


class Impact(eqx.Module):
    """One finished impact; `work` is the energy given to the membrane per unit mass, in squared velocity units."""

    n: Int[AnyArray, "..."]
    t: Float[AnyArray, "..."]
    # Onset at phase t of period n; side -1 left, +1 right; signed velocities; depth of rigid walls is for kappa = 1.
    side: Int[AnyArray, "..."]
    v_in: Float[AnyArray, "..."]
    v_out: Float[AnyArray, "..."]
    depth: Float[AnyArray, "..."]
    duration: Float[AnyArray, "..."]
    work: Float[AnyArray, "..."]
