"""References of tests and benchmarks: the flow in 50 digits and in long double, a small simulator, stored cases.

Only `march` calls the engine; it runs many starts in one compiled shape.
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

from vijax.impact.exact import exact_step
from vijax.model.pair import ImpactPair
from vijax.model.records import State

DATA = Path(__file__).parents[1] / "tests" / "data"
EPS = float(np.finfo(float).eps)
LONG_PI = np.longdouble("3.14159265358979323846264338327950288")
TILE, STEPS = 64, 16  # the single shape in which the exact engine is compiled
HORIZON = 60.0  # a longer flight counts as a flight without impact
DIGITS = 50


def reference_trajectories() -> list[dict[str, Any]]:
    """Read the 50-digit impact sequences."""
    return json.loads((DATA / "trajectories.json").read_text())["cases"]


class ReferenceOrbit(NamedTuple):
    """A periodic orbit solved in 50 digits: parameters, walls and unknowns of its impacts, and its properties."""

    pair: ImpactPair
    side: tuple[int, ...]
    impact_unknowns: np.ndarray
    depth: np.ndarray
    multipliers: np.ndarray
    P: float


def reference_rows() -> list[dict[str, Any]]:
    """Read the rows of the 50-digit period-1 orbits."""
    return json.loads((DATA / "gradients.json").read_text())["orbits"]


def reference_orbits() -> list[ReferenceOrbit]:
    """Read the 50-digit period-1 orbits."""
    orbits = []
    for row in reference_rows():
        v, t, contact_durations, depth = (
            np.array([float(x) for x in row[name]]) for name in ("v_in", "t_in", "contact", "dmax")
        )
        order = np.argsort(t)
        pair = ImpactPair(*(jnp.asarray(float(row[name])) for name in ("d", "kappa", "r", "gamma")))
        impact_unknowns = np.stack([t, np.abs(v), contact_durations], axis=1)[order]
        multipliers = np.array([complex(*map(float, parts)) for parts in row["multipliers_mp_contact_map"]])
        side = tuple(np.sign(v[order]).astype(int))
        orbits.append(ReferenceOrbit(pair, side, impact_unknowns, depth[order], multipliers, float(row["P_J"])))
    return orbits


# --- the exact engine on many starts -------------------------------------------------------------------------------


class March(NamedTuple):
    """Steps of many starts, leaves [N, STEPS]: the state before each, its outcome, its tangent map [N, STEPS, 2, 2]."""

    before: State
    out: exact_step.ExactResult
    tangent: np.ndarray


@functools.cache
def _program(steps: int):
    def steps_of_start(pair, state):
        def advance(state, _):
            out = exact_step.step(pair, state, jnp.asarray(HORIZON, state.u.dtype), max_stages=2000)
            return out.state, (state, out, exact_step.tangent_map(pair, out))

        return jax.lax.scan(advance, state, None, length=steps)[1]

    # Unlike other programs of tests (see conftest), it runs for longer than it takes to compile.
    return jax.jit(jax.vmap(steps_of_start), compiler_options={"xla_backend_optimization_level": 1})


def march(pair: ImpactPair, state: State, steps: int = STEPS, tile: int = TILE) -> March:
    """Take `steps` steps of every start in tiles, so that all tests share one program per kind of wall."""
    count = np.size(state.u)
    size = -(-count // tile) * tile
    pair, state = jax.tree.map(
        lambda x: np.pad(np.broadcast_to(np.asarray(x), (count,)), (0, size - count), mode="edge"), (pair, state)
    )
    parts = []
    for first in range(0, size, tile):
        tile_part = jax.tree.map(lambda x, first=first: jnp.asarray(x[first : first + tile]), (pair, state))
        parts.append(jax.tree.map(np.asarray, _program(steps)(*tile_part)))
    return March(*jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts))


def start(u, v, t=0.0, mode=0) -> State:
    """Return states from numbers or arrays."""
    arrays: Any = np.broadcast_arrays(u, v, t, mode)
    u, v, t, mode = arrays
    return State(u.astype(float), v.astype(float), t.astype(float), 0 * mode.astype(np.int32), mode.astype(np.int32))


def pairs(d, kappa, r, gamma) -> ImpactPair:
    """Return pairs from numbers or arrays; kappa is None for rigid walls."""
    arrays: Any = np.broadcast_arrays(d, 1.0 if kappa is None else kappa, r, gamma)
    d, frequency, r, gamma = (x.astype(float) for x in arrays)
    return ImpactPair(d, None if kappa is None else frequency, r, gamma)


def random_cells(rng: np.random.Generator, count: int, soft: bool) -> tuple[ImpactPair, State]:
    """Draw pairs over the whole range of the engine, and starts in their gaps."""
    d = np.exp(rng.uniform(np.log(0.005), np.log(2), count))
    kappa = np.exp(rng.uniform(np.log(0.5), np.log(1e5), count))
    r = np.where(rng.random(count) < 0.1, rng.choice([1e-6, 0.01, 0.99], count), rng.uniform(0.05, 0.97, count))
    gamma = rng.choice([0.0, 0.1, 1.0], count) * rng.uniform(-1, 1, count) * rng.choice([1, 1.3], count)
    u = d * rng.uniform(-0.49, 0.49, count)
    v = rng.uniform(-1, 1, count) * np.exp(rng.uniform(np.log(1e-3), np.log(1.0), count))
    return pairs(d, kappa if soft else None, r, gamma), start(u, v, rng.uniform(0, 2, count))


# --- the flow in long double ---------------------------------------------------------------------------------------


def long_flight(gamma, t0, v0, s):
    """Return displacement change and velocity of a flight in long double, by the direct formula."""
    gamma, t0, v0, s = (np.asarray(x, np.longdouble) for x in (gamma, t0, v0, s))
    phase = LONG_PI * (t0 + s)
    sin0, cos0 = np.sin(LONG_PI * t0), np.cos(LONG_PI * t0)
    rise = v0 * s - gamma * s * s / 2 + (cos0 - np.cos(phase) - LONG_PI * s * sin0) / LONG_PI**2
    return rise, v0 - gamma * s + (np.sin(phase) - sin0) / LONG_PI


def long_contact(kappa, r, gamma, side, t, w0, z0, s):
    """Return penetration and its rate a time s after phase t, in long double, by complex exponentials."""
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
    """Return the largest value on an even grid (last axis), refined by parabolas through local maxima."""
    left, middle, right = values[..., :-2], values[..., 1:-1], values[..., 2:]
    bend, tilt = 2 * middle - left - right, right - left
    top = (middle >= left) & (middle >= right) & (bend > 0)
    inner = middle + np.where(top, tilt**2 / (8 * np.where(top, bend, 1)), 0)
    return np.maximum(values.max(axis=-1), inner.max(axis=-1))


def audit_flights(pair: ImpactPair, ran: Any, samples: int = 400) -> np.ndarray:
    """Return the largest violation of the walls in flights before their reported ends, relative to the terms' scale."""
    is_flight = (ran.before.mode == 0) & ~(ran.out.permanent & (ran.out.impact.side == 0))
    index = np.nonzero(is_flight)
    d, gamma = pair.d[index[0]], pair.gamma[index[0]]
    u, v, t = (x[index] for x in (ran.before.u, ran.before.v, ran.before.t))
    duration = np.where(ran.out.no_impact[index], HORIZON, ran.out.flight[index])
    worst = []
    for first in range(0, len(d), 4096):
        part = slice(first, first + 4096)
        s = duration[part, None] * np.linspace(0, 1, samples)
        rise, _ = long_flight(gamma[part, None], t[part, None], v[part, None], s)
        scale = 1 + np.abs(v[part]) * duration[part] + np.abs(gamma[part]) * duration[part] ** 2
        position = u[part, None] + rise
        violation = np.maximum(_peak(position), _peak(-position)) - np.longdouble(d[part]) / 2
        worst.append((violation / scale).astype(float))
    return np.concatenate(worst)


