"""The command `vijax`: subcommands, the scripts that call them, help, examples, completion."""

import json
import os
import re
import shlex
import subprocess
import sys
from importlib import import_module

import click
import pytest

import vijax
from scripts import grid
from tests.helpers import SCRIPTS, cases
from vijax.cli import main as command
from vijax.cli import process
from vijax.continuation import branch_switching
from vijax.impact.method_choice import choose_method, method_attributes
from vijax.orbits import orbit_search
from vijax.plots import branch_diagrams, orbit_diagrams

ROOT = SCRIPTS.parent
SCRIPT_OF = {"sweep": "grid", "orbit-diagram": "orbit_diagram"} | {
    name: name for name in ("basins", "response", "fit", "branch", "curves", "design", "explore")
}
PAGES = [*SCRIPT_OF, "compare"]
# The number of kappa values gives the same programs as in `maps/test_compare`.
PLANE = ["--d", "0.2,0.3", "--kappa", "100:400:5:log", "--periods", "40"]
# The other subcommands call the functions of the scripts, with the same options, as a test below checks.
RUNS = {
    "sweep": (PLANE, "grid", PLANE),
    "compare": ([*PLANE, "--tolerance", "5%"], "grid", [*PLANE, "--compare", "rigid", "--tolerance", "5%"]),
    "basins": (same := ["--d", "0.2", "--kappa", "3", "--periods", "200", "--v0=-0.6:0.6:12"], "basins", same),
    "branch": (
        same := [*shlex.split("--wall rigid --A 100 --guesses 32 --max-switches 0 --along omega=4.8Hz:5.2Hz")],
        "branch",
        same,
    ),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def page(name: str) -> click.Command:
    return command.vijax.get_command(click.Context(command.vijax), name)


def help_text(arguments: list[str], capsys) -> str:
    assert command.main([*arguments, "--help"]) == 0
    return capsys.readouterr().out


# --- the same as the scripts -----------------------------------------------------------------------------------------


def content(path):
    """Return a file of a store as bytes, without values that differ between runs."""
    if path.name == "lock":
        return b""
    if path.suffix != ".json":
        return path.read_bytes()
    entries = json.loads(path.read_bytes())
    for name in ("seconds", "finished", "store_id", "checksum"):
        entries.pop(name, None)
    return json.dumps(entries).encode()


def written(folder):
    return {str(path.relative_to(folder)): content(path) for path in folder.rglob("*") if path.is_file()}


def timeless(text):
    return re.sub(r"in [\d.]+ s(, [\d.,e+]+ (\w+)/s)?$|^[\d.]+ s from", "in T s", text, flags=re.MULTILINE)


@pytest.mark.parametrize("name", cases(RUNS, long=("branch", "compare")))
def test_the_command_and_the_script_write_and_print_the_same(folder, capsys, monkeypatch, name):
    arguments, script, script_arguments = RUNS[name]
    ends = []
    for place, run in (
        ("command", lambda: command.main([name, *arguments])),
        ("script", lambda: import_module(f"scripts.{script}").main(script_arguments)),
    ):
        (folder / place).mkdir()
        monkeypatch.chdir(folder / place)
        assert run() == 0
        ends.append((written(folder / place), timeless(capsys.readouterr().out)))
    (files, output), (script_files, script_output) = ends
    assert len(files) > 1
    assert files.keys() == script_files.keys()
    assert [file for file in files if files[file] != script_files[file]] == []
    assert output == script_output


@pytest.mark.parametrize("script", SCRIPT_OF.values())
def test_a_script_and_its_subcommand_have_the_same_options(script):
    name = next(page for page, stem in SCRIPT_OF.items() if stem == script)
    theirs = {option.name: option.opts for option in getattr(import_module(f"scripts.{script}"), script).params}
    ours = {option.name: option.opts for option in page(name).params}
    more = {"compare", "tolerance"} if name == "sweep" else set()
    assert theirs == ours | {option: [f"--{option}"] for option in more}


def test_python_m_is_the_command():
    process = subprocess.run(
        [sys.executable, "-m", "vijax", "sweep", "--wall", "x"], capture_output=True, text=True, cwd=ROOT
    )
    message = "error: wall must be among soft, rigid, rigid_left, rigid_right; got 'x'\n"
    assert (process.returncode, process.stderr) == (2, message)


# --- words -----------------------------------------------------------------------------------------------------------

CELL = {"d": 0.2, "kappa": 3.0}
WORDS = {
    "sweep --wall": lambda word: vijax.sweep(**CELL, wall=word),
    "sweep --until": lambda word: vijax.sweep(**CELL, until=word),
    "sweep --dtype": lambda word: vijax.sweep(**CELL, dtype=word),
    "sweep --method": lambda word: vijax.sweep(**CELL, method=word),
    "sweep --method ode --solver": lambda word: vijax.sweep(**CELL, method="ode", solver=word),
    "orbit-diagram --direction": lambda word: vijax.orbit_diagram(along="d", values=[0.2, 0.3], direction=word),
    "orbit-diagram --quantity": orbit_diagrams.check_quantity,
    "branch --quantity": branch_diagrams.check_branch_quantity,
    "design --objective": lambda word: vijax.optimise(objective=word),
    "basins --wall": lambda word: vijax.basins(**CELL, wall=word),
}
LEAST = {
    "sweep --periods 0": lambda: vijax.sweep(**CELL, periods=0),
    "sweep --transient=-1": lambda: vijax.sweep(**CELL, transient=-1),
    "sweep --refine 0": lambda: vijax.sweep(**CELL, refine=0),
    "sweep --workers 0": lambda: vijax.sweep(**CELL, workers=0, out="map.zarr"),
    "sweep --method rk4 --steps 7": lambda: vijax.sweep(**CELL, method="rk4", steps=7),
    "sweep --method ode --atol 0": lambda: vijax.sweep(**CELL, method="ode", atol=0.0),
    "sweep --chi=-1": lambda: vijax.HuntCrossley(-1.0),
    "sweep --exponent 0.5": lambda: vijax.HuntCrossley(1.0, 0.5),
    "sweep --prestretch 1": lambda: vijax.Hyperelastic(1.0, 0.1),
    "sweep --radius 0": lambda: vijax.Hyperelastic(2.0, 0.0),
    "orbit-diagram --recorded-periods 0": lambda: vijax.orbit_diagram(along="d", values=[0.2, 0.3], recorded_periods=0),
    "basins --starts 0": lambda: vijax.basin_fractions(**CELL, starts=0),
    "basins --seed=-1": lambda: vijax.basin_fractions(**CELL, starts=4, seed=-1),
    "basins --speed 0": lambda: vijax.basin_fractions(**CELL, starts=4, speed=0.0),
    "branch --guesses 0": lambda: orbit_search.find_orbits(vijax.impact_pair(0.2, 3.0, 0.5), "1:1", guesses=0),
    "branch --max-switches=-1": lambda: branch_switching.follow_families(None, "d", (0.1, 0.2), max_switches=-1),
    "curves --max-rounds=-1": lambda: vijax.bifurcation_curves(None, max_rounds=-1),
    "curves --max-seconds 0": lambda: vijax.bifurcation_curves(None, max_seconds=0.0),
    "design --survey-points 1": lambda: vijax.optimise(survey_points=1),
    "design --starts 0": lambda: vijax.optimise(starts=0),
    "design --max-impacts 0": lambda: vijax.optimise(max_impacts=0),
}


@pytest.mark.parametrize("line", WORDS)
def test_an_invalid_choice_has_the_error_of_the_python_function(folder, capsys, line):
    assert command.main([*line.split(), "x"]) == 2
    with pytest.raises(ValueError, match="must be") as refused:
        WORDS[line]("x")
    assert capsys.readouterr().err == f"error: {refused.value}\n"


@pytest.mark.parametrize("line", LEAST)
def test_a_value_below_the_minimum_has_the_error_of_the_python_function(folder, capsys, line):
    assert command.main(line.split()) == 2
    with pytest.raises(ValueError, match="must be") as refused:
        LEAST[line]()
    assert capsys.readouterr().err == f"error: {refused.value}\n"


# --- help ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["solver", "rtol", "atol", "steps", "exponent", "stretch_limit"])
def test_defaults_in_help_equal_defaults_of_the_methods(name):
    (option,) = [option for option in page("sweep").params if option.name == name]
    settings = [method_attributes(choose_method(engine, {})) for engine in ("ode", "rk4")]
    laws = {"exponent": vijax.HuntCrossley(0.5).exponent, "stretch_limit": vijax.Hyperelastic(2, 0.1).stretch_limit}
    default = {**laws, **settings[0], **settings[1]}[name]
    assert type(default)(re.search(r"\[(.+)\]$", option.help)[1]) == default


@pytest.mark.parametrize("name", PAGES)
def test_help_lists_all_options_by_section_and_ends_with_the_examples(capsys, name):
    text = help_text([name], capsys)
    *sections, examples = re.split(r"\n(?=\w[^\n]*:\n)", text)
    for (title, options), section in zip(page(name).sections.items(), sections[1:], strict=True):
        assert section.startswith(f"{title}:\n")
        listed = re.findall(r"^  (--[\w-]+)", section.split("\n\n")[0], re.MULTILINE)
        expected = [option.opts[0] for option in options if isinstance(option, click.Option)]
        assert [option for option in listed if option != "--help"] == expected
    assert text.count("  --help  ") == 1
    assert examples.splitlines()[0] == "Examples:"
    assert [line.split(name, 1)[1].strip() for line in examples.splitlines()[1:]] == list(page(name).examples)


def test_help_needs_no_jax():
    code = (
        "import sys; from vijax.cli.main import main; from scripts import grid; "
        f"codes = [main([*page, '--help']) for page in ([], *([name] for name in {PAGES}))]; "
        "print(codes, grid.main(['--help']), {'jax', 'numpy', 'xarray', 'matplotlib'} & set(sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert result.stdout.splitlines()[-1] == f"{[0] * (1 + len(PAGES))} 0 set()"


def test_the_bare_command_lists_subcommands_and_version(capsys):
    assert command.main([]) == 0
    output = capsys.readouterr().out
    assert re.findall(r"^  ([a-z][a-z-]+)  +[A-Z].*[^.]\.$", output, re.M) == list(command.vijax.list_commands(None))
    assert command.main(["--version"]) == 0
    assert re.fullmatch(r"vijax \d+\.\d+\.\d+\n", capsys.readouterr().out)


# --- examples --------------------------------------------------------------------------------------------------------


class StartedError(Exception):
    """Raised where a run starts."""


@pytest.fixture
def stop_at_start(folder, monkeypatch):
    """End runs with valid arguments where the progress bar would start."""

    def bar(*_, **__):
        raise StartedError

    bar.write = print
    # Files that examples read.
    (folder / "impacts.txt").write_text("".join(f"{0.1 * k} {(-1) ** k} 0.2\n" for k in range(1, 9)))
    (folder / "bench.csv").write_text("".join(f"{0.01 * k},0.5\n" for k in range(100)))
    monkeypatch.setattr("tqdm.tqdm", bar)


# The explorer has no progress bar, so the fixture cannot end it; tests/explorer starts it.
BARS = [name for name in PAGES if name != "explore"]


@pytest.mark.parametrize("line", [f"{name} {line}".strip() for name in BARS for line in page(name).examples])
def test_examples_have_valid_arguments(stop_at_start, line):
    with pytest.raises(StartedError):
        command.main(shlex.split(line))


@pytest.mark.parametrize("line", grid.grid.examples)
def test_examples_of_the_script_have_valid_arguments(stop_at_start, line):
    with pytest.raises(StartedError):
        grid.main(shlex.split(line))


# --- completion ------------------------------------------------------------------------------------------------------


@pytest.fixture
def completed(monkeypatch, capsys):
    """Return a function that completes the last word of a command line as a shell does."""

    def complete(line):
        monkeypatch.setenv("_VIJAX_COMPLETE", "bash_complete")
        monkeypatch.setenv("COMP_WORDS", line)
        monkeypatch.setenv("COMP_CWORD", str(line.count(" ")))
        with pytest.raises(SystemExit) as ended:
            command.vijax.main([], prog_name="vijax")
        assert ended.value.code == 0
        return [item.partition(",")[2] for item in capsys.readouterr().out.split()]

    return complete


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            "vijax ",
            [
                "sweep",
                "compare",
                "orbit-diagram",
                "basins",
                "response",
                "fit",
                "branch",
                "curves",
                "design",
                "explore",
                "docs",
                "doctor",
            ],
        ),
        ("vijax b", ["basins", "branch"]),
        ("vijax sweep --me", ["--method", "--membrane"]),
        ("vijax sweep --wall ", ["soft", "rigid", "rigid_left", "rigid_right"]),
        ("vijax sweep --method ode --solver Dop", ["Dopri5", "Dopri8"]),
        ("vijax compare --compar", []),
        ("vijax orbit-diagram --direction d", ["down"]),
        ("vijax branch --quantity m", ["multiplier"]),
        ("vijax design --objective ", ["P", "power", "speed", "mean", "worst", "expected"]),
        ("vijax sweep --show l", ["lyapunov", "label"]),
        ("vijax curves --ground l", ["lyapunov", "label"]),
        ("vijax sweep --outputs P,peri", ["P,period", "P,periods_run"]),
    ],
)
def test_a_shell_completes_subcommands_options_and_choices(completed, line, words):
    assert sorted(completed(line)) == sorted(words)


