"""A model of a disk: what a killed process, or a power cut, may leave of the files of a store.

A change may be lost until it is flushed. Contents of a file may be lost, or half of them, until the file is flushed. A
change of names (a new file or folder, a rename, an exchange, a removal) may be lost, as a whole, until all its folders
are flushed, whatever happens to other changes. A killed process loses no change that it made.

`recorded` records the calls of the functions in `vijax.runtime.files` that change the disk.
"""

import itertools
import random
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from vijax.planes import store, store_folder, store_metadata, tiled_store
from vijax.runtime import files

if TYPE_CHECKING:
    import xarray as xr

CHANGES = ("create", "make_folder", "flush", "rename", "exchange", "remove")
_MODULES = (files, store, store_folder, store_metadata, tiled_store)
_RANDOM = 3  # states of every moment in which changes survive at random
_PARTS = 1.0, 0.5, 0.0  # of the content of a file that is not flushed, survive

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

    def damage(self, path: Path, content: bytes) -> None:
        """Replace the content of a file, as a fault of the disk does: no flush restores it."""
        if (inode := self._find(path)) is not None:
            inode.content = content

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
def recorded(
    root: Path, recording: Recording | None = None, before: Callable[[str], None] = lambda name: None
) -> Iterator[Recording]:
    """Record the changes of a folder while the block runs, and which tiles are done.

    Args:
        root: The folder.
        recording: An earlier recording of this folder, which is continued; a new one unless given.
        before: Called with the name of every change before it; an exception that it raises prevents the change.
    """
    recording = recording or Recording(root)
    originals = {name: getattr(files, name) for name in CHANGES}
    bound = [(module, name) for module in _MODULES for name in CHANGES if vars(module).get(name) is originals[name]]

    def recorded_call(name: str, first: Any, *more: Any) -> Any:
        before(name)
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


def random_state(recording: Recording, draw: random.Random) -> Tree:
    """Draw a state in which a power cut may leave a disk after the last step of a recording."""
    changes, loose, flushed = _unflushed(recording, len(recording.steps))
    return _tree(recording, _survivors(changes, loose, draw.choice(_kept(loose, draw))), flushed, draw.choice(_PARTS))


def _trees(recording: Recording, moment: int, draw: random.Random) -> Iterator[Tree]:
    """Find what a disk may hold after a power cut before a step."""
    changes, loose, flushed = _unflushed(recording, moment)
    for some in _kept(loose, draw):
        for part in _PARTS:
            yield _tree(recording, _survivors(changes, loose, some), flushed, part)


def _unflushed(recording: Recording, moment: int) -> tuple[dict[int, Change], list[int], set[Inode]]:
    """Find the changes before a step by their numbers, those among them that are not flushed, and flushed inodes."""
    steps = recording.steps[:moment]
    flushed = {inode: at for at, step in enumerate(steps) if isinstance(step, Flush) for inode in step.inodes}
    changes = {at: step for at, step in enumerate(steps) if isinstance(step, Change)}
    loose = [at for at, change in changes.items() if any(flushed.get(folder, -1) < at for folder, _, _ in change.names)]
    return changes, loose, set(flushed)


def _kept(loose: list[int], draw: random.Random) -> list[set[int]]:
    """List sets of changes that may survive, of those that are not flushed."""
    kept = [set(loose[:number]) for number in range(len(loose) + 1)]
    kept += [set(loose) - {one} for one in loose] + [{one} for one in loose]
    return kept + [{one for one in loose if draw.random() < 0.5} for _ in range(_RANDOM)]


def _survivors(changes: dict[int, Change], loose: list[int], kept: set[int]) -> list[Change]:
    return [change for at, change in changes.items() if at in kept or at not in loose]


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
    """Write the files of a state to a folder, in place of its contents."""
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name, content in tree.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if content is None:
            path.mkdir(exist_ok=True)
        else:
            path.write_bytes(content)
