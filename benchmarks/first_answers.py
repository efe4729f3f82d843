"""How long does a new Python process take to its first result, without stored programs, and with stored ones?

    python benchmarks/first_answers.py                    # every question, three rounds: an hour
    python benchmarks/first_answers.py --only sweep       # one of them, and the peer
    python benchmarks/first_answers.py --tree ../before   # the sources of another checkout

Every answer is a separate process, measured from its start to its end: import, tracing, compilation, run. "Cold" means
an empty folder of programs, "kept" the programs that the cold process stored. The peer is a fixed program of JAX alone,
compiled in the same round: seconds differ between machines and loads, ratios to the peer hardly. Ratios are of
processor time, medians of the rounds.
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
_MAP = "d=np.linspace(0.05, 0.3, 8), kappa=np.geomspace(3, 400, 8), r=0.5"
_FAMILY = _ORBIT + "branches = vijax.follow_families(orbit, 'kappa', (30.0, 80.0))\n"
_IMPACTS = (
    "device = vijax.Harvester(s=0.02, omega=10.0, A=3.0, omega0=60.0, r=0.6)\n"
    "run = vijax.trajectory(device.pair(), 0.0, 0.3, periods=100)\n"
    "n, t, sides = (np.asarray(x)[: int(run.filled)] for x in (run.impacts.n, run.impacts.t, run.impacts.side))\n"
    "guess = dataclasses.replace(device, r=0.55)\n"
)
_DESIGN = (
    "device = vijax.Harvester(omega=10 * np.pi, s=0.006, A=3.0, V=1700.0)\n"
    "design = vijax.optimise(device, survey_points=128, starts=1, max_impacts=2)\n"
)
# A hundred loops in sequence, each with its own body: XLA's work grows with their number alone.
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
    "trajectory by steps": _PAIR + "vijax.trajectory(pair, 0.0, 0.3, periods=20, method='ode')",
    "trajectory's gradient": _PAIR + "jax.grad(lambda v: vijax.trajectory(pair, 0.0, v, periods=20).states.u[-1])(0.3)",
    "trajectory's jitted hessian": "def place(x):\n"
    "    return vijax.trajectory(vijax.impact_pair(0.2, x[0], x[1]), 0.02, x[2], periods=12).states.u[-1]\n"
    "jax.jit(jax.hessian(place))(np.array([50.0, 0.5, 0.3]))",
    "find_orbits": _ORBIT,
    "find_orbits of a law": "pair = vijax.impact_pair(0.2, 40.0, None)\n"
    "vijax.find_orbits(pair, 'LR', membrane=vijax.HuntCrossley(0.3))",
    "orbits_from_states": _PAIR + "vijax.orbits_from_states(pair, 0.0, 0.3)",
    "what an orbit does": _ORBIT + "vijax.orbit_impacts(orbit), vijax.orbit_path(orbit), vijax.orbit_labels(orbit)\n"
    "device = vijax.Harvester()\n"
    "vijax.orbit_power(orbit, device), vijax.harvested_energy(device, 1e-3)",
    "steady": _PAIR + "device = vijax.Harvester()\n"
    "orbit = vijax.find_orbits(device.pair(), '1:1')[1]\n"
    "jax.grad(lambda omega0: vijax.steady(dataclasses.replace(device, omega0=omega0), orbit).P)(device.omega0)",
    "steady under harmonics": "device, pair = vijax.Harvester(), vijax.impact_pair(0.2, 40.0, 0.5, 0.02)\n"
    "waves = vijax.Harmonics([1.0, 0.3, 0.1], [0.0, 0.7, -1.0])\n"
    "orbit = vijax.orbits_from_states(pair, 0.0, 0.1, settle=100, excitation=waves)[0]\n"
    "jax.grad(lambda kappa: vijax.steady(device, orbit, pair=dataclasses.replace(pair, kappa=kappa)).P)(40.0)",
    "sweep": f"vijax.sweep({_MAP})",
    "compare": f"found = vijax.compare({_MAP})\nvijax.rigid_from(vijax.cheapest_model(found, 0.1))",
    "basins": "vijax.basins(d=0.2, kappa=50.0, r=0.5, u0=np.linspace(-0.09, 0.09, 8), v0=np.linspace(-0.5, 0.5, 8))",
    "basin_fractions": "vijax.basin_fractions(d=0.2, kappa=50.0, r=0.5)",
    "orbit_diagram": "vijax.orbit_diagram(along='d', values=np.linspace(0.1, 0.3, 16), kappa=50.0, r=0.5)",
    "lyapunov": "vijax.lyapunov(d=0.12, kappa=400.0, r=0.5)",
    "survival": "vijax.survival(d=0.12, kappa=400.0, r=0.5)",
    "response": "vijax.response(vijax.Harvester(), vijax.Harmonics() + vijax.Noise(0.01, 32))",
    "follow_orbits": _ORBIT + "vijax.branch_dataset(vijax.follow_orbits(orbit, 'kappa', (30.0, 80.0)))",
    "follow_families": _FAMILY,
    "limit_points": _FAMILY + "vijax.limit_points(branches, device=vijax.Harvester())",
    "follow_curves": "orbit = vijax.find_orbits(vijax.impact_pair(0.19, None, 0.5), 'RLL')\n"
    "points = vijax.follow_orbits(orbit[:1], 'd', (0.18, 0.21), direction='up')[0].points\n"
    "folds = [point for point in points if point.kind == 'fold']\n"
    "curves = vijax.follow_curves(folds, 'd', {'d': (0.1, 0.3), 'r': (0.4, 0.6)})\n"
    "vijax.curve_rows(vijax.curve_dataset(curves))",
    "curves_about": _ORBIT + "vijax.curves_about(orbit[:1], {'d': (0.1, 0.3), 'kappa': (30.0, 80.0)})",
    "bifurcation_curves": f"found = vijax.sweep({_MAP})\nvijax.bifurcation_curves(found, max_rounds=1)",
    "fit": _IMPACTS + "times = (2 * n + t) * np.pi / device.omega\n"
    "vijax.fit(times, sides, timing_error=1e-4, device=guess, unknown=('omega0', 'r'))",
    "average": "vijax.average(vijax.Harvester())",
    "optimise": "vijax.optimise(vijax.Harvester())",
    "tolerance_statistics": _DESIGN + "vijax.tolerance_statistics(design.best, [vijax.Tolerance('omega0', 0.05)])",
    "surroundings": _DESIGN + "vijax.surroundings(design.best)",
    "maximise_basin_power": _DESIGN + "vijax.maximise_basin_power(design)",
    "tolerance_plane": _DESIGN
    + "vijax.tolerance_plane(design.best, [vijax.Tolerance('omega0', 0.05), vijax.Tolerance('s', 0.05)])",
    "parameter_ranges": _DESIGN + "vijax.parameter_ranges(design.best)",
    "arrival_statistics": _DESIGN + "vijax.arrival_statistics(design.best)",
}


class Answer(NamedTuple):
    """Seconds of an answer's process: elapsed time, and processor time."""

    clock: float
    processor: float