_WIDTHS = (
    256,
    4096,
    65536,
    262144,
)  # samples of a contact: 40 per half cycle of the faster oscillation, up to the last width


def audit_contacts(pair: ImpactPair, ran: Any) -> np.ndarray:
    """Return the largest -w before the reported end of each contact, relative to the scale of w (negative: none).

    w is the sum of the responses to excitation and gravity and of the free oscillation. In a slow short contact they
    nearly cancel, so one rounding of the responses does not count as below zero.
    """
    in_contact = ((ran.out.impact.side != 0) | (ran.before.mode != 0)) & ~np.isnan(ran.out.contact_duration)
    index = np.nonzero(in_contact)
    d, kappa, r, gamma = (np.asarray(x)[index[0]] for x in (pair.d, pair.kappa, pair.r, pair.gamma))
    mode = ran.before.mode[index]
    side = np.where(mode != 0, mode, ran.out.impact.side[index])
    w0 = np.where(mode != 0, side * ran.before.u[index] - d / 2, 0.0)
    z0, t = side * ran.out.impact.v_in[index], ran.out.impact.t[index]
    duration = np.where(np.isfinite(ran.out.contact_duration[index]), ran.out.contact_duration[index], HORIZON)
    # Long after the free oscillation has decayed only the steady response moves, so it has its own grid.
    zeta = -np.log(r) / np.hypot(np.pi, np.log(r)) * kappa
    early = np.minimum(duration, 60 / np.maximum(zeta, 1e-9))
    rounding = EPS * (1 / np.abs(kappa**2 - np.pi**2 + 2j * np.pi * zeta) + np.abs(gamma) / kappa**2)
    need = 40 * np.maximum(np.maximum(kappa, np.pi) * early, np.pi * duration) / np.pi
    worst = np.empty(len(d))
    for low, high in zip((0, *_WIDTHS[:-1]), (*_WIDTHS[:-1], np.inf), strict=True):
        selected = np.nonzero((need >= low) & (need < high))[0]
        width = int(min(high, _WIDTHS[-1]))
        for first in range(0, len(selected), 2**19 // width):
            k = selected[first : first + 2**19 // width]
            grid = np.linspace(0, 1, width)
            spans = (early[k, None] * grid[1:], early[k, None] + (duration - early)[k, None] * grid)
            columns = [x[k, None] for x in (kappa, r, gamma, side, t, w0, z0)]
            both = [long_contact(*[*columns, s])[0] for s in spans]
            scale = np.maximum(*(np.abs(w).max(axis=-1) for w in both))
            violation = np.maximum(*(_peak(-w) for w in both))
            worst[k] = ((violation - rounding[k]) / np.where(scale > 0, scale, 1)).astype(float)
    return worst


# --- impacts that the fast step certifies ----------------------------------------------------------------------------


def after_impacts(rng: np.random.Generator, count: int, slopes) -> tuple[ImpactPair, tuple[np.ndarray, ...]]:
    """Draw balls (u, v, t) that leave a wall: fast and slow, soft and stiff walls, some near zero acceleration."""
    gamma = rng.choice(slopes, count)
    d = np.exp(rng.uniform(np.log(0.01), np.log(2), count))
    kappa = np.exp(rng.uniform(np.log(2), np.log(2e3), count))
    side = rng.choice([-1.0, 1.0], count)
    speed, t = np.exp(rng.uniform(np.log(1e-3), np.log(1.5), count)), rng.uniform(0, 2, count)
    turn = np.arccos(np.clip(gamma, -1, 1)) / np.pi
    turn = np.where(rng.random(count) < 0.5, turn, 2 - turn) + rng.choice([-1, 1], count) * 10 ** rng.uniform(-16, -1)
    t = np.where(rng.random(count) < 0.2, turn % 2, t)
    return pairs(d, kappa, rng.uniform(0.05, 0.97, count), gamma), (0.5 * side * d, -side * speed, t)


def certified_flight_violations(
    pair: ImpactPair, ball: tuple[np.ndarray, ...], arrival, samples: int = 200
) -> np.ndarray:
    """Return the walls' violations in flights before the fast step's certified arrivals; see `audit_flights`."""
    certified = arrival.certified
    u, v, t = (x[certified] for x in ball)
    all_false = np.zeros(u.size, bool)
    before = SimpleNamespace(mode=all_false.astype(int), u=u, v=v, t=t)
    impact = SimpleNamespace(side=arrival.side[certified])
    out = SimpleNamespace(permanent=all_false, no_impact=all_false, flight=arrival.flight[certified], impact=impact)
    return audit_flights(jax.tree.map(lambda x: x[certified], pair), SimpleNamespace(before=before, out=out), samples)


def certified_contact_violations(pair: ImpactPair, hit, certified: np.ndarray) -> np.ndarray:
    """Return the violations of w >= 0 before certified exits of the fast step; see `audit_contacts`."""
    pair, hit = jax.tree.map(lambda x: x[certified], (pair, hit))
    before = SimpleNamespace(mode=np.zeros(hit.side.size, int), u=0 * hit.side)
    impact = SimpleNamespace(side=hit.side, v_in=hit.v_in, t=hit.onset_t)
    return audit_contacts(
        pair, SimpleNamespace(before=before, out=SimpleNamespace(contact_duration=hit.duration, impact=impact))
    )


def fast_and_exact(hit, out) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the results of the fast step and of the exact step for one impact, by name."""
    impact = out.impact
    return {
        "flight": (hit.flight, out.flight),
        "duration": (hit.duration, out.contact_duration),
        "v_in": (hit.v_in, impact.v_in),
        "v_out": (hit.v_out, impact.v_out),
        "depth": (hit.depth, impact.depth),
        "work": (hit.work, impact.work),
        "u": (hit.after.u, out.state.u),
        "v": (hit.after.v, out.state.v),
    }


class Extrema(NamedTuple):
    """Constructed turning points near a wall: exact height beyond it, time until it, and the engine's run."""

    height: np.ndarray
    reach: np.ndarray
    ran: March

    def wrong(self) -> int:
        """Count turning points that the engine placed on the wrong side: hit although before the wall, or missed."""
        length = np.where(
            self.ran.before.mode[:, 0] != 0, self.ran.out.contact_duration[:, 0], self.ran.out.flight[:, 0]
        )
        early = (length <= self.reach * (1 + 1e-9)) & ~self.ran.out.no_impact[:, 0]
        return int(np.sum(early != (self.height > 0)))


def _offsets(rng, count):
    return rng.choice([-1.0, 1.0], count) * 10 ** rng.uniform(-14, -3, count)


def grazing_flights(rng: np.random.Generator, count: int, steps: int = STEPS, tile: int = TILE) -> Extrema:
    """Return flights that turn a given distance before or behind a wall, constructed backwards from the turn."""
    candidates = 8 * count
    d = np.exp(rng.uniform(np.log(0.02), np.log(2), candidates))
    gamma = rng.choice([0.0, 0.3, 1.5], candidates) * rng.uniform(-1, 1, candidates)
    side = rng.choice([-1.0, 1.0], candidates)
    turn, reach = rng.uniform(2, 4, candidates), rng.uniform(0.02, 0.9, candidates)
    grid = turn[:, None] - reach[:, None] * np.linspace(0, 1, 30)
    is_monotone = (side[:, None] * (np.cos(np.pi * grid) - gamma[:, None]) < -0.02).all(axis=1)
    displacement, v = long_flight(gamma, turn, 0.0, -reach)
    height = _offsets(rng, candidates)
    u = side * (d / 2 + height) + displacement.astype(float)
    selected = np.nonzero(is_monotone & (np.abs(u) < 0.49 * d))[0][:count]
    d, gamma, side, turn, reach, u = (x[selected] for x in (d, gamma, side, turn, reach, u))
    t = np.mod(turn - reach, 2)
    v = v[selected].astype(float)
    s = np.longdouble(reach)
    for _ in range(4):  # the rounded start has a slightly different turning point
        travel, speed = long_flight(gamma, t, v, s)
        s = s - speed / (np.cos(LONG_PI * (t + s)) - gamma)
    travel, _ = long_flight(gamma, t, v, s)
    height = (side * (u + travel) - np.longdouble(d) / 2).astype(float)
    ran = march(pairs(d, np.full(d.shape, 40.0), np.full(d.shape, 0.5), gamma), start(u, v, t), steps, tile)
    return Extrema(height, s.astype(float), ran)


def grazing_contacts(rng: np.random.Generator, count: int, steps: int = STEPS, tile: int = TILE) -> Extrema:
    """Return contacts with a minimum of penetration a given distance above or below zero, started inside the wall."""
    candidates = 12 * count
    d = np.exp(rng.uniform(np.log(0.02), np.log(2), candidates))
    kappa = np.exp(rng.uniform(np.log(0.5), np.log(1e3), candidates))
    r, gamma = (
        rng.uniform(0.05, 0.99, candidates),
        rng.choice([0.0, 0.3, 1.5], candidates) * rng.uniform(-1, 1, candidates),
    )
    side, turn = rng.choice([-1.0, 1.0], candidates), rng.uniform(2, 4, candidates)
    height = _offsets(rng, candidates)
    push = side * (np.cos(np.pi * turn) - gamma) + kappa**2 * height
    reach = rng.uniform(0.05, 1.2, candidates) / np.maximum(kappa, np.pi)
    minimum = -height  # minimum of w
    w, z = long_contact(kappa, r, gamma, side, turn, minimum, 0.0, -reach)
    grid = -reach[:, None] * np.linspace(0, 1, 30)[1:]
    columns: Any = [x[:, None] for x in (kappa, r, gamma, side, turn, minimum, 0 * turn)]
    _, falling = long_contact(*[*columns, grid])
    selected = np.nonzero((push > 0.02) & (falling < 0).all(axis=1) & (w > 0) & (w < 1))[0][:count]
    d, kappa, r, gamma, side, turn, reach = (x[selected] for x in (d, kappa, r, gamma, side, turn, reach))
    t, u = np.mod(turn - reach, 2), side * (d / 2 + w[selected].astype(float))
    v = side * z[selected].astype(float)
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
    """Return displacement change and velocity of a flight."""
    sin0, cos0 = mp.sinpi(t0), mp.cospi(t0)
    rise = v0 * s - gamma * s * s / 2 + (cos0 - mp.cospi(t0 + s) - mp.pi * s * sin0) / mp.pi**2
    return rise, v0 - gamma * s + (mp.sinpi(t0 + s) - sin0) / mp.pi


def mp_oscillate(kappa, r, force, w0, z0, s):
    """Return (w, w') of w'' + mu w' + kappa^2 w = c cos(pi s) - q sin(pi s) - g, with force = (c, q, g)."""
    c, q, g = force
    decrement = -mp.log(r)
    scale = kappa / mp.sqrt(mp.pi**2 + decrement**2)
    zeta, omega1 = decrement * scale, mp.pi * scale
    response = mp.mpc(c, q) / mp.mpc(kappa**2 - mp.pi**2, 2 * zeta * mp.pi)
    free = w0 - response.real + g / kappa**2
    rate = (z0 + mp.pi * response.imag + zeta * free) / omega1
    steady = response * mp.mpc(mp.cospi(s), mp.sinpi(s))  # mpmath's findroot requires real intermediate values
    decay, cos, sin = mp.exp(-zeta * s), mp.cos(omega1 * s), mp.sin(omega1 * s)
    w = steady.real - g / kappa**2 + decay * (free * cos + rate * sin)
    return w, -mp.pi * steady.imag + decay * ((omega1 * rate - zeta * free) * cos - (omega1 * free + zeta * rate) * sin)


def mp_contact(kappa, r, gamma, side, t, z0, s, w0=0):
    """Return penetration, its rate and its second derivative a time s after phase t."""
    force = (side * mp.cospi(t), side * mp.sinpi(t), side * gamma)
    w, z = mp_oscillate(kappa, r, force, w0, z0, s)
    mu = -2 * kappa * mp.log(r) / mp.sqrt(mp.pi**2 + mp.log(r) ** 2)
    return w, z, side * (mp.cospi(t + s) - gamma) - mu * z - kappa**2 * w


def newton(function, x, iterations: int = 8):
    """Return the root of a function that returns value and slope, from a guess with a few correct digits."""
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
    """Return the first impacts of a start (d, kappa or None, r, gamma, u0, v0) at t = 0, and guesses of their events.

    Each event is located from a dense scan. kappa and r may be pairs, for the left and the right wall. `guesses` of a
    neighbouring run replace the scans.
    """
    d, stiffness, restitution, gamma, u, v = (_mp_number(x) for x in parameters)
    t, rows, event_guesses = mp.mpf(0), [], []
    for k in range(count):
        flight, duration, deepest = guesses[k] if guesses else (_scan_flight(d, gamma, t, u, v), None, None)
        side = 1 if u + mp_flight(gamma, t, v, flight)[0] > 0 else -1
        kappa, r = (x[side > 0] if isinstance(x, tuple) else x for x in (stiffness, restitution))

        def clearance(s, side=side, t=t, u=u, v=v):
            displacement, speed = mp_flight(gamma, t, v, s)
            return side * (u + displacement) - d / 2, side * speed

        s = newton(clearance, mp.mpf(flight))
        v_in, onset = mp_flight(gamma, t, v, s)[1], t + s
        if kappa is None:
            v_out, depth, contact_duration = -r * v_in, mp.mpf(0), mp.mpf(0)
        else:
            if not guesses:
                duration, deepest = _scan_contact(kappa, r, gamma, side, onset, side * v_in)

            def penetration(s, side=side, onset=onset, v_in=v_in, kappa=kappa, r=r):
                return mp_contact(kappa, r, gamma, side, onset, side * v_in, s)

            contact_duration = newton(lambda s, penetration=penetration: penetration(s)[:2], mp.mpf(duration))
            depth = penetration(newton(lambda s, penetration=penetration: penetration(s)[1:], mp.mpf(deepest)))[0]
            v_out = side * penetration(contact_duration)[1]
        rows.append(Row(onset, side, v_in, v_out, depth, contact_duration))
        event_guesses.append((flight, duration, deepest))
        t, u, v = onset + contact_duration, side * d / 2, v_out
    return rows, event_guesses


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


# --- the exact engine against the references ------------------------------------------------------------------------


CASES = reference_trajectories()
SOFT = [case for case in CASES if not case["case"].get("hard")]
RIGID = [case for case in CASES if case["case"].get("hard")]


def sensitive(case) -> bool:
    """Return True if float64 loses more than a rounding per step: chaos, or slow impacts on a rigid wall."""
    return case["float64_max_err"]["t"] > 1e-14


def compare(cases) -> list[tuple[dict, dict[str, np.ndarray]]]:
    """Return relative errors per impact of the reference sequences."""
    parameters = [[float(case["case"][name]) for case in cases] for name in ("d", "kappa", "r", "gamma")]
    rigid = bool(cases[0]["case"].get("hard"))
    starts = [[float(case[name]) for case in cases] for name in ("u0", "v0", "t0")]
    ran = march(pairs(parameters[0], None if rigid else parameters[1], *parameters[2:]), start(*starts))
    result = []
    for k, case in enumerate(cases):
        reference = case["impacts"]
        count = len(reference)
        impacts = jax.tree.map(lambda x, k=k, count=count: x[k, :count], ran.out.impact)
        assert [int(side) for side in impacts.side] == [row["side"] for row in reference]
        computed = {"t": (impacts.n, impacts.t), "vin": impacts.v_in, "vout": impacts.v_out}
        computed |= {} if rigid else {"tc": impacts.duration, "dmax": impacts.depth}
        errors = {}
        with mp.workdps(DIGITS):
            for name, values in computed.items():
                rows = [mp.mpf(row[name]) for row in reference]
                values = [2 * int(n) + mp.mpf(t) for n, t in zip(*values, strict=True)] if name == "t" else values
                errors[name] = np.array([float(abs(mp.mpf(v) / row - 1)) for v, row in zip(values, rows, strict=True)])
        result.append((case, errors))
    return result


def determinants(pair, ran, steps: int) -> np.ndarray:
    """Return |det - expected|/max(1, |M|^2) of the first steps' monodromy; NaN if a step is no plain impact."""
    plain = ((ran.out.impact.side != 0) & ~ran.out.permanent & ~ran.out.stuck & np.isfinite(ran.out.contact_duration))[
        :, :steps
    ]
    matrix = np.eye(2)
    for k in range(steps):
        matrix = ran.tangent[:, k] @ matrix
    if pair.kappa is None:
        expected = pair.r ** (2 * steps)
    else:
        expected = np.exp(-np.asarray(pair.mu) * ran.out.contact_duration[:, :steps].sum(axis=1))
    matrix = np.where(plain.all(axis=1)[:, None, None], matrix, np.eye(2))
    error = np.abs(np.linalg.det(matrix) - expected) / np.maximum(1, np.linalg.norm(matrix, 2, axis=(1, 2)) ** 2)
    return np.where(plain.all(axis=1), error, np.nan)
