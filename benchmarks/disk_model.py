"""A model of a disk: the states of a store's files that a killed process, or a power cut, may leave.

A change may be lost until it is flushed. Contents of a file may be lost, fully or by half, until the file is flushed. A
change of names (a new file or folder, a rename, an exchange, a removal) may be lost, as a whole, until all its folders
are flushed, independently of other changes. A killed process loses none of its changes.

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

from vijax.maps.storage import store, store_folder, store_metadata, tiled_store
from vijax.runtime import files

if TYPE_CHECKING:
    import xarray as xr

CHANGES = ("create", "make_folder", "flush", "rename", "exchange", "remove")
_MODULES = (files, store, store_folder, store_metadata, tiled_store)
_RANDOM = 3  # states at every moment with randomly surviving changes
_PARTS = 1.0, 0.5, 0.0  # surviving fractions of the content of an unflushed file

# --- a recording -----------------------------------------------------------------------------------------------------


class Inode:
    """A file with its content, or a folder with its names at the end of the recording."""

    def __init__(self, content: bytes | None = None) -> None:
        self.content = content
        self.names: dict[str, Inode] = {}


Name = tuple[Inode, str, Inode | None]
"""A name in a folder, and its inode after the change; None if the name is removed."""


class Change(NamedTuple):
    """A change of names that survives, or is lost, as a whole."""

    names: list[Name]


class Flush(NamedTuple):
    """Files and folders that were flushed."""

    inodes: list[Inode]


class Guarantee(NamedTuple):
    """A guarantee from this moment on: a tile is done, or a map is saved."""

    text: str


class Recording:
    """Recorded changes of a folder.

    Attributes:
        root: The folder.
        top: Its inode.
        before: Names at the beginning.
        steps: Changes, flushes and guarantees, in order.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.top = root, Inode()
        self.steps: list[Change | Flush | Guarantee] = []
        self.before = list(self._names(root, self.top))
        self._guard = threading.Lock()

    def _names(self, folder: Path, inode: Inode) -> Iterator[Name]:
        for path in sorted(folder.iterdir()):
            inner = inode.names[path.name] = Inode(None if path.is_dir() else path.read_bytes())
            yield inode, path.name, inner
            if path.is_dir():
                yield from self._names(path, inner)

    def add(self, name: str, *arguments: Any) -> None:
        """Add a call of a function of `files`, or a guarantee."""
        with self._guard:
            if name == "guarantee":
                self.steps.append(Guarantee(*arguments))
            elif name == "flush":
                self.steps.append(Flush([inode for path in arguments[0] if (inode := self._find(path))]))
            elif changed := self._changed(name, *arguments):
                self._apply(changed)

    def damage(self, path: Path, content: bytes) -> None:
        """Replace the content of a file, as a fault of the disk does: no flush restores it."""
        if (inode := self._find(path)) is not None:
            inode.content = content

    def _changed(self, name: str, path: Path, argument: Any = None) -> dict[Path, Inode | None]:
        inode = self._find(path)
        if name == "create":
            return {path: Inode(argument)}
        if name == "make_folder":
            return {} if inode else {path: Inode()}
        if name == "remove":
            return {path: None} if inode else {}  # locks of working folders are not recorded
        return {argument: inode, path: self._find(argument) if name == "exchange" else None}

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
        result = originals[name](first, *more)
        if result is not False:  # else the disk cannot exchange names
            recording.add(name, first, *more)
        return result

    for module, name in bound:
        setattr(module, name, partial(recorded_call, name))
    try:
        with watched(lambda tile: recording.add("guarantee", str(tile))):
            yield recording
    finally:
        for module, name in bound:
            setattr(module, name, originals[name])


@contextmanager
def watched(notify: Callable[[int], None]) -> Iterator[None]:
    """Call a function with the number of every tile that is finished while the block runs."""
    write = tiled_store.write_tile

    def write_and_notify(tile: tiled_store.StudyTile, variables: "Mapping[str, xr.Variable]", seconds: float) -> None:
        write(tile, variables, seconds)
        notify(tile.number)

    tiled_store.write_tile = write_and_notify
    try:
        yield
    finally:
        tiled_store.write_tile = write


# --- states after a power cut ----------------------------------------------------------------------------------------

Tree = dict[str, bytes | None]
"""Contents of files by path; a folder has None."""


class State(NamedTuple):
    """Possible content of a disk after a power cut, and the guarantees before it."""

    tree: Tree
    guaranteed: frozenset[str]


