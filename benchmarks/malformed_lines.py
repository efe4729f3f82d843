"""Malformed command lines, from tables: a script, one of its options, and texts that it must reject."""

from collections.abc import Iterator
from functools import partial
from importlib import import_module

from benchmarks.malformed import HUGE, Case

# Invalid texts of an axis, and axes of excessive size.
VALUES = (
    *("", "x", "1,,2", "0.1;0.2", "nan", "1,inf", "1e999", "@", "@nowhere", "@.", "@/dev/zero", "@/dev/null"),
    *("1:2", ":::", "1:2:0", "1:2:-3", "1:2:2.5", "1:2:1e3", "0.1:0.3:100000000", "0.1:0.3:1000000000000"),
    *(f"0.1:0.3:{HUGE}", "1:2:3:lin", "1:2:3:log:4", "0:1:5:log", "2pip", "١٢:3"),
)
POSITIVE = (*VALUES, "0", "-1")
WHOLES = ("", "x", "1.5", "nan", "1e3", "-1", "1e20", str(HUGE), "0x10", "True", "1_0x")
COUNTS = (*WHOLES, "0")
REALS = ("", "x", "nan", "inf", "1e999", "1,2", "0.1:0.2", "True")
WORDS = ("", "x", "SOFT ", "1", "soft,rigid")
SETS = ("", "=1", "V", "V=", "V=x", "V=nan", "m_b=0", "mass=1", "r=0.3", "V=1=2", "m_b=1e999", "=")
OUT = ("", ".", "map.nc", "nowhere/map.zarr", "/proc/map.zarr", "/proc", "/dev/null/map.zarr", "/dev/null", "\0.zarr")
PLOT = ("", ".", "map", "map.doc", "nowhere/map.png", "/proc/map.png", "/dev/null/map.png", "/dev/null")

_SMALL = ("--d", "0.1:0.2:3", "--kappa", "10:20:3")
Lines = dict[str, tuple[tuple[str, ...], dict[str, tuple[str, ...]]]]