@pytest.mark.parametrize(
    ("shell", "words", "expected"),
    [
        ("zsh", {"COMP_WORDS": "vijax sweep --wall=so", "COMP_CWORD": "2"}, "plain\n--wall=soft\n_\n"),
        ("fish", {"COMP_WORDS": "vijax sweep --wall=so", "COMP_CWORD": "--wall=so"}, "plain,--wall=soft\n"),
        ("fish", {"COMP_WORDS": "vijax sweep --show", "COMP_CWORD": "lab"}, "plain,label\n"),
    ],
)
def test_a_shell_that_joins_option_and_value_gets_both_completed(monkeypatch, capsys, shell, words, expected):
    for name, value in {"_VIJAX_COMPLETE": f"{shell}_complete", **words}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        command.vijax.main([], prog_name="vijax")
    assert capsys.readouterr().out == expected


def test_fish_splits_completions_at_the_first_comma(monkeypatch, capsys):
    monkeypatch.setenv("_VIJAX_COMPLETE", "fish_source")
    with pytest.raises(SystemExit):
        command.vijax.main([], prog_name="vijax")
    assert 'string split --max 1 "," $completion' in capsys.readouterr().out


@pytest.mark.parametrize("code", [1, 130, 143])
def test_a_process_exits_at_once_after_an_unfinished_run(code):
    """A compiled call on a thread cannot be stopped, so the exit waits for no thread."""
    busy = "import threading, time; threading.Thread(target=time.sleep, args=(60,)).start(); "
    line = f"{busy}from vijax.cli.process import leave; leave({code})"
    assert subprocess.run([sys.executable, "-c", line], timeout=30).returncode == code


