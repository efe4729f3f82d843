"""What tests and benchmarks measure against: the flow in 40 digits, in long double, a small simulator, stored cases.

Nothing here calls the engine but `march`, which runs many starts in one compiled shape.
"""

import functools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

from vijax.engine import exact
from vijax.model.pair import ImpactPair
from vijax.model.records import State

DATA = Path(__file__).parents[1] / "tests" / "data"
EPS = float(np.finfo(float).eps)
LONG_PI = np.longdouble("3.14159265358979323846264338327950288")
TILE, STEPS = 64, 16  # the one shape in which the exact engine is compiled
HORIZON = 60.0  # a flight longer than that is quiet
DIGITS = 50


def reference_trajectories() -> list[dict[str, Any]]:
    """Read the 50-digit impact sequences."""
    return json.loads((DATA / "trajectories.json").read_text())["cases"]


class ReferenceOrbit(NamedTuple):
    """A periodic orbit solved in 50 digits: parameters, walls and knots of its impacts, what else is known."""

    pair: ImpactPair
    side: tuple[int, ...]
    knots: np.ndarray
    depth: np.ndarray
    multipliers: np.ndarray
    P: float


def reference_rows() -> list[dict[str, Any]]:
    """Read the 50-digit period-1 orbits as they are written down."""
    return json.loads((DATA / "gradients.json").read_text())["orbits"]


def reference_orbits() -> list[ReferenceOrbit]:
    """Read the 50-digit period-1 orbits."""
    found = []
    for row in reference_rows():
        v, t, stay, depth = (np.array([float(x) for x in row[name]]) for name in ("v_in", "t_in", "contact", "dmax"))
        order = np.argsort(t)
        pair = ImpactPair(*(jnp.asarray(float(row[name])) for name in ("d", "kappa", "r", "gamma")))
        knots = np.stack([t, np.abs(v), stay], axis=1)[order]
        multipliers = np.array([complex(*map(float, parts)) for parts in row["multipliers_mp_contact_map"]])
        side = tuple(np.sign(v[order]).astype(int))
        found.append(ReferenceOrbit(pair, side, knots, depth[order], multipliers, float(row["P_J"])))
    return found


# --- the exact engine on many starts -------------------------------------------------------------------------------


class March(NamedTuple):
    """Steps of many starts, leaves [N, STEPS]: the state before each, its outcome, its tangent map [N, STEPS, 2, 2]."""

    before: State
    out: exact.Outcome
    tangent: np.ndarray


@functools.cache
def _program(steps: int):
    def one(pair, state):
        def advance(state, _):
            out = exact.step(pair, state, jnp.asarray(HORIZON, state.u.dtype), patience=2000)
            return out.state, (state, out, exact.tangent(pair, out))

        return jax.lax.scan(advance, state, None, length=steps)[1]

    # Unlike other programs of tests (see conftest) it runs for longer than it takes to compile.
    return jax.jit(jax.vmap(one), compiler_options={"xla_backend_optimization_level": 1})


def march(pair: ImpactPair, state: State, steps: int = STEPS, tile: int = TILE) -> March:
    """Take `steps` steps of every start, tile by tile, so that all tests share one program per kind of wall."""
    count = np.size(state.u)
    size = -(-count // tile) * tile
    pair, state = jax.tree.map(
        lambda x: np.pad(np.broadcast_to(np.asarray(x), (count,)), (0, size - count), mode="edge"), (pair, state)
    )
    parts = []
    for first in range(0, size, tile):
        cut = jax.tree.map(lambda x, first=first: jnp.asarray(x[first : first + tile]), (pair, state))
        parts.append(jax.tree.map(np.asarray, _program(steps)(*cut)))
    return March(*jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts))


def start(u, v, t=0.0, mode=0) -> State:
    """Make states from numbers or arrays."""
    given: Any = np.broadcast_arrays(u, v, t, mode)
    u, v, t, mode = given
    return State(u.astype(float), v.astype(float), t.astype(float), 0 * mode.astype(np.int32), mode.astype(np.int32))


