"""State of a cell on its lane, the static and traced choices of a run, and blank sums for a new cell.

A cell is one parameter combination. Every cell is a small state machine:

1. It searches until an impact recurs (`attractor_search`).
2. It follows the candidate orbit from that impact for one period of the orbit (a round), and accumulates the sums over
the impacts and the tangent map (`tally`).
3. A Newton step with this tangent map confirms or rejects the orbit. If confirmed, the sums of the last round are the
result (`summary`). If rejected, the cell returns to the search with a stricter tolerance.

A cell that reaches its last period without an orbit reports averages over the window that follows its transient.

Times are phases t in [0, 2) of the forcing period T = 2 with a period counter n; lengths and speeds are nondimensional
unless a unit is stated. The leading axis of every array is the lane.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vijax.impact.fast.fast_walls import TwoWalls
from vijax.impact.gravity_regime import GravityRegime
from vijax.impact.impact import Arrival, BallState, LaneImpact
from vijax.impact.method import ImpactOutcome, Method
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.walls.sides import Sides
from vijax.runtime.arrays import AnyArray, Lane, Mask, Values

# Share of the periods that a cell without an orbit excludes from its averages as the transient. A smaller share keeps
# more of the approach to the attractor in the averages, a larger one leaves fewer periods to average.
TRANSIENT_SHARE = 0.25
# Number of batch means that give a standard error. The standard error is itself uncertain by 1/sqrt(2 x 23), 15 %. With
# more batches, each batch is shorter; if the motion is correlated over more than the length of a batch, the standard
# error is too small.
BATCHES = 24
# An aperiodic cell with fewer impacts than ENOUGH_IMPACTS in its window runs on, with a longer window. Measured with
# 1,194 random cells, d from 0.03 to 10: averages are off by more than three standard errors in 6.8 % of the windows if
# no cell runs on, in 0.9 % if cells with fewer than 100 impacts do, in 0.5 % with 200. FULL_WINDOW is the length of a
# window if `periods` has its default, 400.
ENOUGH_IMPACTS, FULL_WINDOW = 200, 300.0
# Each extension multiplies the length of a run by RUN_ON. As the first 1/4 of a run is its transient, the whole run
# becomes the transient of the extended one. A run is extended until it is LONGEST_RUN times as long as `periods`.
RUN_ON, LONGEST_RUN = 1 / TRANSIENT_SHARE, 16.0
# The entries of the tangent map are kept between 1/TANGENT_SCALE and TANGENT_SCALE; the remaining factor is counted in
# an exponent. A power of two, so that scaling causes no rounding; products of two maps stay far from the overflow of
# float32, 2**128.
TANGENT_SCALE = 2.0**40


class Plan(eqx.Module):
    """Static choices of a run; each combination selects one compiled program.

    Attributes:
        until: "attractor" or "window".
        rigid: True if both walls are rigid.
        has_unequal_walls: True if the two walls may differ.
        rigid_side: Side of the rigid wall if the other wall is soft, -1 or +1; 0 if both are of one kind.
        gravity_regime: Range of gamma over all cells.
        deep: True to compute the greatest depths.
        energies: True to compute the harvested energy; needs `deep`.
        work: True to compute the energy that impacts give to the membrane, and the ratio of the harvested energy to it.
        asymmetry: True to compute the mean of v_in.
        tangent: True to compute the tangent map; the search for an attractor needs it.
        variants: Number of devices that share the motion of a cell.
        chained: True if a cell starts in the final state of the previous one (`chain`).
        devices: True if every cell has its own electrical constants.
    """

    until: str = eqx.field(static=True, default="attractor")
    rigid: bool = eqx.field(static=True, default=False)
    has_unequal_walls: bool = eqx.field(static=True, default=False)
    rigid_side: int = eqx.field(static=True, default=0)
    gravity_regime: GravityRegime = eqx.field(static=True, default=GravityRegime.NONE)
    deep: bool = eqx.field(static=True, default=False)
    energies: bool = eqx.field(static=True, default=False)
    work: bool = eqx.field(static=True, default=False)
    asymmetry: bool = eqx.field(static=True, default=False)
    tangent: bool = eqx.field(static=True, default=True)
    variants: int = eqx.field(static=True, default=1)
    chained: bool = eqx.field(static=True, default=False)
    devices: bool = eqx.field(static=True, default=False)

    def __str__(self) -> str:
        """Return every choice as text; compiled programs are kept under this text.

        The text of equinox would differ between processes: it omits a field only if the value is the same object as the
        default, and a string "attractor" made at run time is equal to the default but another object.
        """
        return str(dataclasses.asdict(self))


def walls_of(pair: ImpactPair) -> dict[str, Any]:
    """Return the fields of a `Plan` that describe the walls of a pair."""
    return {"rigid": pair.rigid, "has_unequal_walls": pair.has_unequal_walls, "rigid_side": pair.rigid_side}


class Settings(eqx.Module):
    """Traced numbers of a run, and the stepping method; None for the exact engine."""

    periods: Float[AnyArray, ""]
    transient: Float[AnyArray, ""]
    device: Harvester
    method: Method | None
    length_variant: Float[AnyArray, " variant"]
    speed_variant: Float[AnyArray, " variant"]
    recorded_periods: Float[AnyArray, ""] | None = None  # chained: periods at the end with recorded impacts


class Entry(eqx.Module):
    """Row of the cell table: the input of one cell.

    Attributes:
        pair: Its parameters.
        length, speed: SI sizes of the cell's units of length and speed.
        u, v: Displacement and velocity at the start. In a chained cell, before the final state of the previous cell is
            inserted: factors that convert displacement and velocity from the units of the previous cell to the units of
            this cell.
        t: Phase of the start; None if every cell starts at phase 0.
        device: Electrical constants of the cell (`device.electrical_device`); None if all cells use the device of the
            settings.
    """

    pair: ImpactPair
    length: Values
    speed: Values
    u: Values
    v: Values
    t: Values | None
    device: Harvester | None = None


class Harvest(eqx.Module):
    """Sums of the energy harvested by the variants of a cell, and sums over flights for the standard error."""

    batch: Float[AnyArray, "lane variant"]  # energy of the current batch so far
    past: Float[AnyArray, "lane variant"]  # energy of all full batches
    square: Float[AnyArray, "lane variant"]  # sum of the squared energies of the full batches
    ratio: Float[AnyArray, "lane variant"] | None  # largest ratio of the harvested energy to the work of an impact
    flight_squares: Lane  # sum of the squared durations of all flights
    longest_flight: Lane  # duration of the longest flight


class Tally(eqx.Module):
    """Sums over the impacts of a window, or over one round of a candidate orbit."""

    left: Lane  # impacts on the left wall
    right: Lane  # impacts on the right wall
    rebound_left: Lane  # sum of -v_out/v_in, the effective restitution
    rebound_right: Lane
    contact: Lane  # total contact duration
    fastest: Lane  # greatest |v_in|
    momentum: Lane | None  # sum of v_in, signed
    deepest: Lane | None  # greatest penetration
    deepest_sides: Sides | None  # per wall; only where the two walls may differ
    harvest: Harvest | None
    stuck: Mask | None  # the ball stuck to a rigid wall after a chatter


class Candidate(eqx.Module):
    """State of an attractor search: the recurrence test and the Newton rounds on a candidate orbit."""

    anchor_t: Lane  # phase of the anchor's onset; new impacts are compared with the anchor, an earlier impact
    anchor_n: Lane  # period of the anchor's onset
    anchor_v: Lane  # v_in of the anchor; inf before the first anchor
    anchor_count: Lane  # impact count at the anchor
    next_anchor: Lane  # impact count at the next move of the anchor
    tolerance: Lane  # distance within which an impact recurs
    recurred: Mask  # a recurrence awaits review
    tracing: Mask  # the cell follows a round of a candidate orbit
    remaining: Lane  # impacts still to come in this round
    length: Lane  # impacts of a round
    period: Lane  # period of the candidate orbit, in forcing periods
    prime: Lane  # shortest recurrence time in this round: the prime period
    round_start: BallState  # start of the round, corrected by Newton's steps
    search_ball: BallState  # state of the search when the first round began
    step_sum: Lane  # sum of the sizes of Newton's steps
    last_step: Lane  # size of the last Newton step
    rounds: Lane  # Newton steps taken on this candidate
    late: Mask  # `periods` are over, and the search continues for a while with a larger tolerance
    laps: Lane  # periods of the orbit to simulate before the next decision
    followed: Mask  # the motion was followed and approached the orbit of Newton's method
    extension: Lane  # length of the run divided by `periods`: above 1 if the window had too few impacts


class MethodState(eqx.Module):
    """State of a lane of a stepping method: wall constants, the method's carry, and a finished impact not yet added."""

    wall: Any
    carry: Any
    pending: Mask  # `outcome` is a finished impact that is not yet added to the sums
    outcome: ImpactOutcome


