"""How long does a new Python process take to its first answer, with nothing kept, and with what an earlier one kept?

    python benchmarks/first_answers.py                    # every question, three rounds
    python benchmarks/first_answers.py --only sweep       # one of them, and the peer
    python benchmarks/first_answers.py --tree ../before   # the sources of another checkout

Every answer is that of a process of its own, from its start to its end: import, tracing, compilation, run. "Cold" is
with an empty folder of programs, "kept" with what the cold process left there. The peer is a fixed program of JAX
alone, compiled in the same round: seconds differ between machines and with what else they do, ratios to the peer
hardly. Ratios are of processor time, medians of the rounds.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent

_PAIR = "pair = vijax.impact_pair(0.2, 50.0, 0.5)\n"
_ORBIT = _PAIR + "orbit = vijax.find_orbits(pair, '1:1')\n"
# A hundred loops one after another, each with a body of its own: what XLA makes of them grows with their number alone.
PEER = """
import jax, jax.numpy as jnp
def chain(x):
    for k in range(100):
        x = jax.lax.fori_loop(0, 3, lambda i, x: jnp.sin(x) * (0.9 + 0.001 * k) + jnp.exp(-x * x), x)
    return x
jax.jit(chain)(jnp.linspace(0.0, 1.0, 64)).block_until_ready()
"""
QUESTIONS = {
    "import": "vijax.sweep",
    "trajectory": _PAIR + "vijax.trajectory(pair, 0.0, 0.3, periods=20)",
    "find_orbits": _ORBIT,
    "steady": _PAIR + "device = vijax.Harvester()\n"
    "orbit = vijax.find_orbits(device.pair(), '1:1')[1]\n"
    "jax.grad(lambda omega0: vijax.steady(dataclasses.replace(device, omega0=omega0), orbit).P)(device.omega0)",
    "sweep": "vijax.sweep(d=np.linspace(0.05, 0.3, 8), kappa=np.geomspace(3, 400, 8), r=0.5)",
    "follow_families": _ORBIT + "vijax.follow_families(orbit, 'kappa', (30.0, 80.0))",
    "optimise": "vijax.optimise(vijax.Harvester())",
}


class Answer(NamedTuple):
    """What the process of an answer took: seconds on the clock, and of processors."""

    clock: float
    processor: float


def answer(code: str, folder: Path, tree: Path = HERE.parent) -> Answer:
    """Run a program in a process of its own, with the user's caches in a folder.

    Args:
        code: The program.
        folder: Where programs are kept.
        tree: The checkout whose sources it uses.

    Raises:
        RuntimeError: If it fails; the message is what it wrote.
    """
    # What this process was told of JAX is not what a user's process is told.
    told = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XLA_"))}
    told |= {"XDG_CACHE_HOME": str(folder), "PYTHONPATH": str(tree)}
    command = [sys.executable, "-c", code]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    # Python looks for a module where it is started, before it looks anywhere else.
    done = subprocess.run(command, cwd=tree, env=told, capture_output=True, text=True, check=False)
    clock, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise RuntimeError(f"a question must have an answer; got\n{done.stderr}")
    return Answer(clock, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def program(question: str) -> str:
    """Write the program of a question."""
    return f"import dataclasses, jax, numpy as np, vijax\n{QUESTIONS[question]}\n"


def rounds(questions: list[str], count: int, tree: Path) -> Iterator[tuple[str, Answer, Answer, Answer]]:
    """Ask every question in every round: the question, its cold and its kept answer, and the peer's of that moment."""
    for _ in range(count):
        for question in questions:
            with tempfile.TemporaryDirectory() as folder:
                cold = answer(program(question), Path(folder), tree)
                kept = answer(program(question), Path(folder), tree)
                yield question, cold, kept, answer(PEER, Path(folder), tree)


def main() -> None:
    """Ask, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=QUESTIONS, default=list(QUESTIONS), help="these questions")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--tree", type=Path, default=HERE.parent, help="the checkout whose sources are used")
    given = parser.parse_args()

    found: dict[str, list[tuple[Answer, Answer, Answer]]] = {question: [] for question in given.only}
    for question, *answers in rounds(given.only, given.rounds, given.tree.resolve()):
        found[question].append((answers[0], answers[1], answers[2]))
    print(f"{os.cpu_count()} cores; seconds on the clock, and processor time as a multiple of the peer's")
    for question, every in found.items():
        cold, kept = (statistics.median(answers[which].clock for answers in every) for which in (0, 1))
        ratios = [
            statistics.median(answers[which].processor / answers[2].processor for answers in every) for which in (0, 1)
        ]
        print(f"{question:16} cold {cold:6.2f} s {ratios[0]:6.2f}     kept {kept:6.2f} s {ratios[1]:6.2f}")
    peers = [answers[2].clock for every in found.values() for answers in every]
    print(f"{'peer':16} cold {statistics.median(peers):6.2f} s")


if __name__ == "__main__":
    main()