def answer(code: str, folder: Path, tree: Path = HERE.parent) -> Answer:
    """Run a program in a separate process, with the user's caches in a folder.

    Args:
        code: The program.
        folder: Folder of the stored programs.
        tree: The checkout with the sources.

    Raises:
        RuntimeError: The program failed; the message is its output.
    """
    # Settings of JAX in this process must not reach the process of a user.
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XLA_"))}
    environment |= {"XDG_CACHE_HOME": str(folder), "PYTHONPATH": str(tree)}
    command = [sys.executable, "-c", code]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    # Python searches the working directory for modules first.
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
    clock, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise RuntimeError(f"a question must have an answer; got\n{done.stderr}")
    return Answer(clock, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def program(question: str) -> str:
    """Return the program of a question."""
    return f"import dataclasses, jax, numpy as np, vijax\n{QUESTIONS[question]}\n"


def rounds(questions: list[str], count: int, tree: Path) -> Iterator[tuple[str, Answer, Answer, Answer]]:
    """Run every question in every round; yield it with its cold and kept answer and the peer's answer."""
    for _ in range(count):
        for question in questions:
            with tempfile.TemporaryDirectory() as folder:
                cold = answer(program(question), Path(folder), tree)
                stored = answer(program(question), Path(folder), tree)
                yield question, cold, stored, answer(PEER, Path(folder), tree)


def main() -> None:
    """Run the questions, and print their times."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=QUESTIONS, default=list(QUESTIONS), help="these questions")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--tree", type=Path, default=HERE.parent, help="the checkout whose sources are used")
    options = parser.parse_args()

    answers_of: dict[str, list[tuple[Answer, Answer, Answer]]] = {question: [] for question in options.only}
    for question, *answers in rounds(options.only, options.rounds, options.tree.resolve()):
        answers_of[question].append((answers[0], answers[1], answers[2]))
    print(f"{os.cpu_count()} cores; seconds on the clock, and processor time as a multiple of the peer's")
    for question, answer_list in answers_of.items():
        cold, stored = (statistics.median(answers[index].clock for answers in answer_list) for index in (0, 1))
        ratios = [
            statistics.median(answers[index].processor / answers[2].processor for answers in answer_list)
            for index in (0, 1)
        ]
        print(f"{question:27} cold {cold:6.2f} s {ratios[0]:6.2f}     kept {stored:6.2f} s {ratios[1]:6.2f}")
    peers = [answers[2].clock for answer_list in answers_of.values() for answers in answer_list]
    print(f"{'peer':27} cold {statistics.median(peers):6.2f} s")


if __name__ == "__main__":
    main()
