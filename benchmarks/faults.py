"""How much does a study lose if it is killed, its disk is full or its files are damaged?

    python benchmarks/faults.py                          # every fault, each from the start
    python benchmarks/faults.py --only kill --kills 20   # one of them: kill, stop, worker, disk, readonly,
                                                         # damages, overwrite, foreign, writers, savers
    python benchmarks/faults.py --side 256               # a smaller plane

Each fault is applied to `scripts/grid.py` on the (d, kappa) plane of side x side cells. The output has the moments, the
script's messages, the number of tiles that ran more than once, and whether the finished store's variables and
coordinates are bit-identical to an undisturbed run. Exit code 1 if any differs.
"""

import argparse
import json
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
from typing import TYPE_CHECKING, Any

import numpy as np

import vijax

if TYPE_CHECKING:
    import xarray as xr

SCRIPT = Path(__file__).parent.parent / "scripts" / "grid.py"
# Prints the number of every tile at its start, and accepts Ctrl-C although children of background jobs ignore it.
WRAPPER = (
    "import logging, runpy, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "logging.basicConfig(format='%(message)s'); logging.getLogger('vijax').setLevel(logging.INFO); "
    "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
)
_WARM = 182  # least side with tiles of full size, so that one run compiles their programs
_REACH = 0.6  # latest moment of a kill, in tile times after the first tile
_SAVES = 60  # saves by two processes at the same time
_DISK, _LARGER_DISK = 5, 100  # MiB; a tile of 32,768 cells takes about 2


@dataclass(frozen=True)
class Scene:
    """The plane, the folder of the stores, and the times of an undisturbed run: until its first tile, and per tile."""

    side: int
    kills: int
    folder: Path
    undisturbed: Path
    first: float
    seconds_per_tile: float

    def store(self, name: str) -> Path:
        """Return a path for a new store."""
        return self.folder / f"{name}.zarr"

    def moment(self) -> float:
        """Draw a random number of seconds after the start of a process."""
        return random.uniform(0, self.first + _REACH * self.seconds_per_tile)


def start(side: int, out: Path, *more: str, **options) -> subprocess.Popen:
    """Start the script."""
    plane = ["--d", f"0.05:0.3:{side}", "--kappa", f"3:400:{side}:log", "--out", str(out), *more]
    command = [sys.executable, "-c", WRAPPER, str(SCRIPT), *plane]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, **options)


@dataclass(frozen=True)
class End:
    """End of a run: exit code, number of started tiles, last line."""

    code: int
    began: int
    last_line: str


def ended(process: subprocess.Popen) -> End:
    """Wait for the end of a run."""
    _, output = process.communicate()
    lines = [line for line in re.split(r"[\r\n]+", output) if line.strip()]
    messages = [line for line in lines if "begins" not in line and "cells/s" not in line]
    return End(process.returncode, sum(" begins" in line for line in lines), messages[-1] if messages else "")


def done(out: Path) -> int:
    """Count the finished tiles."""
    return len(list(out.glob("status/tiles/[0-9]*.json")))


def finish(scene: Scene, out: Path) -> End:
    """Run to the end."""
    return ended(start(scene.side, out))


def differing(scene: Scene, dataset: "xr.Dataset") -> list[str]:
    """Return the variables and coordinates that differ, in any bit or in attributes, from an undisturbed run."""

    def same(left: "xr.DataArray", other: "xr.DataArray") -> bool:
        return np.array_equal(left, other, equal_nan=True) and left.attrs == other.attrs

    undisturbed_map = vijax.load(scene.undisturbed)
    return [
        str(name)
        for name in undisturbed_map.variables
        if name not in dataset or not same(dataset[name], undisturbed_map[name])
    ]


def is_undisturbed(scene: Scene, dataset: "xr.Dataset") -> bool:
    """Return True if a map equals the undisturbed run."""
    return not differing(scene, dataset)


def check_store(scene: Scene, out: Path, began: int | None = None) -> bool:
    """Return True if the finished store is undisturbed; print the number of tiles that ran more than once."""
    differ = differing(scene, vijax.load(out))
    repeated = "" if began is None else f"; tiles run more than once: {began - done(out)} of {done(out)}"
    print(f"    lost: {', '.join(differ) if differ else 'nothing, all equal bit for bit'}{repeated}")
    shutil.rmtree(out)
    return not differ


