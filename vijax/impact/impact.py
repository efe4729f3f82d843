"""Records of one impact in every lane: the state of the ball, the end of its flight, and the impact."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import Bool

from vijax.runtime.arrays import AnyArray, Lane


class BallState(eqx.Module):
    """State of the ball between impacts: displacement u, velocity v, phase t in [0, 2), number n of completed periods.

    All fields are floating point, including n.
    """

    u: Lane
    v: Lane
    t: Lane
    n: Lane


class LaneImpact(eqx.Module):
    """A finished impact of every lane: the flight before it, its onset, its exit, and the state `after` it.

    Depth, work and tangent map (row by row, of flight and contact together) are None unless they were requested.
    """

    onset_t: Lane
    onset_n: Lane
    side: Lane
    v_in: Lane
    v_out: Lane
    flight: Lane
    duration: Lane
    after: BallState
    depth: Lane | None = None
    work: Lane | None = None
    tangent: tuple[Lane, Lane, Lane, Lane] | None = None


class Arrival(NamedTuple):
    """End of a flight: its duration, the speed into the wall, the wall's side, and whether it is certified."""

    flight: Lane
    speed: Lane
    side: Lane
    certified: Bool[AnyArray, " lane"]
