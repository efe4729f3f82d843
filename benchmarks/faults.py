"""What does a study lose when it is killed, its disk is full or its files are damaged?

    python benchmarks/faults.py                          # every fault, each from the start
    python benchmarks/faults.py --only kill --kills 20   # one of them: kill, stop, worker, disk, readonly, chunks,
                                                         # writers
    python benchmarks/faults.py --side 256               # a smaller plane

Each fault befalls `scripts/grid.py` on the (d, kappa) plane of side x side cells. Said are the moments, what the script
told, how many tiles were run more than once, and whether the data variables of the finished store are, bit for bit,
those of a run that nothing befell. Exit code 1 if any is not.
"""

import argparse
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

import vijax

SCRIPT = Path(__file__).parent.parent / "scripts" / "grid.py"
# Says which tile begins, and hears Ctrl-C though a background job's children ignore it.
WRAPPER = (
    "import logging, runpy, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "logging.basicConfig(format='%(message)s'); logging.getLogger('vijax').setLevel(logging.INFO); "
    "sys.argv = sys.argv[1:]; "
    "sys.path[0] = sys.argv[0].rpartition('/')[0]; runpy.run_path(sys.argv[0], run_name='__main__')"
)
_WARM = 182  # the least side whose tiles are as large as any, so that they are compiled
_REACH = 0.6  # of a tile's time past the first tile, up to which moments are drawn: most kills find none done
_DISK, _LARGER_DISK = 5, 100  # MiB; a tile of 32,768 cells takes about 2


@dataclass(frozen=True)
class Scene:
    """The plane, where stores go, and how long a run that nothing befalls takes to its first tile and for each."""

    side: int
    kills: int
    folder: Path
    whole: Path
    first: float
    each: float

    def store(self, name: str) -> Path:
        """A path for a new store."""
        return self.folder / f"{name}.zarr"

    def moment(self) -> float:
        """Seconds from the start of a process, drawn at random."""
        return random.uniform(0, self.first + _REACH * self.each)


def start(side: int, out: Path, *more: str, **options) -> subprocess.Popen:
    """The script on its way."""
    plane = ["--d", f"0.05:0.3:{side}", "--kappa", f"3:400:{side}:log", "--out", str(out), *more]
    command = [sys.executable, "-c", WRAPPER, str(SCRIPT), *plane]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, **options)


@dataclass(frozen=True)
class End:
    """How a run ended: exit code, tiles it began, its last line."""

    code: int
    began: int
    said: str


def ended(process: subprocess.Popen) -> End:
    """The end of a run."""
    _, told = process.communicate()
    lines = [line for line in re.split(r"[\r\n]+", told) if line.strip()]
    said = [line for line in lines if "begins" not in line and "cells/s" not in line]
    return End(process.returncode, sum(" begins" in line for line in lines), said[-1] if said else "")


def done(out: Path) -> int:
    """Tiles that are done."""
    return len(list(out.glob("status/tiles/[0-9]*.json")))


def finish(scene: Scene, out: Path) -> End:
    """Run to the end."""
    return ended(start(scene.side, out))


def verdict(scene: Scene, out: Path, began: int | None = None) -> bool:
    """Say whether the finished store is as it should be, and how many tiles were run more than once."""
    found, whole = vijax.load(out), vijax.load(scene.whole)
    differ = [str(name) for name in whole if not np.array_equal(found[name], whole[name], equal_nan=True)]
    again = "" if began is None else f"; tiles run more than once: {began - done(out)} of {done(out)}"
    print(f"    lost: {', '.join(differ) if differ else 'nothing, all data variables equal bit for bit'}{again}")
    shutil.rmtree(out)
    return not differ


def kill(scene: Scene) -> bool:
    """SIGKILL at random moments of one plane, resumed each time."""
    out, began, worst, kills = scene.store("kill"), 0, 0, 0
    while kills < scene.kills:
        before, process = done(out), start(scene.side, out)
        try:
            process.wait(scene.moment())
        except subprocess.TimeoutExpired:
            process.kill()
            kills += 1
        end = ended(process)
        began, worst = began + end.began, max(worst, end.began - (done(out) - before))
        if end.code == 0:
            break
    end = finish(scene, out)
    print(f"    {kills} kills; at most {worst} tiles begun in vain by one of them; exit code {end.code} in the end")
    return verdict(scene, out, began + end.began)


def stop(scene: Scene) -> bool:
    """SIGTERM and SIGINT at a random moment."""
    good = True
    for which in (signal.SIGTERM, signal.SIGINT):
        out = scene.store("stop")
        process = start(scene.side, out)
        time.sleep(scene.first + random.random() * scene.each)
        process.send_signal(which)
        end = ended(process)
        print(f"    {which.name}: exit code {end.code}: {end.said}")
        good &= verdict(scene, out, end.began + finish(scene, out).began)
    return good


def worker(scene: Scene) -> bool:
    """SIGKILL of one of two workers of a cluster at a random moment."""
    out = scene.store("worker")
    process = start(scene.side, out, "--workers", "2")
    while process.poll() is None and not done(out):
        time.sleep(0.1)
    time.sleep(random.random() * scene.each)
    before, found = (
        done(out),
        subprocess.run(["pgrep", "-P", str(process.pid), "-f", "spawn_main"], capture_output=True),
    )
    crew = [int(number) for number in found.stdout.split()]
    os.kill(random.choice(crew), signal.SIGKILL)
    end = ended(process)
    print(f"    one of {len(crew)} killed when {before} tiles were done: exit code {end.code}: {end.said}")
    return verdict(scene, out)


