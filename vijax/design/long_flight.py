"""The proof of a design whose motion is no orbit: many balls flown for long at exactly its values.

Where they break a limit, or end on different motions, the design moves a little and they are flown again. A place whose
flight measures less than the place promised does not end the search: the next place that promises more is flown, too.
"""

import dataclasses
from collections import Counter
from typing import NamedTuple

import jax
import numpy as np

from vijax.batch.simulate import Starts
from vijax.design.aperiodic_search import Place, climbed
from vijax.design.averages import LIMITS
from vijax.design.candidates import KEPT
from vijax.design.ensemble import Ensemble, Task, fly, moving, on_motion, silent
from vijax.design.optimum import AperiodicOptimum, DroppedCandidate
from vijax.model.variables import tuned, values

_RESERVE = 1.5  # room kept for extremes that a proof has not met, in parts of what its worst ball has less than most
_TURNS = 1, 2, 4  # periods that every other ball, pair and four of a proof are ahead: they set out in 8, in turn
_BOUND = 2  # a design that is nearer to a bound, in radii of the first ensemble, is compared with the bound
_WINDOW = 0.1  # a flight that gives less than the best design by more than this, as a logarithm, is not in its window
_BESIDE = 0.5  # part of the last radius by which a design first moves away from a window
_SURE = 2  # standard errors of a slope
_FLAT, _LEVEL = 0.1, 1.0  # a slope that is certainly steeper is no maximum; at one it is certainly not so steep
_NEAR = 10  # a limit is told as active within so many times the room that is kept below it


@dataclasses.dataclass
class _Proof:
    """What is to be proved of one device.

    Attributes:
        places: Those that may be its best, the most promising last.
        room: Kept below the limits of the fitted surface, as a logarithm.
        shift: How far beside the surface's maximum the design is.
        flights: Flights about the last place that failed.
        mixed: How many of these ended on different motions.
        passed: What those flights showed, each the next of `Task.last_flights`, that did not refute it.
        best: The best design that passed all flights.
        dropped: Places that did not, and those that passed and gave less than the best.
    """

    places: list[Place]
    room: float
    shift: float = 0.0
    flights: int = 0
    mixed: int = 0
    passed: "list[_Told]" = dataclasses.field(default_factory=list)
    best: AperiodicOptimum | None = None
    dropped: list[DroppedCandidate] = dataclasses.field(default_factory=list)

    @property
    def stage(self) -> int:
        """Return the number of the next flight."""
        return len(self.passed)

    def close(self, task: Task) -> Place:
        """Be done with the last place; begin with the next one as with any."""
        self.room, self.shift, self.flights, self.mixed = task.settings.limit_room, 0.0, 0, 0
        self.passed = []
        return self.places.pop()

    def drop(self, task: Task, told: "_Told", reason: str) -> None:
        """Be done with the last place, which is no design for a reason."""
        one, predicted = told.optimum, float(np.exp(self.close(task).ahead))
        self.dropped.append(DroppedCandidate(one.values, one.label, predicted, one.height, reason))


class ProvedDesigns(NamedTuple):
    """The best design of each device whose motion is no orbit, None where there is none; the candidates dropped."""

    best: list[AperiodicOptimum | None]
    dropped: list[list[DroppedCandidate]]


def prove(task: Task, places: list[Place], known: np.ndarray, *, mixtures: bool = False) -> ProvedDesigns:
    """Find what the best places of every device give for certain.

    Args:
        task: See there.
        places: Where ensembles have climbed.
        known: Logarithm of the best verified objective of each device; places that give no more are no designs.
        mixtures: Whether balls of one flight may end on different motions, whose mean counts then.
    """
    settings, bar = task.settings, np.array(known, float)
    every: dict[int, _Proof] = {}
    for one in sorted(places, key=lambda one: one.ahead):
        if one.ahead > bar[one.owner] and one.surface.margins.min() > -settings.ensemble_radius:
            one.radius = max(one.radius, settings.last_radius)
            every.setdefault(one.owner, _Proof([], settings.limit_room)).places.append(one)
    while proofs := {owner: proof for owner, proof in every.items() if proof.places}:
        # All of the shorter flights before any of the longer ones: many that are flown together keep every lane busy.
        stage = min(proof.stage for proof in proofs.values())
        some = {owner: proof for owner, proof in proofs.items() if proof.stage == stage}
        for owner, told in _flown(task, some, stage).items():
            _take(task, some[owner], told, bar[owner], mixtures)
            if (proved := some[owner].best) is not None:
                bar[owner] = max(bar[owner], np.log(proved.height))
            _leave(some[owner], bar[owner])
    best = [every[owner].best if owner in every else None for owner in range(len(task.devices))]
    return ProvedDesigns(best, [every[owner].dropped if owner in every else [] for owner in range(len(task.devices))])


