"""Motion with dry friction: closed forms between events; small steps and bisection locate the events.

It shares only the equation with the package: u'' = cos(pi t) - gamma - friction sign(u'), and inside a wall a linear
spring and damper in addition. A ball at rest sticks while the force on it does not exceed the friction.
"""

import cmath
import math
from typing import NamedTuple

PI = math.pi
STEP = 1 / 256  # two events within one step may be missed: the cases have no such events


class Law(NamedTuple):
    """The pair, the damping of its walls, and the friction."""

    d: float
    kappa: float
    mu: float
    gamma: float
    friction: float


class ReferenceMotion(NamedTuple):
    """Impacts (onset, side, v_in, v_out, depth, duration), and the direction of motion after each turning point."""

    impacts: list[tuple[float, ...]]
    turnings: list[int]


def _flight(x, z, t, gamma):
    def at(s):
        rise = (
            z * s - gamma * s * s / 2 + (math.cos(PI * t) - math.cos(PI * (t + s))) / PI**2 - math.sin(PI * t) * s / PI
        )
        return x + rise, z - gamma * s + (math.sin(PI * (t + s)) - math.sin(PI * t)) / PI

    return at


def _contact(law, side, x, z, t, gamma):
    gain = side / (law.kappa**2 - PI**2 + 1j * PI * law.mu)

    def forced(t):
        wave = gain * cmath.exp(1j * PI * t)
        return wave.real - side * gamma / law.kappa**2, (1j * PI * wave).real

    zeta = law.mu / 2
    omega = math.sqrt(law.kappa**2 - zeta**2)
    w0, z0 = (a - b for a, b in zip((x, z), forced(t), strict=True))

    def at(s):
        decay, c, q = math.exp(-zeta * s), math.cos(omega * s), math.sin(omega * s)
        w, slope = forced(t + s)
        free = w0 * c + (z0 + zeta * w0) / omega * q
        return w + decay * free, slope + decay * (z0 * c - (law.kappa**2 * w0 + zeta * z0) / omega * q)

    return at


def _first(happens, limit):
    """Return the time of the first change of `happens` to true, by steps and bisection; inf if after the limit."""
    s = 0.0
    while not happens(s + STEP):
        s += STEP
        if s > limit:
            return math.inf
    low, high = s, s + STEP
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if happens(middle) else (middle, high)
    return high


def follow(law: Law, u: float, v: float, end: float) -> ReferenceMotion:
    """Simulate a ball from phase 0 until `end`."""
    t, mode, x, z = 0.0, 0, u, v
    motion, onset, deepest = ReferenceMotion([], []), (math.nan, math.nan), 0.0

    def drive(t):
        return math.cos(PI * t) - law.gamma - mode * law.kappa**2 * x

    def slip_direction():
        return 0 if abs(drive(t)) <= law.friction else int(math.copysign(1, drive(t)))

    slip = int(math.copysign(1, v)) if v else slip_direction()
    while t < end:
        if slip == 0:
            wait = _first(lambda s, t=t: abs(drive(t + s)) > law.friction, end - t)
            t, z = t + wait, 0.0
            slip = slip_direction() if t < end else 0
            continue
        gamma = law.gamma + law.friction * slip
        at = _contact(law, mode, x, z, t, gamma) if mode else _flight(x, z, t, gamma)
        way = slip * (mode or 1)

        def event(s, at=at, way=way, mode=mode):
            place, rate = at(s)
            if rate * way < 0:
                return "turning"
            return "wall" if (place < 0 if mode else abs(place) > law.d / 2 and place * rate > 0) else ""

        s = _first(event, end - t)
        if math.isinf(s):
            break
        (x, z), t, kind = at(s), t + s, event(s)
        if kind == "turning":
            z, deepest = 0.0, max(deepest, x)
            slip = slip_direction()
            motion.turnings.append(slip)
        elif mode:
            motion.impacts.append((onset[0], mode, mode * onset[1], mode * z, deepest, t - onset[0]))
            mode, x, z = 0, mode * law.d / 2, mode * z
        else:
            mode = int(math.copysign(1, x))
            x, z, onset, deepest = 0.0, abs(z), (t, abs(z)), 0.0
    return motion
