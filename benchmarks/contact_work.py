"""How accurate is the energy transferred to a membrane by an impact under harmonic excitation?

    python benchmarks/contact_work.py               # 256 starts, 8 periods each, all their impacts: four minutes
    python benchmarks/contact_work.py --starts 16

Pairs, starts and harmonics are drawn: d from 0.03 to 10, kappa from 3 to 400, r from 0.05 to 0.99, gamma from -0.5 to
0.5, one to five harmonics. The reference computes each contact in 40 digits from the recorded onset: the exit as a
root, the energy W = mu int w'^2 ds as the integral of the squared sum of exponentials. Printed are the median, the 99 %
quantile and the largest of the relative errors, of `vijax.trajectory` and of the closed form that orbits use.
"""

import argparse
from typing import Any, NamedTuple

import jax
import mpmath as mp
import numpy as np

import vijax
from vijax.impact.forcing import forcing_of
from vijax.model import flow
from vijax.model.forcing.harmonic_work import harmonic_contact_work

DIGITS = 40


class Contact(NamedTuple):
    """A contact as determined by its onset: duration, exit rate, and energy transferred to the membrane."""

    duration: mp.mpf
    rate: mp.mpf
    work: mp.mpf


def contact(kappa: float, r: float, push: list[tuple[int, Any]], level: float, z: float, near: float) -> Contact:
    """Compute a contact in `DIGITS` digits.

    Args:
        kappa, r: Stiffness and restitution of the wall.
        push: Orders k and complex amplitudes a of the harmonics, in the wall's direction: Re sum a exp(i k pi s).
        level: Constant part of the push.
        z: Rate of penetration at the onset.
        near: Approximate duration.
    """
    kappa, log = mp.mpf(kappa), mp.log(mp.mpf(r))
    zeta = -kappa * log / mp.sqrt(mp.pi**2 + log**2)
    mu, omega = 2 * zeta, mp.sqrt(kappa**2 - zeta**2)
    # w = sum of A exp(p s): the forced parts, and two free parts that satisfy the onset's w and w'.
    parts = [(mp.mpc(0), mp.mpc(level) / kappa**2)]
    for order, amplitude in push:
        for p, a in ((mp.mpc(0, order * mp.pi), amplitude), (mp.mpc(0, -order * mp.pi), mp.conj(amplitude))):
            parts.append((p, a / 2 / (p * p + mu * p + kappa**2)))
    free_rate, conjugate_rate = mp.mpc(-zeta, omega), mp.mpc(-zeta, -omega)
    w0, z0 = -sum(a for _, a in parts), z - sum(p * a for p, a in parts)
    parts += [
        (free_rate, (z0 - conjugate_rate * w0) / (free_rate - conjugate_rate)),
        (conjugate_rate, (free_rate * w0 - z0) / (free_rate - conjugate_rate)),
    ]
    end = mp.findroot(lambda s: mp.re(sum(a * mp.exp(p * s) for p, a in parts)), mp.mpf(near))
    rates = [(p, p * a) for p, a in parts if p != 0]
    work = sum(
        a * b * (mp.exp((p + q) * end) - 1) / (p + q) if p + q != 0 else a * b * end for p, a in rates for q, b in rates
    )
    return Contact(end, mp.re(sum(b * mp.exp(p * end) for p, b in rates)), mu * mp.re(work))


def of_impact(pair: Any, excitation: Any, impact: Any) -> Contact:
    """Compute the contact of a recorded impact of one pair in `DIGITS` digits."""
    harmonics, side = forcing_of(excitation), int(impact.side)
    here = pair.at(side)
    with mp.workdps(DIGITS):
        turn = mp.pi * mp.mpf(float(impact.t))
        push = [
            (k, side * mp.mpc(float(c), float(q)) * mp.exp(mp.mpc(0, k * turn)))
            for k, c, q in zip(harmonics.orders, harmonics.cosines, harmonics.sines, strict=True)
        ]
        numbers = (
            float(here.kappa),
            float(here.r),
            push,
            -side * mp.mpf(float(pair.gamma)),
            side * mp.mpf(float(impact.v_in)),
        )
        return contact(*numbers, float(impact.duration))


def drawn(count: int, seed: int = 0) -> list[tuple[Any, tuple[float, float], Any]]:
    """Draw pairs, starts in the gap, and harmonics."""
    draw = np.random.default_rng(seed)
    cases = []
    for _ in range(count):
        d, kappa = (float(np.exp(draw.uniform(*np.log(bounds)))) for bounds in ((0.03, 10.0), (3.0, 400.0)))
        pair = vijax.impact_pair(d, kappa, draw.uniform(0.05, 0.99), draw.uniform(-0.5, 0.5))
        orders = draw.integers(1, 6)
        waves = vijax.Harmonics(draw.uniform(0.1, 1.0, orders), draw.uniform(-np.pi, np.pi, orders))
        cases.append((pair, (draw.uniform(-0.45, 0.45) * d, draw.uniform(-1.0, 1.0)), waves))
    return cases


def errors(case: tuple[Any, tuple[float, float], Any], periods: int) -> np.ndarray:
    """Compute relative errors of the energy of the impacts of a start, [impact, (trajectory, closed form)]."""
    pair, start, waves = case
    run = vijax.trajectory(pair, *start, periods, excitation=waves)
    filled = int(run.filled)
    impacts = jax.tree.map(lambda x: np.asarray(x)[:filled], run.impacts)
    closed = np.asarray(_closed_form(pair, run.impacts, forcing_of(waves)))[:filled]
    rows = (jax.tree.map(lambda x, k=k: x[k], impacts) for k in range(filled))
    exact = [of_impact(pair, waves, row).work for row in rows]
    deviations = [
        [abs(float(work / exact_work - 1)) for exact_work, work in zip(exact, computed, strict=True)]
        for computed in (impacts.work, closed)
    ]
    return np.array(deviations).T.reshape(-1, 2)


@jax.jit
def _closed_form(pair: Any, impacts: Any, shaking: Any) -> Any:
    """Compute the energy transferred to the membrane at each impact by the closed form that orbits use."""
    side = impacts.side.astype(float)
    m, onset = flow.membrane(pair.at(side)), shaking.waves(impacts.t)
    return harmonic_contact_work(
        m, onset, pair.gamma, side, impacts.duration, (side * impacts.v_in, side * impacts.v_out)
    )


def main() -> None:
    """Print the errors."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--starts", type=int, default=256)
    parser.add_argument("--periods", type=int, default=8)
    options = parser.parse_args()
    deviations = np.concatenate([errors(case, options.periods) for case in drawn(options.starts)])
    print(
        f"{len(deviations):,} impacts of {options.starts:,} starts: relative error of the energy given to the membrane"
    )
    for name, column in zip(("trajectory", "closed form of orbits"), deviations.T, strict=True):
        figures = np.median(column), np.quantile(column, 0.99), column.max()
        print(f"{name:22} median {figures[0]:.1e}, 99 % {figures[1]:.1e}, largest {figures[2]:.1e}")


if __name__ == "__main__":
    main()