class ChainState(eqx.Module):
    """Record of a chained cell for the computation of its final state."""

    start: BallState
    mark: BallState  # exit of the last impact before the recorded periods
    mode: Lane  # side of the contact at the mark, 0 in flight
    last: BallState  # exit of the last impact before the end if the orbit is repeated until then
    latest: Lane  # onset of the impact with the exit `last`, in periods


class Cell(eqx.Module):
    """Complete state of a lane's cell: parameters, position of the ball, and results so far."""

    pair: ImpactPair
    wall: TwoWalls | None
    method_state: MethodState | None
    length: Lane
    speed: Lane
    device: Harvester | None
    ball: BallState
    mode: Lane  # side of the contact at the start of the run, 0 in flight
    running: Mask  # the cell takes steps; if not, it awaits review or is done
    declined: Mask  # the fast step did not certify the next impact
    needs_robust: Mask  # the fast fallback did not certify the next impact either
    arrival: Arrival | None  # end of the flight as the last fast step computed it
    done: Mask
    status: Int[Array, " lane"]  # code of `Status`
    count: Lane  # impacts so far
    since: Lane  # first period of the window
    batch: Lane  # index of the current batch of the window, -1 before the window
    tally: Tally
    candidate: Candidate | None
    tangent: tuple[Lane, Lane, Lane, Lane] | None  # 2 x 2 tangent map, row by row, over TANGENT_SCALE**exponent
    exponent: Lane | None
    multiplier: Lane | None  # modulus of the largest Floquet multiplier of the confirmed orbit
    chain_state: ChainState | None = None


