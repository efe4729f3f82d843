"""Mirror symmetry of periodic orbits: conversion between full orbits and orbits stored as half a period.

A symmetric orbit is its own mirror image after half a period, so that half a period describes it. An orbit stored in
this way is called closed half way: it ends at the mirror image of its start. The mirror is (u, t, gamma) -> (-u, t + 1,
-gamma). At gamma = 0 and with equal walls an orbit is symmetric, or its mirror image is a second orbit.
"""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool

from vijax.orbits.periodic import Orbit, check_orbit, make_guess, solve_validated, verify_solutions
from vijax.orbits.shooting import Sequence
from vijax.runtime import validation
from vijax.runtime.public_api import public_api


@public_api
def is_symmetric(orbit: Orbit, tolerance: float = 1e-9) -> Bool[np.ndarray, " orbit"]:
    """Return True for each orbit that equals its mirror image after half a period, within a tolerance."""
    host, tolerance = jax.tree.map(np.asarray, check_orbit(orbit)), validation.validate_positive("tolerance", tolerance)
    count = host.count
    index = np.arange(host.impact_unknowns.shape[1])
    # Compare each impact of the first half of the orbit with its counterpart in the second half, on the opposite wall.
    half = np.where(index < (count // 2)[:, None], index + (count // 2)[:, None], index)
    delay = np.array([0.5, 0.0, 0.0]) * host.sequence.span[:, None, None]
    moved = np.take_along_axis(host.impact_unknowns, half[..., None], axis=1) - host.impact_unknowns - delay
    opposite = np.take_along_axis(host.sequence.side, half, axis=1) == -host.sequence.side
    is_first_half = index < (count // 2)[:, None]
    is_same = (np.abs(moved).max(axis=2) < tolerance) & opposite
    return host.sequence.mirrored | ((count % 2 == 0) & host.pair.symmetric & (is_same | ~is_first_half).all(axis=1))


@public_api
def close_half_way(orbit: Orbit, tolerance: float = 1e-9) -> Orbit:
    """Convert symmetric orbits to half a period each; the other half is the mirror image.

    The returned orbits have half the impacts, and a pitchfork of the full orbit is a flip of the half.

    Args:
        orbit: Orbits.
        tolerance: Largest difference of an orbit from its mirror image. The halves are solved again, so that the
            returned orbits are symmetric to rounding.

    Raises:
        ValueError: If an orbit is not symmetric.
    """
    good = is_symmetric(orbit, tolerance)
    if not good.all():
        index = int(np.argmin(good))
        raise ValueError(f"orbit must be symmetric to be closed half way; got one that is not at index {index}")
    if bool(orbit.sequence.mirrored.all()):
        return orbit
    half = jax.tree.map(np.asarray, first_half(orbit))
    return solve_validated(
        half.pair, *make_guess(half.sequence.side, half.sequence.span, half.sequence.mirrored, half.impact_unknowns)
    )


def first_half(orbit: Orbit) -> Orbit:
    """Return the first half of orbits without solving the equations again; `close_half_way` solves them.

    If an orbit is symmetric, its first half and the mirror image of this half are the whole orbit.
    """
    if bool(orbit.sequence.mirrored.all()):
        return orbit
    host = jax.tree.map(np.asarray, orbit)
    is_first_half = np.arange(host.impact_unknowns.shape[1]) < (host.count // 2)[:, None]
    # The first half of the impacts needs half of the width.
    width = host.impact_unknowns.shape[1] // 2
    side = np.where(is_first_half, host.sequence.side, 0)[:, :width]
    impact_unknowns = np.where(is_first_half[..., None], host.impact_unknowns, 0.0)[:, :width]
    fields: Any = side, 0.5 * host.sequence.span, np.ones(len(orbit), bool)
    return replace(
        host,
        sequence=Sequence(*fields),
        impact_unknowns=impact_unknowns,
        depth=host.depth[:, :width],
        work=host.work[:, :width],
    )


@public_api
def double(orbit: Orbit) -> Orbit:
    """Return each orbit repeated twice; if only half of a symmetric orbit is stored, return the full orbit."""
    return _unfolded(check_orbit(orbit), np.ones(len(orbit), bool))


@public_api
def unfold(orbit: Orbit) -> Orbit:
    """Return full orbits: if only half of a symmetric orbit is stored, append the mirror image."""
    mirrored = np.asarray(check_orbit(orbit).sequence.mirrored)
    return _unfolded(orbit, mirrored) if mirrored.any() else orbit


def _unfolded(orbit: Orbit, twice: Bool[np.ndarray, " orbit"]) -> Orbit:
    """Append a second repetition to the orbits where `twice` is True."""
    host = jax.tree.map(np.asarray, orbit)
    count, width = host.count[:, None], host.impact_unknowns.shape[1]
    index = np.arange(int((host.count * (1 + twice)).max(initial=1)))
    again = index >= count
    source = np.where(again, index - count, index)
    exists = (index < count) | (twice[:, None] & again & (index < 2 * count))
    source = np.clip(source, 0, width - 1)
    side = np.take_along_axis(host.sequence.side, source, axis=1)
    # If only half of a symmetric orbit is stored, the second half is the mirror image of the first.
    side = np.where(again & host.sequence.mirrored[:, None], -side, side)
    impact_unknowns = np.take_along_axis(host.impact_unknowns, source[..., None], axis=1)
    impact_unknowns[..., 0] += np.where(again, host.sequence.span[:, None], 0.0)
    span = np.where(twice, 2 * host.sequence.span, host.sequence.span)
    mirrored, impact_unknowns = host.sequence.mirrored & ~twice, np.where(exists[..., None], impact_unknowns, 0.0)
    # The unknowns solve the equations already; verification fills in depth, work and multipliers.
    return verify_solutions(host.pair, *make_guess(np.where(exists, side, 0), span, mirrored, impact_unknowns))