@pytest.mark.parametrize("code", [0, 2])
def test_garbage_is_not_collected_at_exit(code):
    """A trace leaves a hundred thousand cyclic records; the end of the process frees them."""
    circle = "Circle = type('Circle', (), {'__del__': lambda self: print('found')}); one = Circle(); one.me = one; "
    line = f"{circle}from vijax.cli.process import leave; leave({code})"
    result = subprocess.run([sys.executable, "-c", line], timeout=30, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (code, "")


ROLLED = "xla_cpu_disable_loop_unrolling"


@pytest.mark.parametrize(
    ("user_flags", "flags_of_run"),
    [
        (None, f"--xla_backend_extra_options={ROLLED}"),
        ("--xla_flag=1", f"--xla_flag=1 --xla_backend_extra_options={ROLLED}"),
        ("--xla_backend_extra_options=a", "--xla_backend_extra_options=a"),
    ],
)
def test_loops_are_not_unrolled_while_a_command_runs(user_flags, flags_of_run, monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    if user_flags:
        monkeypatch.setenv("XLA_FLAGS", user_flags)
    flags = []
    probe = click.Command("look", callback=lambda: flags.append(os.environ["XLA_FLAGS"]))
    assert process.run(probe, []) == 0
    assert flags == [flags_of_run]
    assert os.environ.get("XLA_FLAGS") == user_flags


@pytest.mark.long
def test_bash_completes_after_the_line_in_the_documentation(tmp_path):
    """The command has the name that a wheel installs."""
    (line,) = set(re.findall(r'`(eval "[^`]*")`', (ROOT / "docs/maps.md").read_text(encoding="utf-8")))
    stub = tmp_path / "vijax"
    stub.write_text(f"#!{sys.executable}\nfrom vijax.__main__ import command\ncommand()\n")
    stub.chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    completion = 'COMP_WORDS=(vijax sweep --wall s) COMP_CWORD=3; _vijax_completion vijax; echo "${COMPREPLY[@]}"'
    result = subprocess.run(["bash", "-c", f"{line}; {completion}"], capture_output=True, text=True, env=environment)
    assert result.stdout == "soft\n", result.stderr
    assert line in " ".join(command.vijax.get_help(click.Context(command.vijax)).split())