def states(recording: Recording, seed: int = 0) -> list[State]:
    """Return the possible states of a disk after a power cut, each once."""
    draw, by_content = random.Random(seed), {}
    for moment, guaranteed in enumerate(_guarantees(recording)):
        for tree in _trees(recording, moment, draw):
            by_content[tuple(sorted(tree.items())), guaranteed] = State(tree, guaranteed)
    return list(by_content.values())


def random_states(recording: Recording, count: int, seed: int = 0) -> list[State]:
    """Draw a number of these states, equally many for each set of guarantees."""
    draw, groups = random.Random(seed), dict[frozenset[str], list[int]]()
    for moment, guaranteed in enumerate(_guarantees(recording)):
        groups.setdefault(guaranteed, []).append(moment)
    turns = itertools.islice(itertools.cycle(groups.items()), count)
    return [
        State(draw.choice(list(_trees(recording, draw.choice(moments), draw))), guarantees)
        for guarantees, moments in turns
    ]


def _guarantees(recording: Recording) -> list[frozenset[str]]:
    """Return the guarantees before every step, and at the end."""
    guaranteed = [frozenset[str]()]
    for step in recording.steps:
        guaranteed.append(guaranteed[-1] | {step.text} if isinstance(step, Guarantee) else guaranteed[-1])
    return guaranteed


def last(recording: Recording) -> Tree:
    """Return the content of a disk at the end of a recording."""
    changes = [step for step in recording.steps if isinstance(step, Change)]
    return _tree(recording, changes, set(), 1.0)


def random_state(recording: Recording, draw: random.Random) -> Tree:
    """Draw a possible state of a disk after a power cut at the end of a recording."""
    changes, loose, flushed = _unflushed(recording, len(recording.steps))
    return _tree(
        recording, _survivors(changes, loose, draw.choice(_surviving_sets(loose, draw))), flushed, draw.choice(_PARTS)
    )


def _trees(recording: Recording, moment: int, draw: random.Random) -> Iterator[Tree]:
    """Yield the possible contents of a disk after a power cut before a step."""
    changes, loose, flushed = _unflushed(recording, moment)
    for surviving in _surviving_sets(loose, draw):
        for part in _PARTS:
            yield _tree(recording, _survivors(changes, loose, surviving), flushed, part)


def _unflushed(recording: Recording, moment: int) -> tuple[dict[int, Change], list[int], set[Inode]]:
    """Return the changes before a step by number, the numbers of unflushed ones, and the flushed inodes."""
    steps = recording.steps[:moment]
    flushed = {inode: at for at, step in enumerate(steps) if isinstance(step, Flush) for inode in step.inodes}
    changes = {at: step for at, step in enumerate(steps) if isinstance(step, Change)}
    loose = [at for at, change in changes.items() if any(flushed.get(folder, -1) < at for folder, _, _ in change.names)]
    return changes, loose, set(flushed)


def _surviving_sets(loose: list[int], draw: random.Random) -> list[set[int]]:
    """Return sets of unflushed changes that may survive."""
    sets = [set(loose[:length]) for length in range(len(loose) + 1)]
    sets += [set(loose) - {number} for number in loose] + [{number} for number in loose]
    return sets + [{number for number in loose if draw.random() < 0.5} for _ in range(_RANDOM)]


def _survivors(changes: dict[int, Change], loose: list[int], surviving: set[int]) -> list[Change]:
    return [change for at, change in changes.items() if at in surviving or at not in loose]


def _tree(recording: Recording, changes: list[Change], flushed: set[Inode], part: float) -> Tree:
    """Apply changes to the initial content; this fraction of every unflushed content survives."""
    names: dict[Inode, dict[str, Inode]] = {}
    for folder, name, inode in [*recording.before, *(name for change in changes for name in change.names)]:
        inner = names.setdefault(folder, {})
        if inode is None:
            inner.pop(name, None)
        else:
            inner[name] = inode
    complete = flushed | {inode for _, _, inode in recording.before if inode is not None}
    tree: Tree = {}

    def add_folder(folder: Inode, within: str) -> None:
        for name, inode in names.get(folder, {}).items():
            content = inode.content
            tree[within + name] = (
                content if content is None or inode in complete else content[: int(part * len(content))]
            )
            add_folder(inode, f"{within}{name}/")

    add_folder(recording.top, "")
    return tree


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
