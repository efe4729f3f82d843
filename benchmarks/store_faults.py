"""Does a store survive faults in any combination?

    python benchmarks/store_faults.py                   # 300 random runs of at most 12 steps
    python benchmarks/store_faults.py --runs 1000 --steps 20 --seed 1

A run is a random sequence of: a sweep that starts, resumes or overwrites a store, or `save`, each until its end or
until its process is killed; a power cut, which undoes unflushed changes; damage to a file; a second writer; a rename of
the folder; a worker that a cluster loses, and a lost worker that still writes its tile. `disk_model` defines the states
after a kill and a power cut. After every step and at the end of the run the following must hold:

- `load` returns numbers of the undisturbed map, with the status `not_run` elsewhere, or raises one clear error;
- without damage there is no error, all finished tiles are present, and no finished tile runs again;
- the last call, repeated, ends with the files and numbers of the undisturbed store, bit for bit, and leaves no other
  files; or it raises one clear error, and has this result after the remedy that the error names.

A clear error is a ValueError or an OSError of vijax in one line: the requirement; got the value; the remedy.

A tile is four to six cells of 20 periods, computed by the engine like any tile. This is faithful, because a store
receives arrays: no file and no order of writing depends on their computation. The calls of `os.fsync` are left out,
as the model records the calls of `files.flush`.

Exit code 1 if a run broke this; its steps are printed.
"""

import argparse
import itertools
import logging
import os
import random
import re
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from unittest.mock import patch

import hypothesis
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

import vijax
from benchmarks.disk_model import CHANGES, Guarantee, Recording, lay_out, random_state, recorded
from benchmarks.power_loss import TILES, agrees, sweep
from vijax.maps.execution import cluster
from vijax.maps.storage import store_folder
from vijax.runtime import files

if TYPE_CHECKING:
    import xarray as xr

PLANES: dict[str, dict[str, Any]] = {"one": {}, "other": {"r": 0.4}}
_NAMES = "map.zarr", "moved.zarr"
_MOST_CHANGES = 12  # most changes of one kind before a kill
_ALL = frozenset(range(len(TILES)))
_CLEAR = re.compile(r".+ must .+; got .+; .+")
# Files that differ between two stores of one plane: identity, times of tiles.
_DIFFERING_FILES = re.compile(r"vijax\.json|status/tiles/.*")


class Undisturbed(NamedTuple):
    """The map of a plane, and the files of its store that do not depend on the time of writing."""

    dataset: "xr.Dataset"
    contents: dict[str, bytes]


def undisturbed() -> dict[str, Undisturbed]:
    """Make the store of every plane without faults."""
    stores = {}
    for name, plane in PLANES.items():
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder, _NAMES[0])
            stores[name] = Undisturbed(sweep(out, **plane).load(), contents(out))
    return stores


def contents(out: Path) -> dict[str, bytes]:
    """Read the files of a store that do not depend on the time of writing."""
    return {name: content for name, content in files_of(out).items() if not _DIFFERING_FILES.fullmatch(name)}


def files_of(out: Path) -> dict[str, bytes]:
    """Read the files of a store."""
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}


class Expected(NamedTuple):
    """A possible state of a store.

    Attributes:
        plane: Name of its plane; None if there is no store.
        saved: Whether `save` wrote it.
        tiles: Finished tiles.
    """

    plane: str | None
    saved: bool = False
    tiles: frozenset[int] = frozenset()


class Killed(BaseException):
    """End of a process: its disk changes no more, and no exception handler prevents the end."""


class Kill(NamedTuple):
    """Moment of a kill: before the change of this kind with this number."""

    kind: str
    number: int


class Fuse:
    """Raises Killed at the moment of a kill, and at every later change of the disk."""

    def __init__(self) -> None:
        self.remaining: Kill | None = None

    def __call__(self, name: str) -> None:
        """Count a change."""
        if self.remaining is None:
            return
        if self.remaining.kind in (name, "any"):
            if not self.remaining.number:
                self.remaining = Kill("any", 0)
                raise Killed
            self.remaining = self.remaining._replace(number=self.remaining.number - 1)


