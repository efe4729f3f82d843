"""The paper's figures 3 to 16 as data: the runs behind the figures and the content of every panel.

Where a caption is incomplete or wrong, the field `chosen` of the figure states the choice made here. `paper.figures`
draws the figures.
"""

from typing import Any, NamedTuple

import numpy as np

from vijax.maps.orbit_diagram import Direction
from vijax.model.choices import Walls

PERIODS, RECORDED_PERIODS = 400, 25  # forcing periods of every point of a diagram: simulated, and drawn
SECTION_PERIODS = 3000  # points of a Poincare section of chaos; 25 points are too few

STIFFNESSES = (400.0, 126.5, 40.0, 12.65, 4.0)  # kappa of Figs. 8-11
SPRINGS = (560.0, 56.0, 5.6, 0.56, 0.056)  # k [N/m] of Figs. 12-16: omega0 = 400, 126.5, 40, 12.65, 4 rad/s
COLOURS = ("black", "tab:blue", "tab:green", "tab:orange", "tab:purple")  # of kappa and of k, the stiffest first
RESTITUTIONS = (0.5, 0.1, 0.95)

GAP_IN_METRES = 0.2  # of Figs. 12-16

GAPS = tuple(np.round(np.arange(0.3, 0.0499, -0.002), 3).tolist())
PHASE_PLANES = (0.16, 0.18, 0.2)  # d of Figs. 3 and 5
UNSTABLE_AT = 0.18  # d of the red 1:2 orbit
# Rigid branches over d: where 1:1 and 1:2 coexist, and how far they are followed (to the end of 1:1 in Fig. 12).
BRANCHES_FROM, BRANCHES_WITHIN = 0.19, (0.05, 1.1)
STIFFNESS_SWEEP = tuple((400 / np.arange(1, 134)).tolist())  # kappa = 400/n
# The sweep includes the frequencies of the phase planes.
PHASE_PLANE_FREQUENCIES = (np.pi / 3, np.pi, 7.79, 10.0, 10.5, 10.99)
FREQUENCIES = tuple(np.union1d(np.round(np.arange(0.5, 15.0, 0.03), 2), PHASE_PLANE_FREQUENCIES).tolist())


class Run(NamedTuple):
    """An orbit diagram of the paper; hashable, so that figures and claims share its dataset.

    Attributes:
        along: Swept axis.
        values: Values of the swept axis.
        axes: The other axes: name and value or values.
        direction: "down" or "up".
        wall: "soft" or "rigid".
        periods, recorded_periods: Simulated and recorded periods of every point, as in `orbit_diagram`.
    """

    along: str
    values: tuple[float, ...]
    axes: tuple[tuple[str, Any], ...]
    direction: Direction = "down"
    wall: Walls = "soft"
    periods: int = PERIODS
    recorded_periods: int = RECORDED_PERIODS


class Source(NamedTuple):
    """Points of a run that a panel draws in one colour.

    Attributes:
        run: The run.
        where: Selected values of axes with several values, and of the swept axis if a single point is drawn.
        colour: Colour of matplotlib.
        text: Text in the legend; empty for none.
        mirror: True to draw the mirror image (u, t) -> (-u, t + 1).
    """

    run: Run
    where: dict[str, float]
    colour: str
    text: str = ""
    mirror: bool = False


class View(NamedTuple):
    """A panel.

    Attributes:
        letter: Letter of the panel in the layout.
        shows: Quantity over the swept axis, or kind of plot at one value of the axis.
        sources: Drawn sources, from the bottom to the top.
        title: Title of the panel.
        levels: Sources with impact velocities drawn as dashed red lines.
        unstable: Impact sequences of unstable orbits, drawn in red at the parameters of the last source.
    """

    letter: str
    shows: str
    sources: tuple[Source, ...]
    title: str = ""
    levels: tuple[Source, ...] = ()
    unstable: tuple[str, ...] = ()


class PaperFigure(NamedTuple):
    """A figure of the paper.

    Attributes:
        title: Subject of the figure.
        layout: Rows of letters; a capital continues the panel of the small letter.
        views: Panels of the figure.
        chosen: Choices made where the paper is incomplete or wrong.
        reference_values: Values of the swept axis with dashed red lines.
    """

    title: str
    layout: tuple[str, ...]
    views: tuple[View, ...]
    chosen: str = ""
    reference_values: tuple[float, ...] = ()


def run(along: str, *values: float, **axes: Any) -> Run:
    """Return a `Run`; keyword arguments that are not settings of a `Run` are axes."""
    settings = {name: axes.pop(name) for name in ("direction", "wall", "periods", "recorded_periods") if name in axes}
    return Run(along, values, tuple(axes.items()), **settings)