def kill(scene: Scene) -> bool:
    """Send SIGKILL at random moments of one plane, and resume each time."""
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
    return check_store(scene, out, began + end.began)


def stop(scene: Scene) -> bool:
    """Send SIGTERM and SIGINT at a random moment."""
    passed = True
    for signal_number in (signal.SIGTERM, signal.SIGINT):
        out = scene.store("stop")
        process = start(scene.side, out)
        time.sleep(scene.first + random.random() * scene.seconds_per_tile)
        process.send_signal(signal_number)
        end = ended(process)
        print(f"    {signal_number.name}: exit code {end.code}: {end.last_line}")
        passed &= check_store(scene, out, end.began + finish(scene, out).began)
    return passed


def worker(scene: Scene) -> bool:
    """Send SIGKILL to one of two workers of a cluster at a random moment."""
    out = scene.store("worker")
    process = start(scene.side, out, "--workers", "2")
    while process.poll() is None and not done(out):
        time.sleep(0.1)
    time.sleep(random.random() * scene.seconds_per_tile)
    before, children = (
        done(out),
        subprocess.run(["pgrep", "-P", str(process.pid), "-f", "spawn_main"], capture_output=True),
    )
    workers = [int(number) for number in children.stdout.split()]
    os.kill(random.choice(workers), signal.SIGKILL)
    end = ended(process)
    print(f"    one of {len(workers)} killed when {before} tiles were done: exit code {end.code}: {end.last_line}")
    return check_store(scene, out)


@contextmanager
def disk(scene: Scene) -> Iterator[Path | None]:
    """Mount a small file system in memory, if the user may."""
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
    """Fill a disk after some tiles; then let it grow."""
    with disk(scene) as place:
        out = (place or scene.folder) / "full.zarr"
        if place:
            end = ended(start(scene.side, out))
            remount(place, f"size={_LARGER_DISK}m")
        else:
            small = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (1 << 17, 1 << 17))
            end = ended(start(scene.side, out, preexec_fn=small))
        limit = f"a tmpfs of {_DISK} MiB" if place else "RLIMIT_FSIZE of 128 KiB, as no tmpfs may be mounted"
        print(f"    {limit}: exit code {end.code}: {end.last_line}")
        return check_store(scene, out, end.began + finish(scene, out).began)


def readonly(scene: Scene) -> bool:
    """Forbid writing a store when the run goes on."""
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
        print(f"    read-only: exit code {end.code}: {end.last_line}")
        remount(place, "rw")
        return check_store(scene, out, began + finish(scene, out).began)


def truncate(chunk: Path) -> None:
    """Cut off the end of a file."""
    os.truncate(chunk, chunk.stat().st_size - 5)


def flip(chunk: Path) -> None:
    """Flip one bit in the middle of a file."""
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)


def pipe(file: Path) -> None:
    """Replace a file by a pipe, which blocks its reader."""
    file.unlink()
    os.mkfifo(file)


def device(file: Path) -> None:
    """Replace a file by a device without an end."""
    file.unlink()
    file.symlink_to("/dev/zero")


def overwrite(file: Path) -> None:
    """Overwrite a file with bytes that are no text."""
    file.write_bytes(b"\xff\x00" * 40)


def variable(file: Path) -> None:
    """Remove the folder of a file."""
    shutil.rmtree(file.parent)


def exchange(file: Path) -> None:
    """Replace the values by another coordinate's values, in an intact chunk."""
    shutil.copyfile(file.parent.parent.parent / "kappa" / "c" / "0", file)


def entry(**entries: object) -> Callable[[Path], None]:
    """Return a function that edits entries of a metadata file."""

    def edit(file: Path) -> None:
        file.write_text(json.dumps(json.loads(file.read_text()) | entries))

    return edit


def attribute(name: str, value: object) -> Callable[[Path], None]:
    """Return a function that edits an attribute in a metadata file; None removes it."""

    def edit(file: Path) -> None:
        content = json.loads(file.read_text())
        content["attributes"] |= {name: value}
        if value is None:
            del content["attributes"][name]
        file.write_text(json.dumps(content))

    return edit