# By script: the valid part of a line, and invalid texts by option; an option's second word may replace its name in the
# error.
LINES: Lines = {
    "grid": (
        (*_SMALL, "--periods", "40"),
        {
            "d": POSITIVE,
            "kappa": POSITIVE,
            "r": ("2", "0", "", "half", "1:2:3"),
            "gamma": ("nan", "x", "@/dev/zero"),
            "omega": ("0", "x", "1:2", "-pi"),
            "omega0": ("0", "x"),
            "A": ("0", "1 g"),
            "beta": ("nan", "steep"),
            "u0": ("x", "nan", "-1:1:5:log"),
            "v0": ("x", "inf", "1:2:0"),
            "periods": COUNTS,
            "transient": WHOLES,
            "until": WORDS,
            "wall": WORDS,
            "method": WORDS,
            "dtype": WORDS,
            "show": WORDS,
            "outputs": ("", "Q", "P,Q", "P;period", ",", "P"),
            "set": SETS,
            "refine": (*COUNTS, "9"),
            "out": OUT,
            "plot": PLOT,
            "workers": COUNTS,
            "scheduler": ("", "somewhere", "tls://127.0.0.1:1", "tcp://127.0.0.1:1", "://", "tcp://", "http://x:1"),
            "compare": ("", "soft", "x"),
            "tolerance": ("0.05", "x"),
            "solver": ("Tsit5",),
            "steps": ("100",),
            "rtol": ("1e-8",),
            "chi": ("0.5",),
            "membrane": ("rubber", "hunt-crossley"),
            "unknown": ("1",),
        },
    ),
    "grid --compare rigid": (
        (*_SMALL, "--compare", "rigid"),
        {
            "tolerance": (*REALS, "0", "-0.1", "0%", "-5%", "%", "5 percent", "nan%"),
            "wall": ("rigid",),
            "outputs": ("P",),
            "u0": ("0.2",),
            "refine": ("2",),
            "method": ("ode",),
            "show": ("label",),
        },
    ),
    "grid --method ode": (
        (*_SMALL, "--method", "ode"),
        {
            "rtol": (*REALS, "0", "-1"),
            "atol": (*REALS, "0", "-1"),
            "solver": ("", "Euler", "tsit5"),
            "wall": ("rigid",),
            "chi": ("0.5",),
            "steps": ("100",),
        },
    ),
    "grid --method rk4": ((*_SMALL, "--method", "rk4"), {"steps": (*COUNTS, "4")}),
    "orbit_diagram": (
        ("--along", "d=0.2:0.3:4", "--kappa", "40"),
        {
            "along": ("", "d", "d=", "=1:2:3", "u0=0:1:3", "mass=1:2:3", "d=0.2", "d=1:2", "d=@/dev/zero", "d=x,1"),
            "direction": WORDS,
            "kappa": ("0", "x", "1:2", "@nowhere", f"3:4:{HUGE}"),
            "r": ("2",),
            "periods": COUNTS,
            "recorded-periods recorded_periods": (*COUNTS, "401"),
            "wall": WORDS,
            "dtype": WORDS,
            "quantity": WORDS,
            "set": SETS,
            "out": OUT,
            "plot": PLOT,
            "d": ("0.1",),
        },
    ),
    "basins": (
        ("--d", "0.2", "--kappa", "3", "--u0", "0:0.1:3", "--v0", "0:0.5:3"),
        {
            "d": ("0", "x", "@/dev/zero", "0.1:0.3:100000000"),
            "u0": ("x", "nan", "0:1:0"),
            "v0": ("x", "inf", f"0:1:{HUGE}"),
            "periods": COUNTS,
            "wall": WORDS,
            "speed": ("0.6", "x"),
            "seed": ("1", "x"),
            "set": ("=1", "V=x", "kappa=3"),
            "out": OUT,
            "plot": PLOT,
        },
    ),
    "basins --starts": (
        ("--d", "0.2,0.25", "--kappa", "3,4", "--starts", "4"),
        {
            "starts": (*COUNTS, "1e20", "10000000000"),
            "speed": (*REALS, "0", "-0.6"),
            "seed": ("", "x", "-1", "1.5", str(HUGE), "1e3"),
            "u0": ("0.1",),
        },
    ),
    "branch": (
        ("--d", "0.2", "--kappa", "40", "--along", "d=0.1:0.3"),
        {
            "along": ("", "d", "d=", "=0.1:0.3", "d=0.1", "d=0.1:0.2:3", "d=0.3:0.1", "d=x:1", "mass=0:1"),
            "impacts": ("", "x", "0:0", "1:1/0T", "99999999999:1", "1000:1000", "-1:1", "1:1:1", "R" * 5000, "1:1/T"),
            "guesses": (*COUNTS, "10000000000"),
            "max-switches max_switches": WHOLES,
            "d": ("0", "0.1,0.2", "x"),
            "kappa": ("0", "x", "inf"),
            "wall": WORDS,
            "quantity": WORDS,
            "set": ("=1", "V=x"),
            "out": OUT,
            "plot": PLOT,
        },
    ),
    "curves": (
        (*_SMALL, "--periods", "40"),
        {
            "map": ("", "nowhere.zarr", ".", "/dev/null", "\0.zarr"),
            "d": ("0", "x", "0.2"),
            "kappa": ("0", "x", "3"),
            "r": ("2", "half"),
            "periods": COUNTS,
            "wall": WORDS,
            "max-rounds max_rounds": WHOLES,
            "max-seconds max_seconds": (*REALS, "0", "-1"),
            "ground": WORDS,
            "set": SETS,
            "out": OUT,
            "csv": ("", ".", "curves.txt", "nowhere/curves.csv", "/proc", "/dev/null"),
            "plot": PLOT,
            "unknown": ("1",),
        },
    ),
    "explore": (
        ("--no-browser",),
        {
            "port": ("-1", "x", "1.5", "65536"),
            "address": ("", "nowhere", "0.0.0.0"),
            "curves": ("", ".", "nowhere.zarr", "curves.csv", "/dev/null", "\0.zarr"),
            "allow-origin allow_origin": ("", "*", "http://lab:5006", "lab:port", "lab:70000", "a b"),
            "unknown": ("1",),
        },
    ),
    "explore elsewhere": (
        ("--no-browser", "--port", "0", "--allow-origin", "lab:5006"),
        {"address": ("nowhere.invalid", "203.0.113.1", "1.2.3.4.5")},
    ),
    "design": (
        ("--d", "0.2", "--survey-points", "8"),
        {
            "tune": ("", ",", "mass", "omega0,k", "omega0;r"),
            "bounds": (
                "",
                "omega0",
                "omega0=",
                "omega0=1",
                "omega0=2:1",
                "omega0=x:1",
                "r=0.1:0.2",
                "mass=1:2",
                "=1:2",
            ),
            "tolerance": (
                "",
                "omega0",
                "omega0=",
                "omega0=x",
                "omega0=0",
                "omega0=-5%",
                "omega0=200%",
                "mass=5%",
                "=5%",
            ),
            "objective": (*WORDS, "mean", "worst"),
            "survey-points survey_points": (*COUNTS, "1", "10000000000"),
            "starts": (*COUNTS, "10000000000"),
            "max-impacts max_impacts": (*COUNTS, "10000000000"),
            "diagram-points diagram_points": (*COUNTS, "1", "10000000000"),
            "basin-starts basin_starts": (*COUNTS, "10000000000"),
            "curves": ("", "omega0", "omega0,s", "mass,s", ",", "omega0;s"),
            "over": ("", "d", "r", "r=", "r=x", "r=0", "=1", "omega0=20:40:3", "mass=1", "u0=0.1", "d=0.1:0.2:3"),
            "d": ("0", "0.1,0.2", "x"),
            "set": ("=1", "V=x"),
            "set V": ("V=0",),
            "out": ("", "design.txt", "nowhere/design.json", "/proc", "/proc/design.json"),
            "plot": PLOT,
        },
    ),
    "paper": (
        (),
        {
            "figure": ("", "x", "2", "99", "3,,4", "-1", "3-5", "three"),
            "into": ("nowhere", "/proc", "/dev/null"),
            "unknown": ("1",),
        },
    ),
}
# Lines of another form: a script, its arguments, and the name in the error.
SHAPES = (
    ("grid", ("--d",), "d"),
    ("grid", ("map.zarr",), "map.zarr"),
    ("grid", ("--d", "0.1:0.2:3", "--s", "0.3"), "s"),
    ("grid", ("--gamma", "0.1", "--beta", "0.1"), "beta"),
    ("grid", ("--d", "0.1", "--kappa", "30", "--plot", "one.png"), "plot"),
    ("grid", ("--omega", "3:12:50"), "omega"),
    ("grid", ("--workers", "2", "--scheduler", "tcp://127.0.0.1:1"), "workers"),
    ("grid", ("--workers", "2", "--plot", "map.png"), "workers"),
    ("grid", ("--overwrite=yes",), "overwrite"),
    ("grid", ("--d", "0.1:0.3:100000", "--kappa", "3:40:100000", "--plot", "map.png"), "kappa"),
    ("grid", ("--d", "0.1:0.3:100000", "--kappa", "3:40:100000", "--out", "map.zarr"), "yes"),
    ("grid", ("--compare", "rigid", "--d", "0.1:0.3:100000", "--kappa", "3:40:100000"), "kappa"),
    ("grid", ("--omega", "3:9:10000000", "--omega0", "20:400:10000000"), "omega0"),
    ("basins", ("--u0", "0:0.1:10000000", "--v0", "0:0.1:10000000"), "v0"),
    ("basins", ("--starts", "10000000", "--d", "0.1:0.3:100", "--kappa", "3:40:100"), "starts"),
    ("basins", ("--starts", "100000", "--d", "0.1:0.3:20", "--kappa", "3:40:20", "--periods", "100000"), "yes"),
    ("basins", ("--starts", "9", "--u0", "0.1"), "u0"),
    ("basins", ("--merge-mirrors", "--gamma", "0.1"), "merge_mirrors"),
    ("orbit_diagram", ("--along", "d=0.1:0.3:100000", "--periods", "100000"), "yes"),
    (
        "orbit_diagram",
        ("--along", "d=0.1:0.3:1000000", "--kappa", "3:40:10", "--recorded-periods", "400"),
        "recorded_periods",
    ),
    ("branch", ("--wall", "rigid", "--along", "kappa=3:40"), "along"),
    ("branch", ("--impacts", "6:9", "--guesses", "10000000"), "guesses"),
    ("design", ("--survey-points", "100000", "--starts", "1000"), "starts"),
    ("design", ("--survey-points", "10000", "--starts", "400"), "yes"),
    ("design", ("--over", "d=0.1:0.3:10000", "--s", "0.2"), "s"),
    ("paper", (), "figure"),
    ("paper", ("--figure",), "figure"),
)
# By script: the equivalent subcommand, which must reject the same texts.
_PAGES = {"grid": "sweep", "orbit_diagram": "orbit-diagram", "basins": "basins", "branch": "branch", "design": "design"}
# Lines of the command alone: its arguments, and the name in the error.
COMMANDS = (
    (("swep",), "swep"),
    (("grid",), "grid"),
    (("--periods", "3"), "periods"),
    (("--version=2",), "version"),
    (("sweep", "compare"), "compare"),
    (("sweep", "--compare", "rigid"), "compare"),
    (("sweep", "--tolerance", "5%"), "tolerance"),
    (("compare", "--method", "ode"), "method"),
    (("compare", "--refine", "2"), "refine"),
    (("compare", "--wall", "rigid"), "wall"),
    (("compare", "--compare", "rigid"), "compare"),
    (("orbit-diagram", "--direction"), "direction"),
    (("orbit_diagram",), "orbit_diagram"),
)
# Further arguments of a line, without which the option is not read.
_WITH = {"into": ("--figure", "3")}
_MODULES = {"paper": "paper.__main__"}