def _chaos(along: str, value: float, **axes: Any) -> Run:
    """Return a long run at one point, for a Poincare section."""
    return run(along, value, periods=SECTION_PERIODS + PERIODS, recorded_periods=SECTION_PERIODS, **axes)


# --- the runs -------------------------------------------------------------------------------------

# The default start is 0.05853, -0.47898, the only start that the paper names for soft walls.
RIGID = run("d", *GAPS, r=0.5, wall="rigid", u0=0.13746, v0=0.61685)
STIFF = run("d", *GAPS, r=0.5, kappa=400.0)
BY_GAP = {r: run("d", *GAPS, r=r, kappa=STIFFNESSES) for r in RESTITUTIONS}
SOFTENED = run("kappa", *STIFFNESS_SWEEP, r=0.5, d=(0.2, 0.18, 0.16, 0.12))
STIFFENED = run("kappa", *STIFFNESS_SWEEP, r=0.5, d=(0.2, 0.18, 0.16, 0.12), direction="up")
BY_FREQUENCY = {r: run("omega", *FREQUENCIES, s=GAP_IN_METRES, r=r, k=SPRINGS, direction="up") for r in RESTITUTIONS}
RIGID_BY_FREQUENCY = run("omega", *FREQUENCIES, s=GAP_IN_METRES, r=0.5, direction="up", wall="rigid")

RIGID_SECTION = _chaos("d", 0.12, r=0.5, wall="rigid")
STIFF_SECTION = _chaos("d", 0.12, r=0.5, kappa=400.0)
SOFT_SECTION = _chaos("d", 0.25, r=0.5, kappa=4.0)
FREQUENCY_SECTION = _chaos("omega", 7.79, s=GAP_IN_METRES, r=0.5, k=560.0)

# --- the captions ---------------------------------------------------------------------------------

_SLOW = r"Slow impacts may have $\rho_j$ above the frame of (b)."
_ENERGY = "Energies are microjoules, as Eq. (34) with Tables I and II gives them; the paper's mJ cannot be meant."


def _panels_of_sources(letters: str, shows: tuple[str, ...], sources: tuple[Source, ...]) -> list[View]:
    """Return a panel for every quantity, with the same sources."""
    return [View(letter, quantity, sources) for letter, quantity in zip(letters, shows, strict=True)]


def _planes(letters: str, *sources: Source) -> list[View]:
    """Return phase planes of the same sources at the three gaps of Figs. 3 and 5."""
    return [
        View(
            letter,
            "phase plane",
            tuple(source._replace(where={"d": d}) for source in sources),
            f"$d = {d}$",
            unstable=("RLL",) if d == UNSTABLE_AT else (),
        )
        for letter, d in zip(letters, PHASE_PLANES, strict=True)
    ]


def _by_stiffness(r: float, **where: float) -> tuple[Source, ...]:
    """Return the sources of the five kappa of Figs. 8-11 in their colours."""
    return tuple(
        Source(BY_GAP[r], {"kappa": kappa, **where}, colour, rf"$\kappa = {kappa:g}$")
        for kappa, colour in zip(STIFFNESSES, COLOURS, strict=True)
    )


def _by_spring(r: float, **where: float) -> tuple[Source, ...]:
    """Return the sources of the five k of Figs. 12-16 in their colours."""
    return tuple(
        Source(BY_FREQUENCY[r], {"k": k, **where}, colour, f"$k = {k:g}$ N/m")
        for k, colour in zip(SPRINGS, COLOURS, strict=True)
    )


def _at_gaps(r: float) -> PaperFigure:
    shows = ("speed", "restitution", "phase", "duration")
    return PaperFigure(
        f"Soft walls over $d$, $r = {r}$",
        ("aabb", "aabb", "ccdd", "ccdd"),
        tuple(_panels_of_sources("abcd", shows, _by_stiffness(r))),
    )


def _at_frequencies(r: float) -> PaperFigure:
    shows = ("speed in m/s", "restitution", "phase", "duration in s", "energy", "power")
    return PaperFigure(
        rf"Soft walls over $\omega$, $r = {r}$, $s = 0.2$ m",
        ("aabb", "aabb", "ccdd", "ccdd", "eeff", "eeff"),
        tuple(_panels_of_sources("abcdef", shows, _by_spring(r))),
        r"$\omega$ rises from 0.5 to 15 rad/s by 0.03, as the captions name no range. " + _SLOW + " " + _ENERGY + " On "
        "the softer membranes the formula gives more than the ball puts in.",
    )


_SWEEP_SOURCE, _MIRROR_SOURCE = (
    Source(RIGID, {}, "black", "the sweep"),
    Source(RIGID, {}, "purple", "its mirror image", mirror=True),
)
_RIGID_SOURCE, _SOFT_SOURCE = Source(RIGID, {}, "magenta", "rigid"), Source(STIFF, {}, "black", r"soft, $\kappa = 400$")
_RIGID_FREQUENCY_SOURCE = Source(RIGID_BY_FREQUENCY, {}, "magenta", "rigid")
_SOFT_FREQUENCY_SOURCE = Source(BY_FREQUENCY[0.5], {"k": 560.0}, "black", "soft, $k = 560$ N/m")