def pairs(d, kappa, r, gamma) -> ImpactPair:
    """Make pairs from numbers or arrays, kappa None for rigid walls."""
    given: Any = np.broadcast_arrays(d, 1.0 if kappa is None else kappa, r, gamma)
    d, frequency, r, gamma = (x.astype(float) for x in given)
    return ImpactPair(d, None if kappa is None else frequency, r, gamma)


def random_cells(rng: np.random.Generator, count: int, soft: bool) -> tuple[ImpactPair, State]:
    """Draw pairs over the whole range of the engine and starts in their gaps."""
    d = np.exp(rng.uniform(np.log(0.005), np.log(2), count))
    kappa = np.exp(rng.uniform(np.log(0.5), np.log(1e5), count))
    r = np.where(rng.random(count) < 0.1, rng.choice([1e-6, 0.01, 0.99], count), rng.uniform(0.05, 0.97, count))
    gamma = rng.choice([0.0, 0.1, 1.0], count) * rng.uniform(-1, 1, count) * rng.choice([1, 1.3], count)
    u = d * rng.uniform(-0.49, 0.49, count)
    v = rng.uniform(-1, 1, count) * np.exp(rng.uniform(np.log(1e-3), np.log(1.0), count))
    return pairs(d, kappa if soft else None, r, gamma), start(u, v, rng.uniform(0, 2, count))


# --- the flow in long double ---------------------------------------------------------------------------------------


def long_flight(gamma, t0, v0, s):
    """Compute rise and velocity of a flight in long double, by the plain formula."""
    gamma, t0, v0, s = (np.asarray(x, np.longdouble) for x in (gamma, t0, v0, s))
    phase = LONG_PI * (t0 + s)
    sin0, cos0 = np.sin(LONG_PI * t0), np.cos(LONG_PI * t0)
    rise = v0 * s - gamma * s * s / 2 + (cos0 - np.cos(phase) - LONG_PI * s * sin0) / LONG_PI**2
    return rise, v0 - gamma * s + (np.sin(phase) - sin0) / LONG_PI


def long_contact(kappa, r, gamma, side, t, w0, z0, s):
    """Compute penetration and its rate a time s after phase t, in long double, by complex exponentials."""
    kappa, r, gamma, side, t, w0, z0, s = (np.asarray(x, np.longdouble) for x in (kappa, r, gamma, side, t, w0, z0, s))
    decrement = -np.log(r)
    scale = kappa / np.sqrt(LONG_PI**2 + decrement**2)
    zeta, omega1 = decrement * scale, LONG_PI * scale
    response = side * np.exp(1j * LONG_PI * t) / (kappa**2 - LONG_PI**2 + 2j * zeta * LONG_PI)
    rest = side * gamma / kappa**2
    free = w0 - response.real + rest
    rate = (z0 + LONG_PI * response.imag + zeta * free) / omega1
    steady = response * np.exp(1j * LONG_PI * s)
    decay, cos, sin = np.exp(-zeta * s), np.cos(omega1 * s), np.sin(omega1 * s)
    w = steady.real - rest + decay * (free * cos + rate * sin)
    z = -LONG_PI * steady.imag + decay * ((omega1 * rate - zeta * free) * cos - (omega1 * free + zeta * rate) * sin)
    return w, z


def _peak(values: np.ndarray) -> np.ndarray:
    """Find the largest value on an even grid (last axis), by a parabola through samples that top their neighbours."""
    left, middle, right = values[..., :-2], values[..., 1:-1], values[..., 2:]
    bend, tilt = 2 * middle - left - right, right - left
    top = (middle >= left) & (middle >= right) & (bend > 0)
    inner = middle + np.where(top, tilt**2 / (8 * np.where(top, bend, 1)), 0)
    return np.maximum(values.max(axis=-1), inner.max(axis=-1))


