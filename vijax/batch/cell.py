"""A cell on its lane: what the run is asked for, where the ball is, what has been seen; and a fresh one.

Every cell is a small state machine. It searches until an impact recurs (`attractor_search`), then follows the candidate
orbit from one impact around to the next, adding up its measures and its tangent map (`tally`); Newton's step on that
map either confirms the orbit (the sums of the last round are the answer, `summary`) or sends the cell back to search,
more sceptical. A cell that reaches its last period without an orbit reports averages over the window since its
transient.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vijax.engine.ground import Ground
from vijax.engine.impact import Arrival, Ball, LaneImpact
from vijax.engine.method import ImpactOutcome, Method
from vijax.engine.quick_wall import TwoWalls
from vijax.model.device import Harvester
from vijax.model.pair import ImpactPair
from vijax.model.sides import Sides
from vijax.runtime.arrays import AnyArray, Lane, Mask, Values

# Share of its periods that a cell without an orbit leaves out of its averages. Less keeps more of the way to the
# attractor in them, more leaves fewer periods to average.
TRANSIENT_SHARE = 0.25
# Batch means behind a standard error, which is itself uncertain by 1/sqrt(2 x 23), 15 %. With more of them a batch is
# shorter, and motion that remembers for longer than a batch has too small an error.
BATCHES = 24
# An aperiodic cell whose window has fewer impacts than this runs on. Of 1,194 random cells with d from 0.03 to 10
# averages are off by more than three standard errors in 6.8 % of the windows where none runs on, in 0.9 % where those
# with fewer than 100 impacts do, in 0.5 % with 200. Their windows have 300 periods, as `periods` is 400 by default.
ENOUGH_IMPACTS, FULL_WINDOW = 200, 300.0
# It runs on by this factor: as the window leaves out a share of 1/4 of the run, the periods that were run become the
# transient of the longer window. It does so until the run is so many times as long as `periods`.
RUN_ON, LONGEST_RUN = 1 / TRANSIENT_SHARE, 16.0
# The tangent map is kept between 1/TANGENT_SCALE and this, the rest in an exponent. A power of two, so that scaling
# rounds nothing; products of two maps stay far from where float32 ends, 2**128.
TANGENT_SCALE = 2.0**40


class Plan(eqx.Module):
    """What a run is asked for: the static choices that select a compiled program.

    Attributes:
        until: "attractor" or "window".
        rigid: Whether the walls are.
        unequal: Whether the two walls may differ.
        hard_wall: Which wall is rigid beside a soft one; 0 where both are of one kind.
        ground: What gamma is over all cells.
        deep: Whether greatest depths are wanted.
        energies: Whether what is harvested is wanted; needs `deep`.
        work: Whether what impacts give to the membrane is wanted, and what is harvested is set against it.
        asymmetry: Whether the mean of v_in is wanted.
        tangent: Whether the tangent map is wanted; the search for an attractor needs it.
        variants: How many devices share the motion of a cell.
        chained: Whether a cell starts in the last one's state (`chain`).
        devices: Whether every cell has electrical constants of its own.
    """

    until: str = eqx.field(static=True, default="attractor")
    rigid: bool = eqx.field(static=True, default=False)
    unequal: bool = eqx.field(static=True, default=False)
    hard_wall: int = eqx.field(static=True, default=0)
    ground: Ground = eqx.field(static=True, default=Ground.LEVEL)
    deep: bool = eqx.field(static=True, default=False)
    energies: bool = eqx.field(static=True, default=False)
    work: bool = eqx.field(static=True, default=False)
    asymmetry: bool = eqx.field(static=True, default=False)
    tangent: bool = eqx.field(static=True, default=True)
    variants: int = eqx.field(static=True, default=1)
    chained: bool = eqx.field(static=True, default=False)
    devices: bool = eqx.field(static=True, default=False)

    def __str__(self) -> str:
        """Name every choice, as programs are kept by it.

        Equinox leaves out what is a default, but tells that by identity: "attractor" of another process is none.
        """
        return str(dataclasses.asdict(self))


def walls_of(pair: ImpactPair) -> dict[str, Any]:
    """Name what a `Plan` says of the walls of a pair."""
    return {"rigid": pair.rigid, "unequal": pair.unequal, "hard_wall": pair.hard_wall}


class Settings(eqx.Module):
    """What a run is asked for: the traced numbers, and the method that steps; None for the exact engine."""

    periods: Float[AnyArray, ""]
    transient: Float[AnyArray, ""]
    device: Harvester
    method: Method | None
    length_variant: Float[AnyArray, " variant"]
    speed_variant: Float[AnyArray, " variant"]
    recorded_periods: Float[AnyArray, ""] | None = None  # chained: periods at the end whose impacts are wanted


class Entry(eqx.Module):
    """What a run is told of a cell.

    Attributes:
        pair: Its parameters.
        length, speed: SI sizes of its units.
        u, v: Its start; of a chained cell how displacement and velocity grow from the last cell's units to its own,
            until the state that it is handed stands there.
        t: Phase of the start; None where every cell starts at phase 0.
        device: Its electrical constants (`device.electrical`); None where all cells share those of the settings.
    """

    pair: ImpactPair
    length: Values
    speed: Values
    u: Values
    v: Values
    t: Values | None
    device: Harvester | None = None


class Harvest(eqx.Module):
    """The energies that the variants of a cell have harvested, and the flights between impacts, for their error."""

    batch: Float[AnyArray, "lane variant"]  # what the running batch has given so far
    past: Float[AnyArray, "lane variant"]  # what all full batches have given
    square: Float[AnyArray, "lane variant"]  # the squares of what each full batch has given, added up
    ratio: Float[AnyArray, "lane variant"] | None  # largest of harvested energy over what an impact gave
    flights: Lane  # the squares of the durations of all flights, added up
    longest: Lane  # duration of the longest flight


class Tally(eqx.Module):
    """Sums over the impacts of a window or of one round of a candidate orbit."""

    left: Lane
    right: Lane
    rebound_left: Lane  # sum of -v_out/v_in
    rebound_right: Lane
    contact: Lane
    fastest: Lane
    momentum: Lane | None  # sum of v_in, signed
    deepest: Lane | None
    deepest_sides: Sides | None  # the same of each wall, kept only where the two may differ
    harvest: Harvest | None
    stuck: Mask | None


class Candidate(eqx.Module):
    """The recurrence test and the Newton rounds of an attractor search."""

    anchor_t: Lane
    anchor_n: Lane
    anchor_v: Lane
    anchor_count: Lane
    next_anchor: Lane
    tolerance: Lane
    found: Mask  # a recurrence waits for review
    tracing: Mask  # on a round of a candidate orbit
    left: Lane  # impacts still to come in this round, or that a round will have
    length: Lane  # impacts of a round
    period: Lane
    prime: Lane  # smallest recurrence seen on this round: a flip's slow decay recurs sooner after two turns than one
    base: Ball
    origin: Ball  # where the search stood when the first round began
    moved: Lane
    last: Lane
    rounds: Lane
    late: Mask  # its periods are spent: the search goes on for a while, less sceptical of recurrences
    laps: Lane  # rounds that are flown before the next judgement
    followed: Mask  # the motion was seen to come nearer to the orbit that Newton's method found
    stretch: Lane  # how many times as long as the plan's the run is: 1, or more where the window had too few impacts


class Course(eqx.Module):
    """A lane of a method that steps: its wall, the method's carry, and the last impact if it waits to be added."""

    wall: Any
    carry: Any
    waits: Mask
    outcome: ImpactOutcome