def _series(letter: str, d: float) -> View:
    return View(letter, "time series", (Source(RIGID, {"d": d}, "black"),), f"$d = {d}$")


def _sweep_of_stiffness(letter: str, d: float) -> View:
    down = Source(SOFTENED, {"d": d}, "black", r"$\kappa$ falling")
    up = Source(STIFFENED, {"d": d}, "tab:blue", r"$\kappa$ rising")
    levels = (Source(RIGID, {"d": d}, "red"),) if d in PHASE_PLANES else ()
    # The paper shows the sweep with rising kappa only at d = 0.2.
    return View(letter, "speed", (up, down) if d == 0.2 else (down,), f"$d = {d}$", levels)


def _softening(letter: str, d: float, *kappas: float) -> View:
    sources = tuple(
        Source(SOFTENED, {"d": d, "kappa": kappa}, colour, rf"$\kappa = {kappa:.4g}$")
        for kappa, colour in zip(kappas, COLOURS, strict=False)
    )
    return View(letter, "phase plane", sources, f"$d = {d}$")


def _at_frequency(letter: str, omega: float, title: str) -> View:
    both = tuple(
        source._replace(where=source.where | {"omega": omega})
        for source in (_RIGID_FREQUENCY_SOURCE, _SOFT_FREQUENCY_SOURCE)
    )
    return View(letter, "phase plane", both, title)


_FAST_ORBIT = Source(SOFTENED, {"d": 0.2, "kappa": 4.0}, COLOURS[-1], r"$\kappa = 4$")


def _fast(r: float) -> tuple[Source, ...]:
    """Return the sources of the three stiffest membranes at the frequencies of Fig. 16(b)."""
    stiff, medium, soft = _by_spring(r)[:3]
    return tuple(
        source._replace(where=source.where | {"omega": omega})
        for source, omega in ((stiff, 10.0), (medium, 10.0), (soft, 10.5))
    )