@contextmanager
def disk(scene: Scene) -> Iterator[Path | None]:
    """A small file system in memory, if this user may mount one."""
    place = scene.folder / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={_DISK}m", "tmpfs", str(place)]
    allowed = shutil.which("mount") and subprocess.run(mount, capture_output=True).returncode == 0
    try:
        yield place if allowed else None
    finally:
        if allowed:
            subprocess.run(["umount", str(place)], check=True)
        place.rmdir()


def remount(place: Path, option: str) -> None:
    """Change a mounted file system."""
    subprocess.run(["mount", "-o", f"remount,{option}", str(place)], check=True)


def full_disk(scene: Scene) -> bool:
    """A disk that is full after some tiles; then it grows."""
    with disk(scene) as place:
        out = (place or scene.folder) / "full.zarr"
        if place:
            end = ended(start(scene.side, out))
            remount(place, f"size={_LARGER_DISK}m")
        else:
            small = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (1 << 17, 1 << 17))
            end = ended(start(scene.side, out, preexec_fn=small))
        what = f"a tmpfs of {_DISK} MiB" if place else "RLIMIT_FSIZE of 128 KiB, as no tmpfs may be mounted"
        print(f"    {what}: exit code {end.code}: {end.said}")
        return verdict(scene, out, end.began + finish(scene, out).began)


def readonly(scene: Scene) -> bool:
    """A store that may no longer be written when the run goes on."""
    with disk(scene) as place:
        if not place:
            print("    not done: no tmpfs may be mounted here")
            return True
        remount(place, f"size={_LARGER_DISK}m")
        out = place / "readonly.zarr"
        process = start(scene.side, out)
        while not done(out):
            time.sleep(0.1)
        process.kill()
        began = ended(process).began
        remount(place, "ro")
        end = finish(scene, out)
        print(f"    read-only: exit code {end.code}: {end.said}")
        remount(place, "rw")
        return verdict(scene, out, began + finish(scene, out).began)


def truncate(chunk: Path) -> None:
    """Cut off the end of a file."""
    os.truncate(chunk, chunk.stat().st_size - 5)


def flip(chunk: Path) -> None:
    """Flip one bit in the middle of a file."""
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)


def chunks(scene: Scene) -> bool:
    """A truncated, a flipped and a missing chunk of a finished store."""
    good = True
    for damage in (truncate, flip, Path.unlink):
        out = scene.store("chunk")
        shutil.copytree(scene.whole, out)
        chunk = random.choice([path for path in (out / "P" / "c").rglob("*") if path.is_file()])
        damage(chunk)
        end = finish(scene, out)
        print(f"    {damage.__name__}: exit code {end.code}: {end.said}; {end.began} tile run again")
        good &= verdict(scene, out)
    return good


def writers(scene: Scene) -> bool:
    """A second run on a store that is being written."""
    out = scene.store("writers")
    process = start(scene.side, out)
    while not done(out):
        time.sleep(0.1)
    second = finish(scene, out)
    print(f"    second: exit code {second.code}: {second.said}")
    return verdict(scene, out, ended(process).began + second.began)


FAULTS: dict[str, Callable[[Scene], bool]] = {
    "kill": kill,
    "stop": stop,
    "worker": worker,
    "disk": full_disk,
    "readonly": readonly,
    "chunks": chunks,
    "writers": writers,
}


def undisturbed(side: int, kills: int, folder: Path) -> Scene:
    """A run that nothing befalls, timed."""
    out = folder / "whole.zarr"
    ended(start(min(side, _WARM), folder / "warm.zarr"))  # compiles
    began, process, first = time.perf_counter(), start(side, out), 0.0
    while process.poll() is None:
        if not first and done(out):
            first = time.perf_counter() - began
        time.sleep(0.05)
    end, seconds = ended(process), time.perf_counter() - began
    each = (seconds - first) / max(done(out) - 1, 1)
    print(f"undisturbed: {seconds:.1f} s, {done(out)} tiles, the first after {first:.1f} s, exit code {end.code}")
    return Scene(side, kills, folder, out, first, each)


def main() -> int:
    """Exit code 0 if nothing was lost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", choices=FAULTS, help="one fault")
    parser.add_argument("--side", type=int, default=512, help="cells along each axis [512]")
    parser.add_argument("--kills", type=int, default=20, help="kills during one plane [20]")
    parser.add_argument("--seed", type=int, default=0, help="of the moments [0]")
    given = parser.parse_args()
    random.seed(given.seed)
    good = True
    with tempfile.TemporaryDirectory() as folder:
        scene = undisturbed(given.side, given.kills, Path(folder))
        for name, fault in FAULTS.items():
            if given.only in (None, name):
                print(f"{name}: {(fault.__doc__ or '').rstrip('.')}")
                good &= fault(scene)
    return not good


if __name__ == "__main__":
    sys.exit(main())