# Most calls are for one plane, so that most of them resume the existing store.
plane_names = st.sampled_from(["one", "one", "one", "other"])
# A kill between a change of names and its flush leaves a state that a later power cut may undo.
moments = st.builds(
    Kill, st.sampled_from(["flush", "flush", *CHANGES]), st.integers(0, 3) | st.integers(0, _MOST_CHANGES)
)
kills = st.none() | moments


class StoreMachine(RuleBasedStateMachine):
    """A store, the faults applied to it, and its possible states.

    Args:
        stores: Undisturbed stores by plane.
        steps: Counts steps by their name, over all runs.
    """

    def __init__(self, stores: Mapping[str, Undisturbed], steps: Counter[str]) -> None:
        super().__init__()
        self.stores, self.steps, self.stack, self.fuse = stores, steps, ExitStack(), Fuse()
        self.root = Path(self.stack.enter_context(tempfile.TemporaryDirectory())).resolve()
        self.recording = Recording(self.root)
        self.path, self.last = self.root / _NAMES[0], "one"
        self.expected = {Expected(None)}
        self.damaged = self.ever_damaged = False
        self.late: list[Callable[[], None]] = []
        for target, name, substitute in (
            (files, "_flush", lambda path: None),
            (cluster, "check_available", lambda workers: None),
        ):
            self.stack.enter_context(patch.object(target, name, substitute))

    @initialize(exchanges=st.booleans())
    def choose_disk(self, exchanges: bool) -> None:
        """Choose whether the disk can exchange two names in one step."""
        if not exchanges:
            self.stack.enter_context(patch.object(store_folder, "exchange", lambda first, second: False))

    # --- steps ---

    @rule(name=plane_names, kill=kills)
    def begin_or_resume(self, name: str, kill: Kill | None) -> None:
        """Run a sweep."""
        self._sweep("begin or resume", name, kill)

    @rule(kill=kills)
    def resume(self, kill: Kill | None) -> None:
        """Repeat the last call."""
        self._sweep("resume", self.last, kill)

    @rule(name=plane_names, kill=kills, save=st.sampled_from([False, False, True]))
    def overwrite(self, name: str, kill: Kill | None, save: bool = False) -> None:
        """Run a sweep with `overwrite=True`, or save a map over any existing store."""
        if not save:
            self._sweep("overwrite", name, kill, overwrite=True)
            return
        expected = Expected(name, saved=True, tiles=_ALL)
        end = self._call("save", kill, lambda: vijax.save(self.stores[name].dataset, self.path, overwrite=True))
        if end is None:
            self.expected, self.damaged = {expected}, False
        elif isinstance(end, Killed):
            self.expected |= {expected}
        else:
            assert self.damaged, end

    @rule(name=plane_names, other=plane_names, overwrite=st.booleans(), kill=kills)
    def second_writer(self, name: str, other: str, overwrite: bool, kill: Kill | None) -> None:
        """Try to write a store while a sweep is writing it."""

        def intrude(done: int, total: int) -> None:
            for call in (
                lambda: sweep(self.path, **PLANES[other], overwrite=overwrite),
                lambda: vijax.save(self.stores[other].dataset, self.path, overwrite=True),
            ):
                with suppress(BlockingIOError):
                    call()
                    raise AssertionError("a second writer was not refused")

        self._sweep("second writer", name, kill, progress=intrude)

    @rule(name=plane_names, tile=st.integers(0, 3), at=moments, kill=kills)
    def lose_worker(self, name: str, tile: int, at: Kill, kill: Kill | None) -> None:
        """Run a sweep on a cluster that loses a worker during a tile, and assigns the tile to another worker."""

        def done(work: Callable[[Any], None], tasks: Iterable[Any], workers: cluster.Workers) -> Iterator[Any]:
            for number, task in enumerate(tasks):
                if number == tile:
                    self.late.append(partial(work, task))
                    remaining, self.fuse.remaining = self.fuse.remaining, at
                    with suppress(Killed):
                        work(task)
                    self.fuse.remaining = remaining
                work(task)
                yield task

        with patch.object(cluster, "run_tasks", done):
            self._sweep("lose a worker", name, kill, workers=1)

    @rule(kill=kills)
    def late_worker(self, kill: Kill | None) -> None:
        """Let a lost worker write its tile now: only its network connection was lost."""
        if self.late:
            end = self._call("late worker", kill, self.late.pop())
            # No process receives the error of such a worker: its scheduler has lost it.
            assert not isinstance(end, Exception) or isinstance(end, OSError), end

    @rule(seed=st.integers(0, 2**32))
    def tear(self, seed: int) -> None:
        """Cut the power."""
        self.steps["tear"] += 1
        lay_out(random_state(self.recording, random.Random(seed)), self.root)
        self.recording = Recording(self.root)

    @rule(which=st.integers(0, 2**16), where=st.floats(0, 1, exclude_max=True), flip=st.booleans())
    def damage(self, which: int, where: float, flip: bool) -> None:
        """Flip a bit of a file, or cut its end off."""
        files_on_disk = sorted(path for path in self.root.rglob("*") if path.is_file() and path.stat().st_size)
        if not files_on_disk:
            return
        self.steps["damage"] += 1
        self.damaged = self.ever_damaged = True
        path = files_on_disk[which % len(files_on_disk)]
        content = bytearray(path.read_bytes())
        position = int(where * len(content))
        if flip:
            content[position] ^= 1 << which % 8
        else:
            del content[position:]
        path.write_bytes(content)
        self.recording.damage(path, bytes(content))

    @rule(chance=st.integers(0, 3))
    def move(self, chance: int) -> None:
        """Rename the folder of the store every fourth time, and flush the rename."""
        target = self.path.with_name(_NAMES[self.path.name == _NAMES[0]])
        if chance or not self.path.exists() or target.exists():
            return
        self.steps["move"] += 1
        os.rename(self.path, target)
        self.recording.add("rename", self.path, target)
        self.recording.add("flush", [self.root])
        self.path = target

    # --- invariants ---

    @invariant()
    def load_returns_right_numbers(self) -> None:
        """Check the result of `load`."""
        loaded: list[xr.Dataset] = []
        end = self._call("", None, lambda: loaded.append(vijax.load(self.path)))
        if isinstance(end, FileNotFoundError):
            assert self.damaged or Expected(None) in self.expected, end
        elif end is not None:
            assert self.damaged, end
            check_clear(end)
        else:
            names = [name for name, store in self.stores.items() if agrees(loaded[0], store.dataset, False)]
            assert names, "load returns other numbers"
            assert self.damaged or any(
                state.plane == names[0] and state.tiles <= self._present(loaded[0]) for state in self.expected
            ), f"load returns a map of the plane {names[0]}; expected {self.expected}"

    def teardown(self) -> None:
        """Repeat the last call, check its result, and remove everything."""
        try:
            if sys.exc_info()[0] is None:
                self._finish()
        finally:
            self.stack.close()

    def _finish(self) -> None:
        end = self._sweep("finish", self.last, None)
        if end is not None:
            # The remedies that errors name, in this order.
            if "allow overwriting" in str(end):
                end = self._sweep("finish", self.last, None, overwrite=True)
            elif "take another name" in str(end):
                self.path, self.expected = self.root / "new.zarr", {Expected(None)}
                end = self._sweep("finish", self.last, None)
            assert end is None, f"the remedy that an error names does not help: {end}"
        undisturbed_store = self.stores[self.last]
        assert vijax.load(self.path).identical(undisturbed_store.dataset)
        assert contents(self.path) == undisturbed_store.contents
        # Part files under the name before a rename are removed by the next call with that name.
        part_files = [*self.path.rglob("*.part*"), *files.parts_of(self.path)]
        assert self.ever_damaged or not part_files, f"left: {part_files}"

    # --- calls ---

    def _sweep(self, step: str, name: str, kill: Kill | None, **options: Any) -> BaseException | None:
        """Run a sweep, and update the possible states."""
        overwrite, before = options.get("overwrite", False), len(self.recording.steps)
        self.last = name
        others = [item for item in self.expected if item.saved or item.plane not in (name, None)]
        end = self._call(step, kill, lambda: sweep(self.path, **PLANES[name], **options))
        tiles = frozenset(int(item.text) for item in self.recording.steps[before:] if isinstance(item, Guarantee))
        if isinstance(end, Exception):
            assert self.damaged or (others and not overwrite), end
            check_clear(end)
            return end
        if not overwrite and not others and not self.damaged:
            done = frozenset.intersection(*(item.tiles for item in self.expected))
            # A late or lost worker may write tiles again, independently of the sweep.
            assert not tiles & done or step == "lose a worker", f"tiles {sorted(tiles & done)} run again"
        if end is None:
            self.expected, self.damaged = {Expected(name, tiles=_ALL)}, False
        elif tiles:
            states = [Expected(None)] if overwrite else [item for item in self.expected if item not in others]
            self.expected = {Expected(name, tiles=item.tiles | tiles) for item in states}
        elif overwrite or Expected(None) in self.expected:
            self.expected |= {Expected(name)}
        return end

    def _call(self, step: str, kill: Kill | None, call: Callable[[], Any]) -> BaseException | None:
        """Make a call, which a kill may end at a change of the disk; return the error that ended it."""
        self.fuse.remaining = kill
        end: BaseException | None = None
        with recorded(self.root, self.recording, self.fuse), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                call()
            except (Killed, ValueError, OSError) as error:
                end = error.with_traceback(None)
        self.fuse.remaining = None
        if step:
            self.steps[f"{step}, killed" if isinstance(end, Killed) else f"{step}, refused" if end else step] += 1
        return end

    def _present(self, dataset: "xr.Dataset") -> frozenset[int]:
        """Return the tiles with all cells computed."""
        computed = (dataset["status"] != vijax.Status.NOT_RUN).values
        extents = [-(-length // 2) for length in computed.shape]
        blocks = itertools.product(
            *(range(0, length, step) for length, step in zip(computed.shape, extents, strict=True))
        )
        return frozenset(
            number
            for number, (first, second) in enumerate(blocks)
            if computed[first : first + extents[0], second : second + extents[1]].all()
        )


def check_clear(error: BaseException) -> None:
    """Raise unless an error states the requirement, the value and the remedy in one line."""
    assert _CLEAR.fullmatch(str(error)), f"no clear error: {error!r}"


def run(
    stores: Mapping[str, Undisturbed], runs: int, steps: int, seed: int | None = None, **settings: Any
) -> Counter[str]:
    """Run the state machine; return the number of times of each step."""
    counts = Counter[str]()

    def machine() -> StoreMachine:
        return StoreMachine(stores, counts)

    # The argument's type is a class; a function that makes a machine works as well.
    start: Any = machine if seed is None else hypothesis.seed(seed)(machine)
    run_state_machine_as_test(
        start,
        settings=hypothesis.settings(
            max_examples=runs,
            stateful_step_count=steps,
            deadline=None,
            suppress_health_check=list(hypothesis.HealthCheck),
            **settings,
        ),
    )
    return counts


def main() -> int:
    """Run the state machine; return 0 if no invariant was broken."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=int, default=300, help="random runs [300]")
    parser.add_argument("--steps", type=int, default=12, help="steps of a run, at most [12]")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn [0]")
    parser.add_argument("--shrink", action="store_true", help="look for the shortest run that breaks something")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    os.environ["VIJAX_TILE"] = str(TILES[0])
    phases = [hypothesis.Phase.generate, *([hypothesis.Phase.shrink] if options.shrink else [])]
    counts = run(undisturbed(), options.runs, options.steps, options.seed, database=None, phases=phases)
    print(f"{options.runs} runs, {sum(counts.values())} steps, none broken")
    for step, count in sorted(counts.items()):
        print(f"    {step}: {count}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
