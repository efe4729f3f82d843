"""What can a power cut do to a store, at any moment of writing it?

    python benchmarks/power_loss.py                 # every state of the model, each read and gone on with
    python benchmarks/power_loss.py --most 100      # of every scenario so many states, drawn at random

`disk_model` records the changes of the disk and states which of them a power cut may take. A scenario is replayed up to
each of its changes. Of the changes that are not flushed by then there survive none, all, all up to one, all but one,
one alone, or some at random, with whole, half or no contents.

For every scenario the numbers of states, of those that `load` refused, and of those that broke a promise are printed:

- a map is there, whole, once `save` has returned; while `save` replaces a map the old or the new one is there, whole;
- a tile that is done is read as it was written, and what is not there has the status `not_run`;
- the same call goes on without --overwrite, runs no tile again that was done, and ends in the same map.

Exit code 1 if any is broken. Printout of `--most 40`, 20 cells in 4 tiles:

    where the disk can exchange two names:
        a study: 40 states, 4 refused, 0 broken
        a study that mends damage: 40 states, 26 refused, 0 broken
        a study that replaces another: 40 states, 0 refused, 0 broken
        save: 40 states, 20 refused, 0 broken
        save that replaces a map: 40 states, 0 refused, 0 broken
    where the disk cannot exchange two names:
        a study: 40 states, 4 refused, 0 broken
        a study that mends damage: 40 states, 26 refused, 0 broken
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
from benchmarks.disk_model import Recording, State, lay_out, recorded, some_states, states, watched
from vijax.model.records import Status
from vijax.planes import store_folder

if TYPE_CHECKING:
    import xarray as xr

# --- what is promised ------------------------------------------------------------------------------------------------

WHOLE = "whole"
"""The promise of a call that has returned."""

AXES: dict[str, Any] = {"d": np.linspace(0.1, 0.3, 5), "kappa": np.geomspace(3, 400, 4)}
NAME = "map.zarr"
TILES = 6, 6, 4, 4  # cells of the tiles of the plane where a tile has six at most


def sweep(out: Path | None = None, **more: Any) -> "xr.Dataset":
    """Run the plane of all scenarios."""
    return vijax.sweep(**AXES, outputs=["P"], until="window", periods=20, out=out, **more)


class Scenario(NamedTuple):
    """Something that a power cut interrupts.

    Attributes:
        before: Makes what is there before.
        call: What is interrupted.
        after: The maps that may be there afterwards; once all is done the last one.
        study: Whether `call` may be repeated, and goes on then.
        done: Tiles that are done before.
        reads: Whether `load` must read what is there as soon as there is something.
    """

    before: Callable[[Path], Any] | None
    call: Callable[[Path], Any]
    after: "list[xr.Dataset]"
    study: bool
    done: frozenset[int] = frozenset()
    reads: bool = True


def scenarios() -> dict[str, Scenario]:
    """Name what is interrupted."""
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
        "a study that mends damage": Scenario(damage, sweep, [new], True, frozenset({1, 2, 3}), False),
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
            recording.add("promise", str(tile))
        scenario.call(folder / NAME)
        recording.add("promise", WHOLE)
    return recording


class Outcome(NamedTuple):
    """What became of a state: whether `load` refused it, and which promises are broken."""

    refused: bool
    broken: list[str]


def outcome(scenario: Scenario, state: State, folder: Path) -> Outcome:
    """Read a state, and go on with it."""
    lay_out(state.tree, folder)
    out, broken, refused = folder / NAME, [], False
    done, whole = {int(text) for text in state.promised - {WHOLE}}, WHOLE in state.promised
    try:
        found = vijax.load(out)
    except (ValueError, OSError) as error:
        refused = True
        there = scenario.reads and (scenario.before or state.promised)
        if "\n" in str(error) or whole or there:
            broken.append(f"load: {error}")
    else:
        if not any(agrees(found, one, whole) for one in scenario.after[-1 if whole else 0 :]):
            broken.append("load: other numbers")
        if _count(found) < sum(TILES[tile] for tile in done):
            broken.append("load: a tile that is done is not there")
    if scenario.study:
        broken += _resumed(scenario, out, done)
    return Outcome(refused, broken)


def agrees(found: "xr.Dataset", whole: "xr.Dataset", complete: bool) -> bool:
    """Return True if cells of a map that were run are as in another, and all were run if it is complete."""
    ran = (found["status"] != Status.NOT_RUN).values
    if set(found.variables) != set(whole.variables) or (complete and not ran.all()):
        return False
    numbers = all(np.array_equal(found[name].values[ran], whole[name].values[ran]) for name in whole)
    return numbers and all(np.array_equal(found[name], whole[name]) for name in whole.coords)


def _count(found: "xr.Dataset") -> int:
    """Count the cells that were run."""
    return int((found["status"] != Status.NOT_RUN).sum())


def _resumed(scenario: Scenario, out: Path, done: set[int]) -> list[str]:
    ran: set[int] = set()
    try:
        with watched(ran.add):
            found = scenario.call(out).load()
    except (ValueError, OSError) as error:
        return [f"the same call: {error}"]
    again = [f"tile {tile} is run again" for tile in sorted(ran & done)]
    return again if agrees(found, scenario.after[-1], True) else [*again, "the same call: other numbers"]


def lose(scenario: Scenario, most: int | None, seed: int) -> list[Outcome]:
    """Let power cuts interrupt a scenario in every way, or in so many."""
    with tempfile.TemporaryDirectory() as folder:
        recording = record(scenario, Path(folder).resolve())
    outcomes = []
    for state in states(recording, seed) if most is None else some_states(recording, most, seed):
        with tempfile.TemporaryDirectory() as folder:
            outcomes.append(outcome(scenario, state, Path(folder).resolve()))
    return outcomes


def main() -> int:
    """Try all; exit with 0 if no promise is broken."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--most", type=int, help="states of every scenario [all]")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn [0]")
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    os.environ["VIJAX_TILE"] = str(TILES[0])
    good = True
    for exchanges in (True, False):
        print(f"where the disk {'can' if exchanges else 'cannot'} exchange two names:")
        if not exchanges:
            store_folder.exchange = lambda one, other: False
        for name, scenario in scenarios().items():
            outcomes = lose(scenario, given.most, given.seed)
            broken = [one.broken for one in outcomes if one.broken]
            refused = sum(one.refused for one in outcomes)
            print(f"    {name}: {len(outcomes):,} states, {refused:,} refused, {len(broken):,} broken", flush=True)
            for reasons in broken[:5]:
                print(f"        {'; '.join(reasons)}")
            good &= not broken
    return not good


if __name__ == "__main__":
    sys.exit(main())
