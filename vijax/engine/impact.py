"""What one impact of every lane is made of: where the ball is, where its flight ends, what the impact was."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import Bool

from vijax.runtime.arrays import AnyArray, Lane


class Ball(eqx.Module):
    """The state between impacts, all floating point: displacement, velocity, phase in [0, 2), periods completed."""

    u: Lane
    v: Lane
    t: Lane
    n: Lane


class LaneImpact(eqx.Module):
    """A finished impact of every lane: onset, exit and, where asked for, depth, work and tangent map (row by row)."""

    onset_t: Lane
    onset_n: Lane
    side: Lane
    v_in: Lane
    v_out: Lane
    flight: Lane
    duration: Lane
    after: Ball
    depth: Lane | None = None
    work: Lane | None = None
    tangent: tuple[Lane, Lane, Lane, Lane] | None = None


class Arrival(NamedTuple):
    """A flight's end: its length, the speed into the wall, the wall's side, and whether all that is certain."""

    flight: Lane
    speed: Lane
    side: Lane
    sure: Bool[AnyArray, " lane"]
