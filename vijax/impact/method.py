"""Protocol of a method that steps through time: `Method`. `rk4.Rk4` is the shortest example.

The exact engine is not a `Method`, because it has no time steps.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from vijax.model.forcing.waves import Waves, sine
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State
from vijax.model.walls import membrane
from vijax.model.walls.membrane import Laws, Linear
from vijax.runtime.arrays import Flag, Scalar

# Step limit, per impact and per period, of a method that chooses its step lengths.
_PER_IMPACT = 256
# A contact that continues for this many periods after the last period of a recorded run counts as permanent.
MAX_CONTACT_PERIODS = 8

_DECISION = "decision"


def save_decision(choice: Any) -> Any:
    """Mark the decisions of a step (selected branches, next step length); `checkpoint_steps` saves marked values."""
    return jax.tree.map(partial(checkpoint_name, name=_DECISION), choice)


def checkpoint_steps(run: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a run of steps so that reverse-mode differentiation recomputes it with the saved decisions.

    The compiler may round the recomputation differently. This changes the motion only by rounding errors. The error
    estimate of a step, however, is itself close to rounding: without saved decisions the step lengths differed in the
    sixth digit, rejected steps were accepted, and the derivatives belonged to another part of the motion.
    """
    return jax.checkpoint(run, policy=_is_decision)


def _is_decision(primitive: Any, /, *_: Any, **params: Any) -> bool:
    # `jax.checkpoint_policies.save_only_these_names` fails here: a primitive of equinox also has a parameter called
    # "name".
    """Return True for a value that `save_decision` marked."""
    return primitive.name == "name" and params["name"] == _DECISION


class ImpactOutcome(eqx.Module):
    """A finished impact of a stepping method, from the exit of the last contact to the exit of this contact.

    Attributes:
        impact: The impact.
        flight: Time from the last exit (or the start) to the onset.
        after: State of the ball at the exit.
        tangent: Tangent map from exit to exit, row by row, saltations included; None if it was not requested.
    """

    impact: Impact
    flight: Float[Array, "..."]
    after: State
    tangent: tuple[Any, ...] | None


@runtime_checkable
class Carry(Protocol):
    """Fields that a run reads from a method's carry, the record that the method passes from step to step."""

    @property
    def n(self) -> Array:
        """Number of periods completed."""

    @property
    def mode(self) -> Array:
        """Side of the wall that the ball is in contact with, -1 or +1; 0 in flight."""

    @property
    def onset_n(self) -> Array:
        """Period of the onset of the last contact."""

    @property
    def depth(self) -> Array:
        """Largest depth in this contact so far."""


@runtime_checkable
class ContactCarry(Protocol):
    """Fields of a carry that `impact_outcome` reads: data of the contact, and the time of the exit before it."""

    onset_t: Any
    onset_n: Any
    v_in: Any
    depth: Any
    exit_t: Any
    exit_n: Any


def impact_outcome(
    m: ContactCarry, side: Any, after: State, work: Any, tangent: tuple[Any, ...] | None
) -> ImpactOutcome:
    """Return the impact that ends with the state `after`, from the carry `m` and the side of the wall."""
    t, n = after.t, after.n
    impact = Impact(
        n=m.onset_n,
        t=m.onset_t,
        side=side.astype(n.dtype),
        v_in=m.v_in,
        v_out=after.v,
        depth=m.depth,
        duration=(t - m.onset_t) + 2 * (n - m.onset_n).astype(t.dtype),
        work=work,
    )
    flight = (m.onset_t - m.exit_t) + 2 * (m.onset_n - m.exit_n).astype(t.dtype)
    return ImpactOutcome(impact, flight, after, tangent)


C = TypeVar("C", bound=Carry)