class Relay(eqx.Module):
    """What a chained cell needs to be handed on."""

    start: Ball
    mark: Ball  # the last exit before the kept periods
    held: Lane  # mode at the mark
    last: Ball  # exit of the latest impact before the end, if the round were repeated until then
    latest: Lane  # the onset of that impact, in periods


class Cell(eqx.Module):
    """A lane's cell: parameters, where the ball is, and what has been seen."""

    pair: ImpactPair
    wall: TwoWalls | None
    course: Course | None
    length: Lane
    speed: Lane
    device: Harvester | None
    ball: Ball
    held: Lane  # mode of a start in contact
    running: Mask
    declined: Mask
    hard: Mask  # declined by sampling too
    arrival: Arrival | None  # the end of the flight as the last step found it
    done: Mask
    status: Int[Array, " lane"]
    count: Lane  # impacts so far
    since: Lane  # first period of the window
    batch: Lane  # running batch of the window, -1 before it
    tally: Tally
    candidate: Candidate | None
    tangent: tuple[Lane, Lane, Lane, Lane] | None
    exponent: Lane | None
    multiplier: Lane | None
    relay: Relay | None = None


class Event(eqx.Module):
    """An impact with what only the careful step can meet: nothing within the horizon, a contact for ever, sticking."""

    impact: LaneImpact
    real: Mask  # an onset was seen
    quiet: Mask
    permanent: Mask
    stuck: Mask


def blank_tally(plan: Plan, like: Lane) -> Tally:
    """Make sums of nothing yet."""
    zero = jnp.zeros_like(like)
    wide = jnp.zeros((*like.shape, plan.variants), like.dtype)
    harvest = Harvest(wide, wide, wide, wide if plan.work else None, zero, zero) if plan.energies else None
    stuck = jnp.zeros(like.shape, bool) if plan.rigid or plan.hard_wall else None
    deepest = zero if plan.deep else None
    sides = Sides(zero, zero) if plan.deep and plan.unequal else None
    momentum = zero if plan.asymmetry else None
    return Tally(zero, zero, zero, zero, zero, zero, momentum, deepest, sides, harvest, stuck)


def batch_length(settings: Settings, candidate: Candidate | None) -> Lane | Float[Array, ""]:
    """Compute the length of a batch, of which the standard error is made, in periods."""
    window = settings.periods if candidate is None else (1 - TRANSIENT_SHARE) * settings.periods * candidate.stretch
    return jnp.maximum(jnp.floor(window / BATCHES), 1.0)