_BIG_ENDIAN = [{"name": "bytes", "configuration": {"endian": "big"}}, {"name": "zstd"}, {"name": "crc32c"}]
_SMALL_CHUNKS = {"name": "regular", "configuration": {"chunk_shape": [2, 2]}}
_CHUNK = "P/c/*/*"
DAMAGES: dict[str, tuple[str, Callable[[Path], None]]] = {
    "a truncated chunk": (_CHUNK, truncate),
    "a flipped chunk": (_CHUNK, flip),
    "a missing chunk": (_CHUNK, Path.unlink),
    "a pipe for a chunk": (_CHUNK, pipe),
    "a device for a chunk": (_CHUNK, device),
    "a variable gone": ("P/zarr.json", variable),
    "another data type": ("P/zarr.json", entry(data_type="int64", fill_value=0)),
    "another byte order": ("P/zarr.json", entry(codecs=_BIG_ENDIAN)),
    "other codecs": ("P/zarr.json", entry(codecs=[{"name": "bytes"}])),
    "other chunks": ("P/zarr.json", entry(chunk_grid=_SMALL_CHUNKS)),
    "a scale": ("P/zarr.json", attribute("scale_factor", 2.0)),
    "other units": ("P/zarr.json", attribute("units", "mJ")),
    "no flags": ("status/zarr.json", attribute("flag_meanings", None)),
    "an exchanged coordinate": ("d/c/0", exchange),
    "a coordinate gone": ("d/c/0", variable),
    "another setting": ("zarr.json", attribute("periods", 50)),
    "no metadata": ("zarr.json", Path.unlink),
    "a truncated record": ("status/tiles/0.json", truncate),
    "a binary lock": ("status/tiles/lock", overwrite),
    "no lock": ("status/tiles/lock", Path.unlink),
    "a flipped list": ("vijax.json", flip),
    "no list": ("vijax.json", Path.unlink),
}


def damages(scene: Scene) -> bool:
    """Do each kind of damage to a finished store, read it and go on with it."""
    passed = True
    for name, (where, damage) in DAMAGES.items():
        out = scene.store("damaged")
        shutil.copytree(scene.undisturbed, out)
        damage(random.choice(sorted(out.glob(where))))
        try:
            message = "nothing, and the numbers are right" if is_undisturbed(scene, vijax.load(out)) else "NOTHING"
        except ValueError as error:
            message = str(error).replace(str(out), out.name)
        end = finish(scene, out)
        print(f"    {name}: load says {message}; exit code {end.code}; tiles run again: {end.began}")
        passed &= message != "NOTHING" and "\n" not in message and end.code == 0
        passed &= check_store(scene, out)
    return passed


def stopped_overwrite(scene: Scene) -> bool:
    """Send SIGKILL while --overwrite puts a new store in the place of an old one; then run, anew or not."""
    passed = True
    for options in ((), ("--overwrite",)):
        out = scene.store("overwritten")
        shutil.copytree(scene.undisturbed, out)
        process = start(scene.side, out, "--overwrite")
        while not leftovers(out) and process.poll() is None:
            time.sleep(0.001)
        process.kill()
        ended(process)
        before, end = leftovers(out), ended(start(scene.side, out, *options))
        print(f"    left: {', '.join(before) or 'nothing'}; exit code {end.code}; {end.began} tiles run again")
        passed &= bool(before) and not leftovers(out)
        passed &= check_store(scene, out)
    return passed


def leftovers(out: Path) -> list[str]:
    """Return the names of files that a killed run left beside a store."""
    return [path.name for path in out.parent.glob(f".{out.stem}.*")]


def foreign(scene: Scene) -> bool:
    """Put a user's file in a store: --overwrite is refused, and a run resumes."""
    out = scene.store("foreign")
    shutil.copytree(scene.undisturbed, out)
    user_file = out / "notes.part1.txt"
    user_file.write_text("precious")
    end = ended(start(scene.side, out, "--overwrite"))
    print(f"    --overwrite: exit code {end.code}: {end.last_line}")
    passed = end.code == 2 and finish(scene, out).code == 0 and user_file.read_text() == "precious"
    return check_store(scene, out) and passed