def audit_flights(pair: ImpactPair, ran: Any, samples: int = 400) -> np.ndarray:
    """Find how far flights were beyond a wall before their reported ends (negative: never), over their terms' scale."""
    flew = (ran.before.mode == 0) & ~(ran.out.permanent & (ran.out.impact.side == 0))
    index = np.nonzero(flew)
    d, gamma = pair.d[index[0]], pair.gamma[index[0]]
    u, v, t = (x[index] for x in (ran.before.u, ran.before.v, ran.before.t))
    length = np.where(ran.out.quiet[index], HORIZON, ran.out.flight[index])
    worst = []
    for low in range(0, len(d), 4096):
        cut = slice(low, low + 4096)
        s = length[cut, None] * np.linspace(0, 1, samples)
        rise, _ = long_flight(gamma[cut, None], t[cut, None], v[cut, None], s)
        scale = 1 + np.abs(v[cut]) * length[cut] + np.abs(gamma[cut]) * length[cut] ** 2
        place = u[cut, None] + rise
        beyond = np.maximum(_peak(place), _peak(-place)) - np.longdouble(d[cut]) / 2
        worst.append((beyond / scale).astype(float))
    return np.concatenate(worst)


_WIDTHS = (
    256,
    4096,
    65536,
    262144,
)  # samples of a contact: 40 a half cycle of the faster oscillation, as far as that goes


