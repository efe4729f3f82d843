"""Does a store survive faults in any combination?

    python benchmarks/store_faults.py                   # 300 random runs of at most 12 steps
    python benchmarks/store_faults.py --runs 1000 --steps 20 --seed 1

A run is a random sequence of: a sweep that begins, resumes or overwrites a store, or `save`, each until its end or
until its process is killed; a power cut, which takes changes that are not flushed; damage to a file; a second writer;
a rename of the folder; a worker of a cluster that is lost, and one that writes its tile after the cluster lost it.
`disk_model` states what a kill and a power cut leave. After every step and at the end of the run this must hold:

- `load` returns numbers of the undisturbed map, with the status `not_run` elsewhere, or raises one clear error;
- without damage there is no error, all tiles that were done are there, and no tile that was done runs again;
- the last call, repeated, ends with the files and numbers of the undisturbed store, bit for bit, and leaves nothing
  beside the store; or it raises one clear error, and with the remedy that the error names it ends so.

A clear error is a ValueError or an OSError of vijax in one line: what must hold; got what; the remedy.

A tile is four to six cells of 20 periods, computed by the engine as any tile is. That is faithful, because a store
receives arrays: no file and no order of writing depends on how they are computed. The calls of `os.fsync` are left out,
as the model knows by the calls of `files.flush` what is flushed.

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
from benchmarks.disk_model import CHANGES, Promise, Recording, lay_out, random_state, recorded
from benchmarks.power_loss import TILES, agrees, sweep
from vijax.planes import cluster, store_folder
from vijax.runtime import files

if TYPE_CHECKING:
    import xarray as xr

PLANES: dict[str, dict[str, Any]] = {"one": {}, "other": {"r": 0.4}}
_NAMES = "map.zarr", "moved.zarr"
_MOST_CHANGES = 12  # of one kind that a call makes before it is killed, at most
_ALL = frozenset(range(len(TILES)))
_CLEAR = re.compile(r".+ must .+; got .+; .+")
# Files that differ between two stores of one plane: birth, times of tiles.
_OWN = re.compile(r"vijax\.json|status/tiles/.*")


class Undisturbed(NamedTuple):
    """The map of a plane, and the files of its store that do not depend on when it was made."""

    dataset: "xr.Dataset"
    contents: dict[str, bytes]


def undisturbed() -> dict[str, Undisturbed]:
    """Make the store of every plane without a fault."""
    found = {}
    for name, plane in PLANES.items():
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder, _NAMES[0])
            found[name] = Undisturbed(sweep(out, **plane).load(), contents(out))
    return found


def contents(out: Path) -> dict[str, bytes]:
    """Read the files of a store that do not depend on when it was made."""
    return {name: content for name, content in files_of(out).items() if not _OWN.fullmatch(name)}


def files_of(out: Path) -> dict[str, bytes]:
    """Read the files of a store."""
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}


class Expected(NamedTuple):
    """A state in which a store may be.

    Attributes:
        plane: Name of its plane; None if there is no store.
        saved: Whether `save` wrote it.
        tiles: Tiles that are done.
    """

    plane: str | None
    saved: bool = False
    tiles: frozenset[int] = frozenset()


class Killed(BaseException):
    """End of a process: no later change of its disk happens, no handler of exceptions prevents it."""


class Kill(NamedTuple):
    """The moment of a kill: before the change of this kind with this number."""

    kind: str
    number: int


class Fuse:
    """Raise Killed at the moment of a kill, and at every later change of the disk."""

    def __init__(self) -> None:
        self.left: Kill | None = None

    def __call__(self, name: str) -> None:
        """Count a change."""
        if self.left is None:
            return
        if self.left.kind in (name, "any"):
            if not self.left.number:
                self.left = Kill("any", 0)
                raise Killed
            self.left = self.left._replace(number=self.left.number - 1)


# Most calls are for one plane, so that most resume the store that is there.
plane_names = st.sampled_from(["one", "one", "one", "other"])
# Between a change of names and its flush a kill leaves what a power cut takes later.
moments = st.builds(
    Kill, st.sampled_from(["flush", "flush", *CHANGES]), st.integers(0, 3) | st.integers(0, _MOST_CHANGES)
)
kills = st.none() | moments


class StoreMachine(RuleBasedStateMachine):
    """A store, the faults that befall it, and the states in which it may be.

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
            (cluster, "check", lambda workers: None),
        ):
            self.stack.enter_context(patch.object(target, name, substitute))

    @initialize(exchanges=st.booleans())
    def choose_disk(self, exchanges: bool) -> None:
        """Let the disk exchange two names in one step, or not."""
        if not exchanges:
            self.stack.enter_context(patch.object(store_folder, "exchange", lambda one, other: False))

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
        """Run a sweep with `overwrite=True`, or save a map over whatever is there."""
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
        """Run a sweep on a cluster that loses a worker amid a tile, and gives the tile to another worker."""

        def done(work: Callable[[Any], None], tasks: Iterable[Any], workers: cluster.Workers) -> Iterator[Any]:
            for number, task in enumerate(tasks):
                if number == tile:
                    self.late.append(partial(work, task))
                    left, self.fuse.left = self.fuse.left, at
                    with suppress(Killed):
                        work(task)
                    self.fuse.left = left
                work(task)
                yield task

        with patch.object(cluster, "done", done):
            self._sweep("lose a worker", name, kill, workers=1)

    @rule(kill=kills)
    def late_worker(self, kill: Kill | None) -> None:
        """Let a worker that the cluster lost write its tile now: it did not end, the network was cut."""
        if self.late:
            end = self._call("late worker", kill, self.late.pop())
            # Nobody reads the error of such a worker: its scheduler has lost it.
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
        found = sorted(path for path in self.root.rglob("*") if path.is_file() and path.stat().st_size)
        if not found:
            return
        self.steps["damage"] += 1
        self.damaged = self.ever_damaged = True
        path = found[which % len(found)]
        content = bytearray(path.read_bytes())
        at = int(where * len(content))
        if flip:
            content[at] ^= 1 << which % 8
        else:
            del content[at:]
        path.write_bytes(content)
        self.recording.damage(path, bytes(content))

    @rule(chance=st.integers(0, 3))
    def move(self, chance: int) -> None:
        """Rename the folder of the store, every fourth time; the user waits until that is on disk."""
        target = self.path.with_name(_NAMES[self.path.name == _NAMES[0]])
        if chance or not self.path.exists() or target.exists():
            return
        self.steps["move"] += 1
        os.rename(self.path, target)
        self.recording.add("rename", self.path, target)
        self.recording.add("flush", [self.root])
        self.path = target

    # --- what must hold ---

    @invariant()
    def load_returns_right_numbers(self) -> None:
        """Check what `load` returns."""
        found: list[xr.Dataset] = []
        end = self._call("", None, lambda: found.append(vijax.load(self.path)))
        if isinstance(end, FileNotFoundError):
            assert self.damaged or Expected(None) in self.expected, end
        elif end is not None:
            assert self.damaged, end
            check_clear(end)
        else:
            names = [name for name, store in self.stores.items() if agrees(found[0], store.dataset, False)]
            assert names, "load returns other numbers"
            assert self.damaged or any(
                one.plane == names[0] and one.tiles <= self._present(found[0]) for one in self.expected
            ), f"load returns a map of the plane {names[0]}; expected {self.expected}"

    def teardown(self) -> None:
        """Repeat the last call, check its end, and remove all."""
        try:
            if sys.exc_info()[0] is None:
                self._finish()
        finally:
            self.stack.close()

    def _finish(self) -> None:
        end = self._sweep("finish", self.last, None)
        if end is not None:
            # The remedies of an error, in this order.
            if "allow overwriting" in str(end):
                end = self._sweep("finish", self.last, None, overwrite=True)
            elif "take another name" in str(end):
                self.path, self.expected = self.root / "new.zarr", {Expected(None)}
                end = self._sweep("finish", self.last, None)
            assert end is None, f"the remedy that an error names does not help: {end}"
        whole = self.stores[self.last]
        assert vijax.load(self.path).identical(whole.dataset)
        assert contents(self.path) == whole.contents
        # What was left under the name that the store had before it was renamed goes with the next call on that name.
        parts = [*self.path.rglob("*.part*"), *files.parts_of(self.path)]
        assert self.ever_damaged or not parts, f"left: {parts}"

    # --- calls ---

    def _sweep(self, step: str, name: str, kill: Kill | None, **more: Any) -> BaseException | None:
        """Run a sweep; expect what it leaves."""
        overwrite, before = more.get("overwrite", False), len(self.recording.steps)
        self.last = name
        others = [one for one in self.expected if one.saved or one.plane not in (name, None)]
        end = self._call(step, kill, lambda: sweep(self.path, **PLANES[name], **more))
        tiles = frozenset(int(one.text) for one in self.recording.steps[before:] if isinstance(one, Promise))
        if isinstance(end, Exception):
            assert self.damaged or (others and not overwrite), end
            check_clear(end)
            return end
        if not overwrite and not others and not self.damaged:
            done = frozenset.intersection(*(one.tiles for one in self.expected))
            # Which tiles a late or lost worker writes again is not the choice of the sweep.
            assert not tiles & done or step == "lose a worker", f"tiles {sorted(tiles & done)} run again"
        if end is None:
            self.expected, self.damaged = {Expected(name, tiles=_ALL)}, False
        elif tiles:
            own = [Expected(None)] if overwrite else [one for one in self.expected if one not in others]
            self.expected = {Expected(name, tiles=one.tiles | tiles) for one in own}
        elif overwrite or Expected(None) in self.expected:
            self.expected |= {Expected(name)}
        return end

    def _call(self, step: str, kill: Kill | None, call: Callable[[], Any]) -> BaseException | None:
        """Call, at most until a change of the disk; return what ended the call early."""
        self.fuse.left = kill
        end: BaseException | None = None
        with recorded(self.root, self.recording, self.fuse), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                call()
            except (Killed, ValueError, OSError) as error:
                end = error.with_traceback(None)
        self.fuse.left = None
        if step:
            self.steps[f"{step}, killed" if isinstance(end, Killed) else f"{step}, refused" if end else step] += 1
        return end

    def _present(self, found: "xr.Dataset") -> frozenset[int]:
        """Find the tiles whose cells were all run."""
        ran = (found["status"] != vijax.Status.NOT_RUN).values
        extents = [-(-length // 2) for length in ran.shape]
        blocks = itertools.product(*(range(0, length, step) for length, step in zip(ran.shape, extents, strict=True)))
        return frozenset(
            number
            for number, (first, second) in enumerate(blocks)
            if ran[first : first + extents[0], second : second + extents[1]].all()
        )


def check_clear(error: BaseException) -> None:
    """Raise unless an error states what must hold, what was given and the remedy, in one line."""
    assert _CLEAR.fullmatch(str(error)), f"no clear error: {error!r}"


def run(
    stores: Mapping[str, Undisturbed], runs: int, steps: int, seed: int | None = None, **settings: Any
) -> Counter[str]:
    """Run the machine; return how often each step was taken."""
    taken = Counter[str]()

    def machine() -> StoreMachine:
        return StoreMachine(stores, taken)

    # The type of the argument is a class; a function that makes a machine serves as well.
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
    return taken


def main() -> int:
    """Run all; exit with 0 if nothing was broken."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=int, default=300, help="random runs [300]")
    parser.add_argument("--steps", type=int, default=12, help="steps of a run, at most [12]")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn [0]")
    parser.add_argument("--shrink", action="store_true", help="look for the shortest run that breaks something")
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    os.environ["VIJAX_TILE"] = str(TILES[0])
    phases = [hypothesis.Phase.generate, *([hypothesis.Phase.shrink] if given.shrink else [])]
    taken = run(undisturbed(), given.runs, given.steps, given.seed, database=None, phases=phases)
    print(f"{given.runs} runs, {sum(taken.values())} steps, none broken")
    for step, count in sorted(taken.items()):
        print(f"    {step}: {count}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