def writers(scene: Scene) -> bool:
    """Run a second time on a store that is being written."""
    out = scene.store("writers")
    process = start(scene.side, out)
    while not done(out):
        time.sleep(0.1)
    second = finish(scene, out)
    print(f"    second: exit code {second.code}: {second.last_line}")
    return check_store(scene, out, ended(process).began + second.began)


# Saves a map with its own number for every line that it receives.
SAVER = """
import sys, numpy as np, xarray as xr, vijax
dataset = xr.Dataset({"P": ("d", np.full(4096, float(sys.argv[2])))}, coords={"d": np.arange(4096.0)})
print("ready", flush=True)
for line in sys.stdin:
    vijax.save(dataset, sys.argv[1], overwrite=True)
    print("saved", flush=True)
"""


def savers(scene: Scene) -> bool:
    """Let two processes save to one path at the same time, each in a PID namespace if the system permits."""
    out, wrong = scene.store("saved"), 0
    namespace_command = ["unshare", "--user", "--map-root-user", "--pid", "--fork"]
    allowed = (
        shutil.which("unshare") and subprocess.run([*namespace_command, "true"], capture_output=True).returncode == 0
    )
    command = [*(namespace_command if allowed else ()), sys.executable, "-c", SAVER, str(out)]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "bufsize": 1}
    processes = [subprocess.Popen([*command, str(number)], **pipes) for number in (1, 2)]
    orders, answers = (
        [process.stdin for process in processes if process.stdin],
        [process.stdout for process in processes if process.stdout],
    )
    for answer in answers:
        answer.readline()
    for _ in range(_SAVES):
        for order in orders:
            order.write("go\n")
        saved = [answer.readline() for answer in answers]
        try:
            numbers = set(np.unique(vijax.load(out)["P"]).tolist())
            wrong += len(numbers) != 1 or saved != ["saved\n"] * 2
        except (ValueError, OSError) as error:
            print(f"    load: {error}")
            wrong += 1
    for process in processes:
        process.communicate()
    namespaces = "two PID namespaces" if allowed else "one PID namespace, as no other may be made"
    print(f"    {namespaces}: {wrong} of {_SAVES} times wrong; left beside: {', '.join(leftovers(out)) or 'nothing'}")
    return not wrong and not leftovers(out)


FAULTS: dict[str, Callable[[Scene], bool]] = {
    "kill": kill,
    "stop": stop,
    "worker": worker,
    "disk": full_disk,
    "readonly": readonly,
    "damages": damages,
    "overwrite": stopped_overwrite,
    "foreign": foreign,
    "writers": writers,
    "savers": savers,
}


def undisturbed(side: int, kills: int, folder: Path) -> Scene:
    """Time an undisturbed run, after a run that compiles."""
    out = folder / "undisturbed.zarr"
    ended(start(min(side, _WARM), folder / "warm.zarr"))  # compiles
    start_time, process, first_tile = time.perf_counter(), start(side, out), 0.0
    while process.poll() is None:
        if not first_tile and done(out):
            first_tile = time.perf_counter() - start_time
        time.sleep(0.05)
    end, seconds = ended(process), time.perf_counter() - start_time
    seconds_per_tile = (seconds - first_tile) / max(done(out) - 1, 1)
    print(f"undisturbed: {seconds:.1f} s, {done(out)} tiles, the first after {first_tile:.1f} s, exit code {end.code}")
    return Scene(side, kills, folder, out, first_tile, seconds_per_tile)


def main() -> int:
    """Apply all faults; return 0 if nothing is lost."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", choices=FAULTS, help="one fault")
    parser.add_argument("--side", type=int, default=512, help="cells along each axis [512]")
    parser.add_argument("--kills", type=int, default=20, help="kills during one plane [20]")
    parser.add_argument("--seed", type=int, default=0, help="of the moments [0]")
    options = parser.parse_args()
    random.seed(options.seed)
    passed = True
    with tempfile.TemporaryDirectory() as folder:
        scene = undisturbed(options.side, options.kills, Path(folder))
        for name, inject in FAULTS.items():
            if options.only in (None, name):
                print(f"{name}: {(inject.__doc__ or '').rstrip('.')}")
                passed &= inject(scene)
    return not passed


if __name__ == "__main__":
    sys.exit(main())