FIGURES: dict[int, PaperFigure] = {
    3: PaperFigure(
        "Rigid walls over $d$, $r = 0.5$",
        ("aabb", "aabb", "cdef", "cDEF", "gghh", "gghh"),
        (
            View("a", "speed", (_MIRROR_SOURCE, _SWEEP_SOURCE), unstable=("RL", "RLL")),
            View("b", "strobe", (_MIRROR_SOURCE, _SWEEP_SOURCE)),
            View("c", "section", (Source(RIGID_SECTION, {"d": 0.12}, "black"),), "$d = 0.12$"),
            *_planes("def", _SWEEP_SOURCE),
            *_planes("DEF", _MIRROR_SOURCE),
            View("g", "energies", (_SWEEP_SOURCE,)),
            View("h", "phase", (_MIRROR_SOURCE, _SWEEP_SOURCE)),
        ),
        "From both starts of the paper the sweep settles on the same image: purple is its mirror image. Red: "
        "unstable 1:1 and 1:2 orbits. " + _ENERGY,
        reference_values=(0.12, *PHASE_PLANES),
    ),
    4: PaperFigure(
        "Rigid walls: time series in the frame of the ground, $r = 0.5$",
        ("aaaaaa", "bbbbbb"),
        (_series("a", 0.2), _series("b", 0.18)),
        "Blue: where the walls are when the capsule is fastest. Rings: impacts that follow one on the same wall.",
    ),
    5: PaperFigure(
        r"Soft walls of $\kappa = 400$ against rigid walls over $d$, $r = 0.5$",
        ("aabb", "aabb", "cdef", "gghh", "gghh", "iijj", "iijj"),
        (
            *_panels_of_sources("ab", ("speed", "strobe"), (_RIGID_SOURCE, _SOFT_SOURCE)),
            View(
                "c",
                "section",
                (Source(RIGID_SECTION, {"d": 0.12}, "magenta"), Source(STIFF_SECTION, {"d": 0.12}, "black")),
                "$d = 0.12$",
            ),
            *_planes("def", _RIGID_SOURCE, _SOFT_SOURCE),
            *_panels_of_sources("ghij", ("restitution", "duration", "energies", "phase"), (_SOFT_SOURCE,)),
        ),
        "The rigid walls start as in Fig. 3 and may settle on mirror images; (d) to (f) show like ones. Red: an "
        "unstable 1:2 orbit. " + _ENERGY,
        reference_values=(0.12, *PHASE_PLANES),
    ),
    6: PaperFigure(
        r"Soft walls over $\kappa = 400/n$, $r = 0.5$",
        ("aabb", "aabb", "ccdd", "ccdd"),
        tuple(_sweep_of_stiffness(letter, d) for letter, d in zip("abcd", (0.2, 0.18, 0.16, 0.12), strict=True)),
        "Dashed red: rigid walls, by the sweep of Fig. 3; none at $d = 0.12$, where they are chaotic.",
    ),
    7: PaperFigure(
        r"Phase planes of the sweeps over $\kappa$, $r = 0.5$",
        ("aabbcc", "aabbcc"),
        (
            View(
                "a",
                "phase plane",
                (
                    Source(run("kappa", 3.0, d=0.2, r=0.5), {"kappa": 3.0}, "tab:blue", "2:2/3T"),
                    Source(run("kappa", 3.0, d=0.2, r=0.5, u0=-0.1, v0=0.0), {"kappa": 3.0}, "black", "1:1"),
                ),
                r"$d = 0.2$, $\kappa = 3$",
            ),
            _softening("b", 0.18, 400.0, 400 / 5, 400 / 10, 400 / 20, 400 / 40),
            _softening("c", 0.16, 400 / 60, 400 / 80, 400 / 104, 400 / 112, 400 / 130),
        ),
        "Text and caption of the paper swap the colours of (a) and name no stiffness in (b) and (c): chosen here.",
    ),
    8: _at_gaps(0.5),
    9: _at_gaps(0.1),
    10: _at_gaps(0.95),
    11: PaperFigure(
        "Phase planes of the sweeps over $d$",
        ("aabb", "aabb", "ccdd", "ccdd"),
        (
            View("a", "chaos", (Source(SOFT_SECTION, {"d": 0.25}, "black"),), r"$\kappa = 4$, $r = 0.5$, $d = 0.25$"),
            View(
                "b",
                "phase plane",
                (Source(BY_GAP[0.5], {"d": 0.12, "kappa": 12.65}, "tab:orange"),),
                r"$\kappa = 12.65$, $r = 0.5$, $d = 0.12$",
            ),
            View("c", "phase plane", _by_stiffness(0.1, d=0.16), "$r = 0.1$, $d = 0.16$"),
            View("d", "phase plane", (*_by_stiffness(0.5, d=0.2)[:-1], _FAST_ORBIT), "$r = 0.5$, $d = 0.2$"),
        ),
        f"Gray: the orbit; dots: its Poincare section over {SECTION_PERIODS} periods. The chaos of (a) is a long "
        "transient: see the table of claims. It may end within the sweep of Fig. 8, so that $\\kappa = 4$ "
        "of (d) is from the sweep of Fig. 6.",
    ),
    12: PaperFigure(
        r"Soft against rigid walls over $\omega$: $\omega_0 = 400$ rad/s, $s = 0.2$ m, $r = 0.5$",
        ("aabb", "aabb", "cdef", "gghh", "gghh", "iijj", "iijj"),
        (
            *_panels_of_sources(
                "ab", ("speed in m/s", "strobe in m"), (_RIGID_FREQUENCY_SOURCE, _SOFT_FREQUENCY_SOURCE)
            ),
            _at_frequency("c", np.pi / 3, r"$\omega = \pi/3$"),
            _at_frequency("d", np.pi, r"$\omega = \pi$"),
            View("e", "chaos", (Source(FREQUENCY_SECTION, {"omega": 7.79}, "black"),), r"$\omega = 7.79$"),
            _at_frequency("f", 10.99, r"$\omega = 10.99$"),
            *_panels_of_sources("ghij", ("energies", "phase", "restitution", "duration"), (_SOFT_FREQUENCY_SOURCE,)),
        ),
        r"$\omega$ rises from 0.5 to 15 rad/s by 0.03, as the caption names no range. " + _ENERGY,
        reference_values=(np.pi / 3, np.pi, 7.79, 10.99),
    ),
    13: _at_frequencies(0.5),
    14: _at_frequencies(0.1),
    15: _at_frequencies(0.95),
    16: PaperFigure(
        r"Phase planes of the sweeps over $\omega$",
        ("aabb", "aabb", "ccdd", "ccdd"),
        (
            View("a", "phase plane", _by_spring(0.5, omega=np.pi), r"$r = 0.5$, $\omega = \pi$"),
            View("b", "phase plane", _fast(0.5), r"$r = 0.5$, $\omega = 10$ and 10.5"),
            View("c", "phase plane", _by_spring(0.1, omega=np.pi), r"$r = 0.1$, $\omega = \pi$"),
            View("d", "phase plane", _fast(0.95), r"$r = 0.95$, $\omega = 10$ and 10.5"),
        ),
        r"The caption of (c, d) is corrupt. Drawn: (c) $r = 0.1$, $\omega = \pi$, all five $k$; (d) $r = 0.95$ "
        "at the frequencies of (b).",
    ),
}
