"""Which states can a power cut leave of a store, at any moment of writing it?

    python benchmarks/power_loss.py                 # every state of the model, each read and resumed
    python benchmarks/power_loss.py --most 100      # a number of random states per scenario

`disk_model` records the changes of the disk and defines which of them a power cut may undo. A scenario is replayed to
each of its changes. Of the changes that are not flushed by then, none survive, all, all up to one, all but one, one
alone, or some at random, with full, half or no contents.

For every scenario it prints the numbers of states, of states that `load` rejects, and of states with a broken
guarantee:

- after `save` has returned a map exists completely; while `save` replaces a map, the old or the new one is complete;
- a finished tile reads as it was written, and missing cells have the status `not_run`;
- the same call resumes without --overwrite, repeats no finished tile, and ends with the same map.

Exit code 1 if any is broken. Printout of `--most 40`, 20 cells in 4 tiles:

    where the disk can exchange two names:
        a study: 40 states, 4 refused, 0 broken
        a study that repairs damage: 40 states, 26 refused, 0 broken
        a study that replaces another: 40 states, 0 refused, 0 broken
        save: 40 states, 20 refused, 0 broken
        save that replaces a map: 40 states, 0 refused, 0 broken
    where the disk cannot exchange two names:
        a study: 40 states, 4 refused, 0 broken
        a study that repairs damage: 40 states, 26 refused, 0 broken
        a study that replaces another: 40 states, 0 refused, 0 broken
        save: 40 states, 20 refused, 0 broken
        save that replaces a map: 40 states, 0 refused, 0 broken
"""

import argparse
import logging
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import vijax
from benchmarks.disk_model import Recording, State, lay_out, random_states, recorded, states, watched
from vijax.maps.storage import store_folder
from vijax.model.records import Status

if TYPE_CHECKING:
    import xarray as xr

# --- guarantees ------------------------------------------------------------------------------------------------------

RETURNED = "returned"
"""Guarantee of a call that has returned."""

AXES: dict[str, Any] = {"d": np.linspace(0.1, 0.3, 5), "kappa": np.geomspace(3, 400, 4)}
NAME = "map.zarr"
TILES = 6, 6, 4, 4  # cells per tile of the plane, if a tile has at most six


def sweep(out: Path | None = None, **more: Any) -> "xr.Dataset":
    """Run the plane of all scenarios."""
    return vijax.sweep(**AXES, outputs=["P"], until="window", periods=20, out=out, **more)


class Scenario(NamedTuple):
    """A call that a power cut interrupts.

    Attributes:
        before: Makes the initial state.
        call: The interrupted call.
        after: Maps that may exist afterwards; after completion the last one.
        study: Whether `call` may be repeated, and then resumes.
        done: Tiles that are finished before.
        reads: Whether `load` must succeed as soon as any store exists.
    """

    before: Callable[[Path], Any] | None
    call: Callable[[Path], Any]
    after: "list[xr.Dataset]"
    study: bool
    done: frozenset[int] = frozenset()
    reads: bool = True


def scenarios() -> dict[str, Scenario]:
    """Return the scenarios by name."""
    new, old = sweep().load(), sweep(r=0.4).load()

    def save(path: Path) -> None:
        vijax.save(new, path, overwrite=path.exists())

    def replace(path: Path) -> None:
        sweep(path, overwrite=True)

    def save_old(path: Path) -> None:
        vijax.save(old, path)

    def sweep_old(path: Path) -> None:
        sweep(path, r=0.4)

    def damage(path: Path) -> None:
        sweep(path)
        (path / "P" / "zarr.json").unlink()
        (path / "P" / "c" / "0" / "0").write_bytes(b"torn")

    return {
        "a study": Scenario(None, sweep, [new], True),
        "a study that repairs damage": Scenario(damage, sweep, [new], True, frozenset({1, 2, 3}), False),
        "a study that replaces another": Scenario(sweep_old, replace, [old, new], False),
        "save": Scenario(None, save, [new], False),
        "save that replaces a map": Scenario(save_old, save, [old, new], False),
    }