class Event(eqx.Module):
    """Outcome of one step: an impact, no further impact, or a contact that never ends."""

    impact: LaneImpact
    real: Mask  # there is an onset
    no_impact: Mask  # no impact within the horizon
    permanent: Mask  # a contact that never ends
    stuck: Mask  # the ball stuck to a rigid wall


def blank_tally(plan: Plan, like: Lane) -> Tally:
    """Return a tally of zero impacts."""
    zero = jnp.zeros_like(like)
    zeros = jnp.zeros((*like.shape, plan.variants), like.dtype)
    harvest = Harvest(zeros, zeros, zeros, zeros if plan.work else None, zero, zero) if plan.energies else None
    stuck = jnp.zeros(like.shape, bool) if plan.rigid or plan.rigid_side else None
    depth = zero if plan.deep else None
    depth_sides = Sides(zero, zero) if plan.deep and plan.has_unequal_walls else None
    momentum = zero if plan.asymmetry else None
    return Tally(zero, zero, zero, zero, zero, zero, momentum, depth, depth_sides, harvest, stuck)


def batch_length(settings: Settings, candidate: Candidate | None) -> Lane | Float[Array, ""]:
    """Return the length in periods of a batch for the batch means."""
    window = settings.periods if candidate is None else (1 - TRANSIENT_SHARE) * settings.periods * candidate.extension
    return jnp.maximum(jnp.floor(window / BATCHES), 1.0)