def audit_contacts(pair: ImpactPair, ran: Any) -> np.ndarray:
    """Find how far w was below zero before the reported end of each contact, over the scale of w (negative: never).

    It is a sum of the response to the shaking, of that to gravity, and of the swing. In a slow short contact they all
    but cancel: one rounding of the responses is no way below zero.
    """
    held = ((ran.out.impact.side != 0) | (ran.before.mode != 0)) & ~np.isnan(ran.out.stay)
    index = np.nonzero(held)
    d, kappa, r, gamma = (np.asarray(x)[index[0]] for x in (pair.d, pair.kappa, pair.r, pair.gamma))
    mode = ran.before.mode[index]
    side = np.where(mode != 0, mode, ran.out.impact.side[index])
    w0 = np.where(mode != 0, side * ran.before.u[index] - d / 2, 0.0)
    z0, t = side * ran.out.impact.v_in[index], ran.out.impact.t[index]
    length = np.where(np.isfinite(ran.out.stay[index]), ran.out.stay[index], HORIZON)
    # Long after the oscillation has decayed only the steady response moves: a grid of its own.
    zeta = -np.log(r) / np.hypot(np.pi, np.log(r)) * kappa
    early = np.minimum(length, 60 / np.maximum(zeta, 1e-9))
    rounding = EPS * (1 / np.abs(kappa**2 - np.pi**2 + 2j * np.pi * zeta) + np.abs(gamma) / kappa**2)
    need = 40 * np.maximum(np.maximum(kappa, np.pi) * early, np.pi * length) / np.pi
    worst = np.empty(len(d))
    for low, high in zip((0, *_WIDTHS[:-1]), (*_WIDTHS[:-1], np.inf), strict=True):
        chosen = np.nonzero((need >= low) & (need < high))[0]
        width = int(min(high, _WIDTHS[-1]))
        for first in range(0, len(chosen), 2**19 // width):
            k = chosen[first : first + 2**19 // width]
            grid = np.linspace(0, 1, width)
            spans = (early[k, None] * grid[1:], early[k, None] + (length - early)[k, None] * grid)
            columns = [x[k, None] for x in (kappa, r, gamma, side, t, w0, z0)]
            both = [long_contact(*[*columns, s])[0] for s in spans]
            scale = np.maximum(*(np.abs(w).max(axis=-1) for w in both))
            below = np.maximum(*(_peak(-w) for w in both))
            worst[k] = ((below - rounding[k]) / np.where(scale > 0, scale, 1)).astype(float)
    return worst


# --- what the quick step is sure of ---------------------------------------------------------------------------------


def after_impacts(rng: np.random.Generator, count: int, slopes) -> tuple[ImpactPair, tuple[np.ndarray, ...]]:
    """Draw balls (u, v, t) that leave a wall: fast and slow, soft walls and stiff, some as the acceleration turns."""
    gamma = rng.choice(slopes, count)
    d = np.exp(rng.uniform(np.log(0.01), np.log(2), count))
    kappa = np.exp(rng.uniform(np.log(2), np.log(2e3), count))
    side = rng.choice([-1.0, 1.0], count)
    speed, t = np.exp(rng.uniform(np.log(1e-3), np.log(1.5), count)), rng.uniform(0, 2, count)
    turn = np.arccos(np.clip(gamma, -1, 1)) / np.pi
    turn = np.where(rng.random(count) < 0.5, turn, 2 - turn) + rng.choice([-1, 1], count) * 10 ** rng.uniform(-16, -1)
    t = np.where(rng.random(count) < 0.2, turn % 2, t)
    return pairs(d, kappa, rng.uniform(0.05, 0.97, count), gamma), (0.5 * side * d, -side * speed, t)


def beyond_sure_flights(pair: ImpactPair, ball: tuple[np.ndarray, ...], arrival, samples: int = 200) -> np.ndarray:
    """Find how far beyond a wall flights were before the arrivals that the quick step was sure of; `audit_flights`."""
    sure = arrival.sure
    u, v, t = (x[sure] for x in ball)
    none = np.zeros(u.size, bool)
    before = SimpleNamespace(mode=none.astype(int), u=u, v=v, t=t)
    impact = SimpleNamespace(side=arrival.side[sure])
    out = SimpleNamespace(permanent=none, quiet=none, flight=arrival.flight[sure], impact=impact)
    return audit_flights(jax.tree.map(lambda x: x[sure], pair), SimpleNamespace(before=before, out=out), samples)


def below_sure_contacts(pair: ImpactPair, hit, sure: np.ndarray) -> np.ndarray:
    """Find how far below zero w was before the exits that the quick step was sure of; `audit_contacts`."""
    pair, hit = jax.tree.map(lambda x: x[sure], (pair, hit))
    before = SimpleNamespace(mode=np.zeros(hit.side.size, int), u=0 * hit.side)
    impact = SimpleNamespace(side=hit.side, v_in=hit.v_in, t=hit.onset_t)
    return audit_contacts(pair, SimpleNamespace(before=before, out=SimpleNamespace(stay=hit.duration, impact=impact)))


def both_ways(hit, out) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name what a fast step found of an impact, and what the careful step did."""
    impact = out.impact
    return {
        "flight": (hit.flight, out.flight),
        "duration": (hit.duration, out.stay),
        "v_in": (hit.v_in, impact.v_in),
        "v_out": (hit.v_out, impact.v_out),
        "depth": (hit.depth, impact.depth),
        "work": (hit.work, impact.work),
        "u": (hit.after.u, out.state.u),
        "v": (hit.after.v, out.state.v),
    }


class Extrema(NamedTuple):
    """Constructed turning points close to a wall: true height beyond it, time to it, and the run of the engine."""

    height: np.ndarray
    reach: np.ndarray
    ran: March

    def wrong(self) -> int:
        """Count turning points that the engine put on the wrong side: hit where it turns before the wall, or missed."""
        length = np.where(self.ran.before.mode[:, 0] != 0, self.ran.out.stay[:, 0], self.ran.out.flight[:, 0])
        early = (length <= self.reach * (1 + 1e-9)) & ~self.ran.out.quiet[:, 0]
        return int(np.sum(early != (self.height > 0)))


def _offsets(rng, count):
    return rng.choice([-1.0, 1.0], count) * 10 ** rng.uniform(-14, -3, count)


def grazing_flights(rng: np.random.Generator, count: int, steps: int = STEPS, tile: int = TILE) -> Extrema:
    """Make flights that turn a given distance before or behind a wall, built backwards from the turning point."""
    many = 8 * count
    d = np.exp(rng.uniform(np.log(0.02), np.log(2), many))
    gamma = rng.choice([0.0, 0.3, 1.5], many) * rng.uniform(-1, 1, many)
    side = rng.choice([-1.0, 1.0], many)
    turn, reach = rng.uniform(2, 4, many), rng.uniform(0.02, 0.9, many)
    grid = turn[:, None] - reach[:, None] * np.linspace(0, 1, 30)
    pushed = (side[:, None] * (np.cos(np.pi * grid) - gamma[:, None]) < -0.02).all(axis=1)
    back, v = long_flight(gamma, turn, 0.0, -reach)
    height = _offsets(rng, many)
    u = side * (d / 2 + height) + back.astype(float)
    good = np.nonzero(pushed & (np.abs(u) < 0.49 * d))[0][:count]
    d, gamma, side, turn, reach, u = (x[good] for x in (d, gamma, side, turn, reach, u))
    t = np.mod(turn - reach, 2)
    v = v[good].astype(float)
    s = np.longdouble(reach)
    for _ in range(4):  # the start was rounded: where does it turn?
        rise, speed = long_flight(gamma, t, v, s)
        s = s - speed / (np.cos(LONG_PI * (t + s)) - gamma)
    rise, _ = long_flight(gamma, t, v, s)
    height = (side * (u + rise) - np.longdouble(d) / 2).astype(float)
    ran = march(pairs(d, np.full(d.shape, 40.0), np.full(d.shape, 0.5), gamma), start(u, v, t), steps, tile)
    return Extrema(height, s.astype(float), ran)


def grazing_contacts(rng: np.random.Generator, count: int, steps: int = STEPS, tile: int = TILE) -> Extrema:
    """Make contacts whose penetration is least a given distance above or below zero, started inside the wall."""
    many = 12 * count
    d = np.exp(rng.uniform(np.log(0.02), np.log(2), many))
    kappa = np.exp(rng.uniform(np.log(0.5), np.log(1e3), many))
    r, gamma = rng.uniform(0.05, 0.99, many), rng.choice([0.0, 0.3, 1.5], many) * rng.uniform(-1, 1, many)
    side, turn = rng.choice([-1.0, 1.0], many), rng.uniform(2, 4, many)
    height = _offsets(rng, many)
    push = side * (np.cos(np.pi * turn) - gamma) + kappa**2 * height
    reach = rng.uniform(0.05, 1.2, many) / np.maximum(kappa, np.pi)
    least = -height  # of w
    w, z = long_contact(kappa, r, gamma, side, turn, least, 0.0, -reach)
    grid = -reach[:, None] * np.linspace(0, 1, 30)[1:]
    columns: Any = [x[:, None] for x in (kappa, r, gamma, side, turn, least, 0 * turn)]
    _, falling = long_contact(*[*columns, grid])
    good = np.nonzero((push > 0.02) & (falling < 0).all(axis=1) & (w > 0) & (w < 1))[0][:count]
    d, kappa, r, gamma, side, turn, reach = (x[good] for x in (d, kappa, r, gamma, side, turn, reach))
    t, u = np.mod(turn - reach, 2), side * (d / 2 + w[good].astype(float))
    v = side * z[good].astype(float)
    w0, s = side * np.longdouble(u) - np.longdouble(d) / 2, np.longdouble(reach)
    zeta = -np.log(r) / np.hypot(np.pi, np.log(r)) * kappa
    for _ in range(4):
        w, z = long_contact(kappa, r, gamma, side, t, w0, side * v, s)
        s = s - z / (side * (np.cos(LONG_PI * (t + s)) - gamma) - 2 * zeta * z - kappa**2 * w)
    w, _ = long_contact(kappa, r, gamma, side, t, w0, side * v, s)
    ran = march(pairs(d, kappa, r, gamma), start(u, v, t, side), steps, tile)
    return Extrema(-w.astype(float), s.astype(float), ran)


# --- the flow and a small event simulator in 50 digits -------------------------------------------------------------


def mp_flight(gamma, t0, v0, s):
    """Compute rise and velocity of a flight."""
    sin0, cos0 = mp.sinpi(t0), mp.cospi(t0)
    rise = v0 * s - gamma * s * s / 2 + (cos0 - mp.cospi(t0 + s) - mp.pi * s * sin0) / mp.pi**2
    return rise, v0 - gamma * s + (mp.sinpi(t0 + s) - sin0) / mp.pi


def mp_oscillate(kappa, r, force, w0, z0, s):
    """Compute (w, w') of w'' + mu w' + kappa^2 w = c cos(pi s) - q sin(pi s) - g, force = (c, q, g)."""
    c, q, g = force
    decrement = -mp.log(r)
    scale = kappa / mp.sqrt(mp.pi**2 + decrement**2)
    zeta, omega1 = decrement * scale, mp.pi * scale
    response = mp.mpc(c, q) / mp.mpc(kappa**2 - mp.pi**2, 2 * zeta * mp.pi)
    free = w0 - response.real + g / kappa**2
    rate = (z0 + mp.pi * response.imag + zeta * free) / omega1
    steady = response * mp.mpc(mp.cospi(s), mp.sinpi(s))  # findroot lets no function of a real number be complex
    decay, cos, sin = mp.exp(-zeta * s), mp.cos(omega1 * s), mp.sin(omega1 * s)
    w = steady.real - g / kappa**2 + decay * (free * cos + rate * sin)
    return w, -mp.pi * steady.imag + decay * ((omega1 * rate - zeta * free) * cos - (omega1 * free + zeta * rate) * sin)


def mp_contact(kappa, r, gamma, side, t, z0, s, w0=0):
    """Compute penetration, its rate and its second derivative a time s after phase t."""
    force = (side * mp.cospi(t), side * mp.sinpi(t), side * gamma)
    w, z = mp_oscillate(kappa, r, force, w0, z0, s)
    mu = -2 * kappa * mp.log(r) / mp.sqrt(mp.pi**2 + mp.log(r) ** 2)
    return w, z, side * (mp.cospi(t + s) - gamma) - mu * z - kappa**2 * w


def newton(function, x, iterations: int = 8):
    """Find the root of a function that returns value and slope, from a guess good to a few digits."""
    for _ in range(iterations):
        value, slope = function(x)
        x = x - value / slope
    return x


class Row(NamedTuple):
    """One impact: absolute onset time, side, speeds, depth and duration."""

    t: Any
    side: int
    v_in: Any
    v_out: Any
    depth: Any
    duration: Any


def mp_march(parameters, count: int, guesses: list | None = None) -> tuple[list[Row], list]:
    """Find the first impacts of a start (d, kappa or None, r, gamma, u0, v0) at t = 0, each event from a dense scan.

    kappa and r may be two, of the left wall and of the right one. `guesses` of a run nearby replace the scans.
    """
    d, stiffness, restitution, gamma, u, v = (_mp_number(x) for x in parameters)
    t, rows, found = mp.mpf(0), [], []
    for k in range(count):
        flight, duration, deepest = guesses[k] if guesses else (_scan_flight(d, gamma, t, u, v), None, None)
        side = 1 if u + mp_flight(gamma, t, v, flight)[0] > 0 else -1
        kappa, r = (x[side > 0] if isinstance(x, tuple) else x for x in (stiffness, restitution))

        def gap(s, side=side, t=t, u=u, v=v):
            rise, speed = mp_flight(gamma, t, v, s)
            return side * (u + rise) - d / 2, side * speed

        s = newton(gap, mp.mpf(flight))
        v_in, onset = mp_flight(gamma, t, v, s)[1], t + s
        if kappa is None:
            v_out, depth, stay = -r * v_in, mp.mpf(0), mp.mpf(0)
        else:
            if not guesses:
                duration, deepest = _scan_contact(kappa, r, gamma, side, onset, side * v_in)

            def course(s, side=side, onset=onset, v_in=v_in, kappa=kappa, r=r):
                return mp_contact(kappa, r, gamma, side, onset, side * v_in, s)

            stay = newton(lambda s, course=course: course(s)[:2], mp.mpf(duration))
            depth = course(newton(lambda s, course=course: course(s)[1:], mp.mpf(deepest)))[0]
            v_out = side * course(stay)[1]
        rows.append(Row(onset, side, v_in, v_out, depth, stay))
        found.append((flight, duration, deepest))
        t, u, v = onset + stay, side * d / 2, v_out
    return rows, found


def _mp_number(x: Any) -> Any:
    if isinstance(x, tuple):
        return tuple(map(_mp_number, x))
    return x if x is None else mp.mpf(x)


def _scan_flight(d, gamma, t, u, v) -> float:
    s = np.linspace(0, 6, 60001)[1:]
    rise, _ = long_flight(float(gamma), float(mp.fmod(t, 2)), float(v), s)
    return float(s[np.argmax(np.abs(float(u) + rise) > float(d) / 2)])


def _scan_contact(kappa, r, gamma, side, t, z0) -> tuple[float, float]:
    s = np.linspace(0, 8 * np.pi / min(float(kappa), np.pi), 200001)[1:]
    w, _ = long_contact(float(kappa), float(r), float(gamma), side, float(mp.fmod(t, 2)), 0.0, float(z0), s)
    end = int(np.argmax(w < 0))
    return float(s[end]), float(s[np.argmax(w[:end])])


# --- the exact engine against them ------------------------------------------------------------------


CASES = reference_trajectories()
SOFT = [case for case in CASES if not case["case"].get("hard")]
RIGID = [case for case in CASES if case["case"].get("hard")]


def sensitive(case) -> bool:
    """Say whether float64 loses more than a rounding a step on it: chaotic, or the rigid wall's slow impacts."""
    return case["float64_max_err"]["t"] > 1e-14


def compare(cases) -> list[tuple[dict, dict[str, np.ndarray]]]:
    """Compute relative errors per impact of the reference sequences."""
    given = [[float(case["case"][name]) for case in cases] for name in ("d", "kappa", "r", "gamma")]
    rigid = bool(cases[0]["case"].get("hard"))
    begin = [[float(case[name]) for case in cases] for name in ("u0", "v0", "t0")]
    ran = march(pairs(given[0], None if rigid else given[1], *given[2:]), start(*begin))
    result = []
    for k, case in enumerate(cases):
        truth = case["impacts"]
        count = len(truth)
        hit = jax.tree.map(lambda x, k=k, count=count: x[k, :count], ran.out.impact)
        assert [int(side) for side in hit.side] == [row["side"] for row in truth]
        got = {"t": (hit.n, hit.t), "vin": hit.v_in, "vout": hit.v_out}
        got |= {} if rigid else {"tc": hit.duration, "dmax": hit.depth}
        errors = {}
        with mp.workdps(DIGITS):
            for name, values in got.items():
                rows = [mp.mpf(row[name]) for row in truth]
                values = [2 * int(n) + mp.mpf(t) for n, t in zip(*values, strict=True)] if name == "t" else values
                errors[name] = np.array([float(abs(mp.mpf(v) / row - 1)) for v, row in zip(values, rows, strict=True)])
        result.append((case, errors))
    return result


def determinants(pair, ran, steps: int) -> np.ndarray:
    """Compute |det - expected|/max(1, |M|^2) of the first steps' monodromy, NaN where a step was no plain impact."""
    plain = ((ran.out.impact.side != 0) & ~ran.out.permanent & ~ran.out.stuck & np.isfinite(ran.out.stay))[:, :steps]
    matrix = np.eye(2)
    for k in range(steps):
        matrix = ran.tangent[:, k] @ matrix
    if pair.kappa is None:
        expected = pair.r ** (2 * steps)
    else:
        expected = np.exp(-np.asarray(pair.mu) * ran.out.stay[:, :steps].sum(axis=1))
    matrix = np.where(plain.all(axis=1)[:, None, None], matrix, np.eye(2))
    error = np.abs(np.linalg.det(matrix) - expected) / np.maximum(1, np.linalg.norm(matrix, 2, axis=(1, 2)) ** 2)
    return np.where(plain.all(axis=1), error, np.nan)