def record(scenario: Scenario, folder: Path) -> Recording:
    """Record a scenario from its beginning to its end."""
    if scenario.before:
        scenario.before(folder / NAME)
    with recorded(folder) as recording:
        for tile in scenario.done:
            recording.add("guarantee", str(tile))
        scenario.call(folder / NAME)
        recording.add("guarantee", RETURNED)
    return recording


class Outcome(NamedTuple):
    """Result of a state: whether `load` rejects it, and its broken guarantees."""

    refused: bool
    broken: list[str]


def outcome(scenario: Scenario, state: State, folder: Path) -> Outcome:
    """Read a state, and resume from it."""
    lay_out(state.tree, folder)
    out, broken, refused = folder / NAME, [], False
    done, returned = {int(text) for text in state.guaranteed - {RETURNED}}, RETURNED in state.guaranteed
    try:
        dataset = vijax.load(out)
    except (ValueError, OSError) as error:
        refused = True
        must_load = scenario.reads and (scenario.before or state.guaranteed)
        if "\n" in str(error) or returned or must_load:
            broken.append(f"load: {error}")
    else:
        if not any(agrees(dataset, map_after, returned) for map_after in scenario.after[-1 if returned else 0 :]):
            broken.append("load: other numbers")
        if _count(dataset) < sum(TILES[tile] for tile in done):
            broken.append("load: a tile that is done is not there")
    if scenario.study:
        broken += _resumed(scenario, out, done)
    return Outcome(refused, broken)


def agrees(dataset: "xr.Dataset", reference: "xr.Dataset", complete: bool) -> bool:
    """Return True if a map's computed cells equal another map, and all cells are computed if it must be complete."""
    ran = (dataset["status"] != Status.NOT_RUN).values
    if set(dataset.variables) != set(reference.variables) or (complete and not ran.all()):
        return False
    numbers = all(np.array_equal(dataset[name].values[ran], reference[name].values[ran]) for name in reference)
    return numbers and all(np.array_equal(dataset[name], reference[name]) for name in reference.coords)


def _count(dataset: "xr.Dataset") -> int:
    """Count the computed cells."""
    return int((dataset["status"] != Status.NOT_RUN).sum())


def _resumed(scenario: Scenario, out: Path, done: set[int]) -> list[str]:
    ran: set[int] = set()
    try:
        with watched(ran.add):
            dataset = scenario.call(out).load()
    except (ValueError, OSError) as error:
        return [f"the same call: {error}"]
    repeated = [f"tile {tile} is run again" for tile in sorted(ran & done)]
    return repeated if agrees(dataset, scenario.after[-1], True) else [*repeated, "the same call: other numbers"]


def lose(scenario: Scenario, count: int | None, seed: int) -> list[Outcome]:
    """Interrupt a scenario by power cuts in every way, or in a number of ways."""
    with tempfile.TemporaryDirectory() as folder:
        recording = record(scenario, Path(folder).resolve())
    outcomes = []
    for state in states(recording, seed) if count is None else random_states(recording, count, seed):
        with tempfile.TemporaryDirectory() as folder:
            outcomes.append(outcome(scenario, state, Path(folder).resolve()))
    return outcomes


def main() -> int:
    """Run all scenarios; return 0 if no guarantee is broken."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--most", type=int, help="states of every scenario [all]")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn [0]")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    os.environ["VIJAX_TILE"] = str(TILES[0])
    passed = True
    for exchanges in (True, False):
        print(f"where the disk {'can' if exchanges else 'cannot'} exchange two names:")
        if not exchanges:
            store_folder.exchange = lambda first, second: False
        for name, scenario in scenarios().items():
            outcomes = lose(scenario, options.most, options.seed)
            broken = [result.broken for result in outcomes if result.broken]
            refused = sum(result.refused for result in outcomes)
            print(f"    {name}: {len(outcomes):,} states, {refused:,} refused, {len(broken):,} broken", flush=True)
            for reasons in broken[:5]:
                print(f"        {'; '.join(reasons)}")
            passed &= not broken
    return not passed


if __name__ == "__main__":
    sys.exit(main())
