"""Motion of a ball under a sampled waveform in 40 digits; a scan and bisection locate each event."""

from typing import NamedTuple

import mpmath as mp
import numpy as np

DIGITS = 40
_SCANNED = 40  # points per sample interval; the cases have no two events closer than this spacing


class Row(NamedTuple):
    """An impact: onset since t = 0, side, signed speeds, contact duration, depth."""

    onset: mp.mpf
    side: int
    v_in: mp.mpf
    v_out: mp.mpf
    duration: mp.mpf
    depth: mp.mpf


def march(case, values, samples: int, count: int) -> list[Row]:
    """Return the first impacts of a start (d, kappa, r, gamma, u0, v0); in a pair the left wall is first."""
    d, kappa, r, gamma, x, z = (tuple(map(mp.mpf, x)) if isinstance(x, tuple) else mp.mpf(x) for x in case)
    half, gap, rows = d / 2, mp.mpf(2) / samples, []
    side, k, s, onset, depth, v_in = 0, 0, mp.mpf(0), mp.mpf(0), mp.mpf(0), mp.mpf(0)
    while len(rows) < count:
        f0, f1 = (mp.mpf(float(values[i % len(values)])) for i in (k, k + 1))
        slope = (f1 - f0) / gap
        level, rest = f0 + slope * s - gamma, gap - s
        if side == 0:
            course = _flight(level, slope, x, z)
            crossings = [(_first(_gap(course, half, wall), rest), wall) for wall in (1, -1)]
            end, wall = min(((t, wall) for t, wall in crossings if t is not None), default=(None, 0))
            if end is not None:
                onset, v_in, depth = k * gap + s + end, course(end)[1], mp.mpf(0)
                side, x, z, s = wall, mp.mpf(0), abs(v_in), s + end
                continue
        else:
            wall_constants = [x[side > 0] if isinstance(x, tuple) else x for x in (kappa, r)]
            course = _contact(*wall_constants, side * level, side * slope, x, z)
            end = _first(_gap(course), rest)
            depth = max(depth, _deepest(course, rest if end is None else end))
            if end is not None:
                rate = course(end)[1]
                rows.append(Row(onset, side, v_in, side * rate, k * gap + s + end - onset, depth))
                x, z, s, side = side * half, side * rate, s + end, 0
                continue
        x, z = course(rest)
        k, s = k + 1, mp.mpf(0)
    return rows


def _gap(course, half=0, wall=-1):
    """Return a function that falls below 0 at an event: the clearance of a wall, or the penetration."""
    return lambda t: half - wall * course(t)[0]


def _flight(level, slope, u, v):
    return lambda t: (u + t * (v + t * (level / 2 + t * slope / 6)), v + t * (level + t * slope / 2))


def _contact(kappa, r, level, slope, w, z):
    log = mp.log(r)
    zeta = -kappa * log / mp.sqrt(mp.pi**2 + log**2)
    omega = mp.sqrt(kappa**2 - zeta**2)
    tilt = slope / kappa**2
    rise = (level - 2 * zeta * tilt) / kappa**2
    a = w - rise
    b = (z - tilt + zeta * a) / omega

    def course(t):
        decay, c, s = mp.exp(-zeta * t), mp.cos(omega * t), mp.sin(omega * t)
        free = a * c + b * s
        return rise + tilt * t + decay * free, tilt + decay * (omega * (b * c - a * s) - zeta * free)

    return course


def _first(f, rest):
    """Return the first time at which f falls below 0, or None; f may start at 0 and rise first."""
    t = np.concatenate([[1e-7], np.linspace(0, 1, _SCANNED)[1:]])
    below = next((i for i, x in enumerate(t) if f(rest * mp.mpf(x)) < 0), None)
    if below is None:
        return None
    return _bisected(f, rest * mp.mpf(t[below - 1]), rest * mp.mpf(t[below]))


def _deepest(course, rest):
    t = [rest * i / _SCANNED for i in range(_SCANNED + 1)]
    i = max(range(len(t)), key=lambda i: course(t[i])[0])
    if 0 < i < _SCANNED:
        return course(_bisected(lambda t: course(t)[1], t[i - 1], t[i + 1]))[0]
    return course(t[i])[0]


def _bisected(f, low, high):
    for _ in range(4 * DIGITS):
        middle = (low + high) / 2
        low, high = (middle, high) if f(middle) > 0 else (low, middle)
    return low