def lines() -> Iterator[Case]:
    """Yield the malformed command lines, each run in the current folder."""
    for script, arguments, name in (*_of_tables(), *SHAPES):
        yield Case(_short(script, *arguments), (name,), partial(_run, script, arguments))
    for arguments, name in (*_of_pages(), *COMMANDS):
        yield Case(_short("vijax", *arguments), (name,), partial(_run, "vijax", arguments))


def _short(*words: str) -> str:
    """Shorten a line for display."""
    line = " ".join(words)
    return line if len(line) <= 100 else f"{line[:35]} ... {line[-60:]}"


def _of_tables() -> Iterator[tuple[str, tuple[str, ...], str]]:
    """Yield a script, its arguments, and the name in the error."""
    for title, (valid, invalid) in LINES.items():
        for option, texts in invalid.items():
            words = option.split()
            for text in texts:
                yield title.split()[0], (*valid, *_WITH.get(option, ()), f"--{words[0]}={text}"), words[-1]


def _of_pages() -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the same lines for the command: a subcommand and its arguments, and the name in the error."""
    for script, arguments, name in (*_of_tables(), *SHAPES):
        if "--compare" in arguments:  # this is a separate subcommand
            at = arguments.index("--compare")
            yield ("compare", *arguments[:at], *arguments[at + 2 :]), name
        elif script in _PAGES:
            yield (_PAGES[script], *arguments), name


def _run(script: str, arguments: tuple[str, ...]) -> int:
    """Run a script, or the command, in this process; return its exit code."""
    from vijax.cli import main, process

    if script == "vijax":
        return main.main(list(arguments))
    module = import_module(f"scripts.{_MODULES.get(script, script)}")
    return process.run(getattr(module, script), list(arguments))
