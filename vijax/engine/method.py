"""What a run asks of a method that steps through time: `Method`, of which `rk4.Rk4` is the shortest example.

The exact engine is none: it has no steps.
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

from vijax.model import membrane
from vijax.model.membrane import Laws, Linear
from vijax.model.pair import ImpactPair
from vijax.model.records import Impact, State
from vijax.model.waves import Waves, sine
from vijax.runtime.arrays import Flag, Scalar

# A method that chooses its steps and takes more of them per impact and period is stopped.
_PER_IMPACT = 256
# A contact that outlasts the last period of a recorded run by so many is taken to last for ever.
HELD = 8

_DECISION = "decision"


def decided(choice: Any) -> Any:
    """Mark what a step decides (which branch it takes, how long the next one is) to be taken once; see `repeated`."""
    return jax.tree.map(partial(checkpoint_name, name=_DECISION), choice)


def repeated(run: Callable[..., Any]) -> Callable[..., Any]:
    """Make a run of steps that a derivative in reverse does again, with the decisions of the first time.

    The compiler may round the repetition in another way. To the motion that is rounding, but the error estimate of a
    step is itself close to it: lengths came out different in the sixth digit, steps were refused that had been
    accepted, and the derivatives that arrived were those of another place of the motion.
    """
    return jax.checkpoint(run, policy=_is_decision)


def _is_decision(primitive: Any, /, *_: Any, **params: Any) -> bool:
    # Not jax.checkpoint_policies.save_only_these_names: a primitive of equinox has a parameter of the name "prim" too.
    return primitive.name == "name" and params["name"] == _DECISION


class ImpactOutcome(eqx.Module):
    """A finished impact of a method that steps: from the exit of the last contact to the exit of this one.

    Attributes:
        impact: The impact.
        flight: Time from the last exit (or the start) to the onset.
        after: The ball as it leaves.
        tangent: Tangent map of the whole, row by row, saltations included; None where nobody asked for it.
    """

    impact: Impact
    flight: Float[Array, "..."]
    after: State
    tangent: tuple[Any, ...] | None


@runtime_checkable
class Carry(Protocol):
    """What a run reads of a method's carry, which is a record of the method's own making."""

    @property
    def n(self) -> Array:
        """Count the periods completed."""

    @property
    def mode(self) -> Array:
        """Say which wall the ball is inside of, -1 or +1; 0 in flight."""

    @property
    def onset_n(self) -> Array:
        """Say in which period its last contact began."""

    @property
    def depth(self) -> Array:
        """Say how deep it has been in this contact so far."""


@runtime_checkable
class ContactCarry(Protocol):
    """What the record of an impact reads of a carry: its contact, and when the ball left the wall before."""

    onset_t: Any
    onset_n: Any
    v_in: Any
    depth: Any
    left_t: Any
    left_n: Any


def finished(m: ContactCarry, side: Any, after: State, work: Any, tangent: tuple[Any, ...] | None) -> ImpactOutcome:
    """Record the impact of a carry that ends on the wall of a side, with the ball in the state `after` it."""
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
    flight = (m.onset_t - m.left_t) + 2 * (m.onset_n - m.left_n).astype(t.dtype)
    return ImpactOutcome(impact, flight, after, tangent)


C = TypeVar("C", bound=Carry)


class Method(eqx.Module, Generic[C]):
    """A method that steps through time: its numbers, and the three functions that a run calls.

    A subclass is a method of its own: `summarise` and `trajectory` take a record of it. Its functions are written for
    one lane, of scalars; `batch` maps them over lanes, which all step together. A step decides nothing by Python's
    `if`, and what becomes of a motion that cannot go on is an impact of NaN.

    Attributes:
        law: The membrane, or that of either wall; the linear one unless given.
    """

    law: Laws = eqx.field(default_factory=Linear, kw_only=True)

    def walls(self, pair: ImpactPair) -> Any:
        """Give what `step` is told of the walls of a cell; once, where it would compute it every time.

        Args:
            pair: One cell (scalars); its `law` goes before that of the method.
        """
        law: Any = self.law if pair.law is None else pair.law
        return membrane.walls(law, pair)

    @abstractmethod
    def start(self, pair: ImpactPair, state: State, *, deep: bool, tangent: bool) -> C:
        """Make the carry of a start, in flight or inside a wall (then a contact without onset, which is no impact).

        Args:
            pair: One cell (scalars), soft.
            state: Where the ball is; its mode is believed.
            deep: Whether greatest depths and works are wanted.
            tangent: Whether tangent maps are wanted.
        """

    @abstractmethod
    def step(self, pair: ImpactPair, walls: Any, carry: C, *, recorded: bool = False) -> tuple[C, ImpactOutcome, Flag]:
        """Try one step.

        Args:
            pair: One cell (scalars).
            walls: What `walls` says of it: its membrane, (w, w') -> acceleration; one for each wall where they differ.
            carry: From `start` or an earlier step.
            recorded: For trajectories: a step ends at phase 0, and can be differentiated in reverse.

        Returns:
            The carry after it, and the impact that this step finished, meaningless unless the flag says that it did.
        """

    @abstractmethod
    def ball(self, pair: ImpactPair, carry: C) -> State:
        """Say where the ball of a carry is."""

    def rests(self, pair: ImpactPair, carry: C) -> Flag:
        """Say whether the ball of a carry will never move again, in flight."""
        return jnp.zeros(jnp.shape(pair.d), bool)

    def braked(self, gamma: Any, v: Any) -> Any:
        """Give what gravity would be to a ball in flight at velocity v if what brakes it were a part of it."""
        return gamma

    def waves(self, t: Any) -> Waves:
        """Give the harmonics of the forcing from phase t on; of any shape."""
        return sine(t)

    @property
    def repeats(self) -> bool:
        """Say whether these are all of the forcing, so that it repeats after every period."""
        return True

    @property
    def arithmetic(self) -> bool:
        """Say whether a step calls no library, so that kernels may hold it (`xla.kernel`); False is never wrong."""
        return False

    @property
    def grain(self) -> Scalar | float:
        """Say how far apart two motions from one point may end: 0 unless the method chooses its steps."""
        return 0.0

    def taken(self, carry: C) -> Array | None:
        """Count the steps so far; None where the clock does, as all are of one length."""
        return None

    def most_steps(self, pair: ImpactPair, periods: int, max_impacts: int) -> int:
        """Say after how many steps a recorded run of some cells is stopped."""
        return _PER_IMPACT * (periods + max_impacts)


def braked_by(method: Method | None, gamma: Any, v: Any) -> Any:
    """Give the gravity of a ball in flight with what brakes it; nothing does without a method."""
    return gamma if method is None else method.braked(gamma, v)


def waves_of(method: Method | None, t: Any) -> Waves:
    """Give the harmonics of a method's forcing from phase t on; the exact engine, None, knows the sine alone."""
    return sine(t) if method is None else method.waves(t)