def _take(task: Task, proof: _Proof, told: "_Told", bar: float, mixtures: bool) -> None:
    """Judge a flight about the last place of a proof: it refutes the place, moves it, or is passed."""
    place, height = proof.places[-1], told.optimum.height
    if (told.mixed and not mixtures) or told.lacks < 0:
        _move(task, proof, told, told.mixed and not mixtures)
    elif not height or np.log(height) <= bar:
        if height and place.ahead > bar + KEPT and np.log(height) > bar - _WINDOW:
            # The window of that very orbit, perhaps: the motion that was climbed with is beside it.
            _move(task, proof, told, True)
        else:
            proof.drop(task, told, "a long flight measures less")
    else:
        proof.passed.append(told)
        if proof.stage == len(task.last_flights):
            if proof.best is not None:
                old = proof.best
                lost = DroppedCandidate(old.values, old.label, old.predicted, old.height, "another gives more")
                proof.dropped.append(lost)
            proof.best = told.optimum
            proof.close(task)
            proof.places += _at_bounds(task, place, told)


def _at_bounds(task: Task, place: Place, told: "_Told") -> list[Place]:
    """Return places at the bounds near a proved design, if noise does not tell that it is higher than they are.

    Each promises as much as the slope and its standard error allow there.
    """
    if told.optimum.stopped == "maximum":
        return []
    near, surface = _BOUND * task.settings.ensemble_radius * task.unit(place.owner), place.surface
    found = []
    for bound in task.box[place.owner]:
        for i in np.flatnonzero((told.z != bound) & (np.abs(bound - told.z) <= near)):
            z = told.z.copy()
            z[i] = bound[i]
            step = z[i] - told.z[i]
            slope = surface.gradient[i] * step + _SURE * surface.gradient_error[i] * abs(step)
            ahead = float(np.log(told.optimum.height) + slope)
            one = dataclasses.replace(place, z=z, best=z, radius=0.0, starts=told.optimum.starts, ahead=ahead)
            found.append(one)
    return sorted(found, key=lambda one: one.ahead)


def _leave(proof: _Proof, bar: float) -> None:
    """Leave the places that promise no more than a design that is proved."""
    if proof.best is not None and not proof.passed:
        proof.places = [one for one in proof.places if one.ahead > bar + KEPT]


def _flown(task: Task, some: dict[int, _Proof], stage: int) -> "dict[int, _Told]":
    """Fly the last places of some proofs through a stage; tell what that shows of them, by their owners."""
    owner, proofs = np.array(list(some)), list(some.values())
    places = [proof.places[-1] for proof in proofs]
    if stage:
        passed = [proof.passed[-1] for proof in proofs]
        z, starts = np.array([one.z for one in passed]), [one.optimum.starts for one in passed]
    else:
        shift = np.array([proof.shift for proof in proofs])[:, None]
        z = climbed(task, places, np.array([proof.room for proof in proofs])) + shift
        z = np.clip(z, task.box[owner, 0], task.box[owner, 1])
        starts = out_of_step(task, owner, z, [one.starts for one in places])
    balls, periods = task.last_flights[stage]
    flown = fly(task, owner, z, np.zeros(len(z)), starts, periods, balls)
    proves = stage + 1 == len(task.last_flights) and not task.expected
    return {one.owner: _told(task, one, at, whole, proves) for one, at, whole in zip(places, z, flown, strict=True)}


def out_of_step(task: Task, owner: np.ndarray, z: np.ndarray, starts: list[Starts]) -> list[Starts]:
    """Let balls set out in different periods.

    An attractor may have several bands, of which each period visits the next. Balls in step stay so: what ends of their
    windows cut off is then the same of all, and no spread of theirs tells of it.
    """
    if task.expected:
        return starts
    balls, none = task.settings.confirm_balls, np.zeros(len(z))
    begun = [on_motion(one, balls) for one in starts]
    for turn in _TURNS:
        # Those whose number has this power of 2.
        late = np.flatnonzero(np.arange(balls) & turn)
        if not late.size:
            break
        some = [jax.tree.map(lambda x, late=late: x[late], one) for one in begun]
        for one, ahead in zip(begun, fly(task, owner, z, none, some, turn, late.size), strict=True):
            for x, new in zip(*map(jax.tree.leaves, (one, ahead.found.end)), strict=True):
                x[late] = new
    return begun


