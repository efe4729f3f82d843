"""What can a power cut do to a store, at any moment of writing it?

    python benchmarks/power_loss.py                 # every state of the model, each read and gone on with
    python benchmarks/power_loss.py --most 100      # of every scenario so many states, drawn at random

The model of a disk: a change may be lost until it is flushed. Contents of a file may be lost, or half of them, until
the file is flushed. A change of names (a new file or folder, a rename, an exchange, a removal) may be lost, as a whole,
until all its folders are flushed, whatever happens to other changes. Calls of the functions in `vijax.runtime.files`
that change the disk are recorded, and replayed up to each of them. Of the changes that are not flushed by then there
survive none, all, all up to one, all but one, one alone, or some at random, with whole, half or no contents.

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
import itertools
import logging
import os
import random
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import vijax
from vijax.model.records import Status
from vijax.planes import store, store_folder, store_metadata, tiled_store
from vijax.runtime import files

if TYPE_CHECKING:
    import xarray as xr

_CHANGES = ("create", "make_folder", "flush", "rename", "exchange", "remove")
_MODULES = (files, store, store_folder, store_metadata, tiled_store)
_RANDOM = 3  # states of every moment in which changes survive at random

# --- a recording -----------------------------------------------------------------------------------------------------


class Inode:
    """A file with its content, or a folder with its names as they are at the end of the recording."""

    def __init__(self, content: bytes | None = None) -> None:
        self.content = content
        self.names: dict[str, Inode] = {}


Name = tuple[Inode, str, Inode | None]
"""A name in a folder, and the inode that has it from then on, if any."""


class Change(NamedTuple):
    """A change of names that survives, or is lost, as a whole."""

    names: list[Name]


class Flush(NamedTuple):
    """Files and folders that were flushed."""

    inodes: list[Inode]


class Promise(NamedTuple):
    """Something that is true from then on: that a tile is done, or a map saved."""

    text: str


class Recording:
    """What was done to a folder.

    Attributes:
        root: The folder.
        top: Its inode.
        before: Names that were there before.
        steps: What was done, in order.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.top = root, Inode()
        self.steps: list[Change | Flush | Promise] = []
        self.before = list(self._names(root, self.top))
        self._guard = threading.Lock()

    def _names(self, folder: Path, inode: Inode) -> Iterator[Name]:
        for path in sorted(folder.iterdir()):
            inner = inode.names[path.name] = Inode(None if path.is_dir() else path.read_bytes())
            yield inode, path.name, inner
            if path.is_dir():
                yield from self._names(path, inner)

    def add(self, name: str, *given: Any) -> None:
        """Add a call of a function of `files`, or a promise."""
        with self._guard:
            if name == "promise":
                self.steps.append(Promise(*given))
            elif name == "flush":
                self.steps.append(Flush([inode for path in given[0] if (inode := self._find(path))]))
            elif changed := self._changed(name, *given):
                self._apply(changed)

    def _changed(self, name: str, path: Path, more: Any = None) -> dict[Path, Inode | None]:
        found = self._find(path)
        if name == "create":
            return {path: Inode(more)}
        if name == "make_folder":
            return {} if found else {path: Inode()}
        if name == "remove":
            return {path: None} if found else {}  # locks of working folders are not recorded
        return {more: found, path: self._find(more) if name == "exchange" else None}

    def _find(self, path: Path) -> Inode | None:
        inode: Inode | None = self.top
        for name in path.relative_to(self.root).parts:
            inode = inode and inode.names.get(name)
        return inode

    def _apply(self, changed: dict[Path, Inode | None]) -> None:
        names: list[Name] = []
        for path, inode in changed.items():
            folder = self._find(path.parent)
            assert folder is not None, f"what made {path.parent} was not recorded"
            names.append((folder, path.name, inode))
        for folder, name, inode in names:
            if inode is None:
                del folder.names[name]
            else:
                folder.names[name] = inode
        self.steps.append(Change(names))


@contextmanager
def recorded(root: Path) -> Iterator[Recording]:
    """Record what is done to a folder while the block runs, and which tiles are done."""
    recording = Recording(root)
    originals = {name: getattr(files, name) for name in _CHANGES}
    bound = [(module, name) for module in _MODULES for name in _CHANGES if vars(module).get(name) is originals[name]]

    def recorded_call(name: str, first: Any, *more: Any) -> Any:
        first = list(first) if name == "flush" else first
        found = originals[name](first, *more)
        if found is not False:  # else the disk cannot exchange names
            recording.add(name, first, *more)
        return found

    for module, name in bound:
        setattr(module, name, partial(recorded_call, name))
    try:
        with watched(lambda tile: recording.add("promise", str(tile))):
            yield recording
    finally:
        for module, name in bound:
            setattr(module, name, originals[name])