class Method(eqx.Module, Generic[C]):
    """A method that steps through time: its numerical parameters, and the three functions that a run calls.

    To define a method, derive a class from this one; `summarise` and `trajectory` accept its instances. Its functions
    are written for one lane, with scalars. `batch` maps them over lanes, which all step together. A step therefore must
    not use Python's `if` on values of a lane. If a motion cannot continue, the method returns an impact with v_out NaN.

    Attributes:
        law: The membrane, or one membrane per wall; the linear membrane by default.
    """

    law: Laws = eqx.field(default_factory=Linear, kw_only=True)

    def walls(self, pair: ImpactPair) -> Any:
        """Return the walls of a cell, an argument of `step`; a run computes them once for all of its steps.

        Args:
            pair: One cell (scalars); its `law` takes precedence over the law of the method.
        """
        law: Any = self.law if pair.law is None else pair.law
        return membrane.bind_laws(law, pair)

    @abstractmethod
    def start(self, pair: ImpactPair, state: State, *, deep: bool, tangent: bool) -> C:
        """Return the carry of an initial state, in flight or inside a membrane.

        A contact at the start has no onset and is not counted as an impact.

        Args:
            pair: One cell (scalars), soft.
            state: Initial state; its mode is not checked.
            deep: If True, compute the largest depths and the works.
            tangent: If True, compute the tangent maps.
        """

    @abstractmethod
    def step(self, pair: ImpactPair, walls: Any, carry: C, *, recorded: bool = False) -> tuple[C, ImpactOutcome, Flag]:
        """Try one step; a method with an error estimate may reject it, and then only the next step length changes.

        Args:
            pair: One cell (scalars).
            walls: Result of `walls` for the cell: the membrane, (w, w') -> acceleration; one per wall if the walls
                differ.
            carry: From `start` or an earlier step.
            recorded: True for a recorded run (a trajectory). A step then ends at the end of each period, and supports
                reverse-mode differentiation.

        Returns:
            The carry after the step, the impact that the step finished, and a flag. Unless the flag is True, the step
            finished no impact and the impact has no meaning.
        """

    @abstractmethod
    def ball(self, pair: ImpactPair, carry: C) -> State:
        """Return the state of the ball of a carry."""

    def is_at_rest(self, pair: ImpactPair, carry: C) -> Flag:
        """Return True if the ball of a carry is in flight and never moves again."""
        return jnp.zeros(jnp.shape(pair.d), bool)

    def effective_gamma(self, gamma: Any, v: Any) -> Any:
        """Return the effective gamma of a ball in flight at velocity v: gravity plus the method's braking force."""
        return gamma

    def waves(self, t: Any) -> Waves:
        """Return the harmonics of the forcing as functions of the time since phase t; t may have any shape."""
        return sine(t)

    @property
    def has_periodic_forcing(self) -> bool:
        """True if the harmonics of `waves` are the whole forcing, so that it repeats after every period."""
        return True

    @property
    def arithmetic(self) -> bool:
        """True if a step calls no library function, so that it can be part of a kernel (`xla.kernel`).

        The default False is valid for every method.
        """
        return False

    @property
    def repeatability(self) -> Scalar | float:
        """Return the possible size of the difference between two computed motions that pass through the same state.

        It is 0 for methods with fixed steps, because such motions have the same steps.
        """
        return 0.0

    def step_count(self, carry: C) -> Array | None:
        """Return the number of steps so far; None if all steps have equal length (the time gives the number)."""
        return None

    def most_steps(self, pair: ImpactPair, periods: int, max_impacts: int) -> int:
        """Return the largest number of steps of a recorded run; a run that needs more is stopped."""
        return _PER_IMPACT * (periods + max_impacts)


def effective_gamma_of(method: Method | None, gamma: Any, v: Any) -> Any:
    """Return gamma plus the braking force of a method on a ball in flight at velocity v; gamma if method is None."""
    return gamma if method is None else method.effective_gamma(gamma, v)


def waves_of(method: Method | None, t: Any) -> Waves:
    """Return the harmonics of a method's forcing as functions of the time since phase t.

    For the exact engine (method is None) the forcing is the sine.
    """
    return sine(t) if method is None else method.waves(t)