def _move(task: Task, proof: _Proof, told: "_Told", mixed: bool) -> None:
    """Choose where the next flight goes: further within the limits, beside a window, or to the next best place."""
    settings = task.settings
    proof.flights += 1
    proof.passed = []
    if proof.flights == settings.max_confirmations:
        proof.drop(task, told, told.flaw)
    elif mixed:
        # Beside a window chaos goes on: first below, then above, each time further.
        proof.mixed += 1
        proof.shift = _BESIDE * settings.last_radius * (-1) ** proof.mixed * (1 + proof.mixed // 2)
    else:
        more = settings.limit_room - told.lacks
        proof.room += more
        # So far on the surface is followed, or the same design would be flown again.
        proof.places[-1].radius += more


@dataclasses.dataclass(frozen=True)
class _Told:
    """A design as a flight showed it.

    Attributes:
        optimum, z: The design and its variables.
        lacks: What is left of its limits for certain, or is lacking, as a logarithm.
        mixed: Whether its balls ended on different motions, or one of them on none.
    """

    optimum: AperiodicOptimum
    z: np.ndarray
    lacks: float
    mixed: bool

    @property
    def flaw(self) -> str:
        """Return why the flight refutes the design."""
        if self.lacks < 0:
            return f"breaks a limit by {100 * np.expm1(-self.lacks):.2g} %"
        if self.mixed:
            shares = ", ".join(f"{name} {100 * share:.3g} %" for name, share in self.optimum.shares.items())
            return f"a long flight ends on different motions: {shares}"
        return "a long flight measures less"


def room_left(margins: np.ndarray, share: float, *, proves: bool) -> np.ndarray:
    """Say how much room a flight leaves below each limit [constraint], as a logarithm.

    Where it proves a design, another flight as long may meet more than this one did. Rare extremes come from the tail
    of what balls meet: if that is exponential, the worst of 64 balls lies 4.5 of its lengths beyond the median one, and
    in one flight of eighty the worst of the next 64 is so much worse again. Where the attractor has a sharp bound, all
    balls have met it, and this takes nothing away.

    Args:
        margins: What each ball left of every constraint [ball, constraint].
        share: Part of the balls that has to keep within the limits.
        proves: Whether the flight is the proof of a design on one motion.
    """
    room = np.quantile(margins, 1 - share, axis=0, method="lower")
    return room - _RESERVE * (np.median(margins, axis=0) - room) if proves else room


def _told(task: Task, place: Place, z: np.ndarray, ensemble: Ensemble, proves: bool) -> _Told:
    """Return the design that a long flight showed."""
    found, device = ensemble.found, ensemble.device
    shares, fine = Counter(found.labels().tolist()), moving(found)
    kinds = Counter(found.labels()[fine].tolist()) or shares
    # Balls that met no wall for long are a part of aperiodic motion in a wide gap, and of no other.
    mixed = len(kinds) > 1 or not (fine | silent(found)).all() or (silent(found).any() and "aperiodic" not in kinds)
    room = room_left(found.margins()[fine] if fine.any() else found.margins(), task.reliability, proves=proves)
    given = found.value(task.objective, device)
    own = jax.tree.map(float, tuned(task.devices[place.owner], task.tune, z))
    low, high = task.box[place.owner]
    active = _active(task, z - low, high - z, room)
    P = float(found.P.mean())
    optimum = AperiodicOptimum(
        values=dict(zip(task.tune, np.asarray(values(task.tune, z)).tolist(), strict=True)),
        device=own,
        label=kinds.most_common(1)[0][0],
        height=float(given.mean()),
        P=P,
        P_stderr=float(found.P.std(ddof=1) / np.sqrt(found.P.size)),
        power=P * float(own.omega) / np.pi,
        speed=float(np.nan_to_num(found.speed).max()),
        max_penetration=float(np.nan_to_num(found.depth).max()),
        energy_ratio=float(np.nan_to_num(found.ratio).max()),
        lyapunov=float(np.nanmean(found.lyapunov)) if np.isfinite(found.lyapunov).any() else float("nan"),
        admissible=float((found.margins().min(axis=1) >= 0).mean()),
        shares={name: count / found.P.size for name, count in shares.most_common()},
        gradient=dict(zip(task.tune, place.surface.gradient.tolist(), strict=True)),
        gradient_stderr=dict(zip(task.tune, place.surface.gradient_error.tolist(), strict=True)),
        active=active,
        stopped=_stopped(place, active),
        ensembles=place.ensembles,
        predicted=float(np.exp(place.ahead)),
        flown=(found.P.size, ensemble.periods),
        starts=found.end,
        path=np.asarray(values(task.tune, np.array([at for at, _ in place.path]))),
        heights=np.array([height for _, height in place.path]),
    )
    return _Told(optimum, z, float(room.min()), bool(mixed) and not task.expected)


def _active(task: Task, above: np.ndarray, below: np.ndarray, room: np.ndarray) -> tuple[str, ...]:
    """Name what holds a design where it is."""
    settings = task.settings
    limits = zip(LIMITS, room, strict=True)
    words = [word for word, left in limits if left < _NEAR * settings.limit_room]
    for side, rooms in (("lower", above), ("upper", below)):
        near = zip(task.tune, rooms, strict=True)
        words += [f"{side} bound of {name}" for name, left in near if left < settings.active_margin]
    return tuple(words)


def _stopped(place: Place, active: tuple[str, ...]) -> str:
    """Return why the search ended at a place: at a maximum only if its slopes are known to be small."""
    if place.stopped != "maximum" or active:
        return place.stopped or "ensembles"
    slope, error = np.abs(place.surface.gradient), _SURE * place.surface.gradient_error
    if (slope > error + _FLAT).any():
        return "slope"
    return "maximum" if (slope + error < _LEVEL).all() else "noise"