@contextmanager
def watched(tell: Callable[[int], None]) -> Iterator[None]:
    """Call a function with the number of every tile that is done while the block runs."""
    write = tiled_store.write

    def written(tile: tiled_store.StudyTile, found: "Mapping[str, xr.Variable]", seconds: float) -> None:
        write(tile, found, seconds)
        tell(tile.number)

    tiled_store.write = written
    try:
        yield
    finally:
        tiled_store.write = write


# --- states after a power cut ----------------------------------------------------------------------------------------

Tree = dict[str, bytes | None]
"""Contents of files by path; a folder has None."""


class State(NamedTuple):
    """What a disk may hold after a power cut, and what was promised before."""

    tree: Tree
    promised: frozenset[str]


def states(recording: Recording, seed: int = 0) -> list[State]:
    """Find the states in which a power cut may leave a disk; each once."""
    draw, found = random.Random(seed), {}
    for moment, promised in enumerate(_promises(recording)):
        for tree in _trees(recording, moment, draw):
            found[tuple(sorted(tree.items())), promised] = State(tree, promised)
    return list(found.values())


def some_states(recording: Recording, most: int, seed: int = 0) -> list[State]:
    """Draw so many of these states, for each set of promises as many."""
    draw, groups = random.Random(seed), dict[frozenset[str], list[int]]()
    for moment, promised in enumerate(_promises(recording)):
        groups.setdefault(promised, []).append(moment)
    turns = itertools.islice(itertools.cycle(groups.items()), most)
    return [State(draw.choice(list(_trees(recording, draw.choice(some), draw))), given) for given, some in turns]


def _promises(recording: Recording) -> list[frozenset[str]]:
    """Find what is promised before every step, and at the end."""
    found = [frozenset[str]()]
    for step in recording.steps:
        found.append(found[-1] | {step.text} if isinstance(step, Promise) else found[-1])
    return found


def last(recording: Recording) -> Tree:
    """Find what a disk holds at the end of a recording."""
    changes = [step for step in recording.steps if isinstance(step, Change)]
    return _tree(recording, changes, set(), 1.0)


def _trees(recording: Recording, moment: int, draw: random.Random) -> Iterator[Tree]:
    """Find what a disk may hold after a power cut before a step."""
    steps = recording.steps[:moment]
    flushed = {inode: at for at, step in enumerate(steps) if isinstance(step, Flush) for inode in step.inodes}
    changes = [(at, step) for at, step in enumerate(steps) if isinstance(step, Change)]
    loose = [at for at, change in changes if any(flushed.get(folder, -1) < at for folder, _, _ in change.names)]
    kept = [set(loose[:number]) for number in range(len(loose) + 1)]
    kept += [set(loose) - {one} for one in loose] + [{one} for one in loose]
    kept += [{one for one in loose if draw.random() < 0.5} for _ in range(_RANDOM)]
    for some in kept:
        survivors = [change for at, change in changes if at in some or at not in loose]
        for part in (1.0, 0.5, 0.0):
            yield _tree(recording, survivors, set(flushed), part)


def _tree(recording: Recording, changes: list[Change], flushed: set[Inode], part: float) -> Tree:
    """Apply changes to what was there; this part of contents is left where they were not flushed."""
    names: dict[Inode, dict[str, Inode]] = {}
    for folder, name, inode in [*recording.before, *(name for change in changes for name in change.names)]:
        inner = names.setdefault(folder, {})
        if inode is None:
            inner.pop(name, None)
        else:
            inner[name] = inode
    whole = flushed | {inode for _, _, inode in recording.before if inode is not None}
    found: Tree = {}

    def walk(folder: Inode, within: str) -> None:
        for name, inode in names.get(folder, {}).items():
            content = inode.content
            found[within + name] = content if content is None or inode in whole else content[: int(part * len(content))]
            walk(inode, f"{within}{name}/")

    walk(recording.top, "")
    return found


def lay_out(tree: Tree, folder: Path) -> None:
    """Write the files of a state."""
    for name, content in tree.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if content is None:
            path.mkdir(exist_ok=True)
        else:
            path.write_bytes(content)


# --- what is promised ------------------------------------------------------------------------------------------------

WHOLE = "whole"
"""The promise of a call that has returned."""

AXES: dict[str, Any] = {"d": np.linspace(0.1, 0.3, 5), "kappa": np.geomspace(3, 400, 4)}
NAME = "map.zarr"
_TILES = 6, 6, 4, 4  # cells of the tiles of the plane where a tile has six at most


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
        if not any(_agrees(found, one, whole) for one in scenario.after[-1 if whole else 0 :]):
            broken.append("load: other numbers")
        if _count(found) < sum(_TILES[tile] for tile in done):
            broken.append("load: a tile that is done is not there")
    if scenario.study:
        broken += _resumed(scenario, out, done)
    return Outcome(refused, broken)


def _agrees(found: "xr.Dataset", whole: "xr.Dataset", complete: bool) -> bool:
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
    return again if _agrees(found, scenario.after[-1], True) else [*again, "the same call: other numbers"]


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
    os.environ["VIJAX_TILE"] = str(_TILES[0])
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
