"""Records of one ball: state, impact, and the status that says how a motion ended."""

import enum
from collections import Counter

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from vijax.runtime.arrays import AnyArray
from vijax.runtime.checks import is_concrete
from vijax.runtime.printed import PrintedRecord, printed


class Status(enum.IntEnum):
    """How a cell ended, and what to do; the values are what the `status` variable of a map stores."""

    OK = 0  # a periodic attractor, or averages with a standard error over an aperiodic one
    NO_IMPACT = 1  # neutral or free motion that never touches a wall again
    PERMANENT_CONTACT = 2  # rests in or on one wall for ever
    STICKING = 3  # as OK, but the attractor chatters into sticking on a rigid wall
    SLOW = 4  # neither periodic nor certainly aperiodic when the periods were spent
    EVENT_BUDGET = 5  # more impacts than the budget allows
    NONFINITE = 6  # the state left the finite numbers
    NO_ORBIT = 7  # no periodic orbit was found from the guess
    VIRTUAL = 8  # the equations of an orbit hold, but the ball would meet a wall in between
    UNSTABLE = 9  # the orbit repels, or is at a bifurcation
    NOT_RUN = 10  # the store is not finished, and nothing is known of the cell yet
    CONVERGING = 11  # as OK: its periods were spent before it arrived, and the orbit is the one that it approaches
    FEW_IMPACTS = 12  # aperiodic, with averages over too few impacts for their standard error

    @property
    def advice(self) -> str:
        """Say what to do about it, in a sentence."""
        return _ADVICE[self]

    def __repr__(self) -> str:
        return f"<Status.{self.name}: {self.value}, {self.advice}>"


_ADVICE = {
    Status.OK: "use it: the motion is periodic, or its averages have a standard error",
    Status.NO_IMPACT: "narrow the gap, force more strongly, or start elsewhere: the ball meets no wall any more",
    Status.PERMANENT_CONTACT: "force more strongly, or incline less: the ball never leaves a wall again",
    Status.STICKING: "use it as an attractor: the ball rests on a rigid wall for a while, and no orbit can be followed",
    Status.SLOW: "run more periods: the motion is neither periodic yet nor certainly aperiodic",
    Status.EVENT_BUDGET: "allow more impacts, or look at fewer periods: the ball chatters",
    Status.NONFINITE: "take shorter steps or tighter tolerances, or the exact method: the numbers overflowed",
    Status.NO_ORBIT: "begin nearer to an orbit, by a search or in smaller steps: the equations have no solution there",
    Status.VIRTUAL: "search for orbits with other impacts: the ball would meet a wall in between",
    Status.UNSTABLE: "follow it as a branch, or look for what attracts by a sweep: no ball stays on this orbit",
    Status.CONVERGING: "use it: the motion is slow to arrive, and Newton's method found the orbit that it approaches",
    Status.FEW_IMPACTS: "run more periods: the averages are over too few impacts for their standard error to hold",
    Status.NOT_RUN: "give the same command again: it goes on with what is left",
}


SETTLED = Status.OK, Status.CONVERGING, Status.STICKING
"""Ends of a motion that is known: an orbit, or averages with a standard error."""


class WithStatus(PrintedRecord):
    """A record that prints its `status` by name."""

    def __repr__(self) -> str:
        status = getattr(self, "status", None)
        if not isinstance(status, np.ndarray | np.generic | jax.Array) or not is_concrete(status):
            return printed(self)
        names = Counter(Status(int(code)).name for code in np.ravel(status))
        return printed(self, status=repr(dict(names) if np.ndim(status) else Status(int(status))))


class State(eqx.Module):
    """Where the ball is: displacement, velocity, phase t in [0, 2), periods completed, and the mode (-1, 0, +1)."""

    u: Float[AnyArray, "..."]
    v: Float[AnyArray, "..."]
    t: Float[AnyArray, "..."]
    n: Int[AnyArray, "..."]
    mode: Int[AnyArray, "..."]


class Impact(eqx.Module):
    """One finished impact. `work` is the energy given to the membrane per unit mass, in squared velocity units."""

    n: Int[AnyArray, "..."]
    t: Float[AnyArray, "..."]
    side: Int[AnyArray, "..."]
    v_in: Float[AnyArray, "..."]
    v_out: Float[AnyArray, "..."]
    depth: Float[AnyArray, "..."]
    duration: Float[AnyArray, "..."]
    work: Float[AnyArray, "..."]
