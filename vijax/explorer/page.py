"""One page: what is asked of it, what it answers, and what it computes in between.

The page asks by messages (`Channel.asked`), each handled by a method of `ExplorerPage`, and is told by messages
(`Channel.told`), which its script writes as text: nothing of a store is ever HTML. Begin with `ExplorerPage.heard`.
"""

from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

from bokeh.core.properties import Any as AnyValue
from bokeh.core.properties import Dict, String
from bokeh.document import Document
from bokeh.model import DataModel

from vijax.explorer import answers, export, overlay, recipes, view
from vijax.explorer.drawing import Drawing
from vijax.explorer.figures import figures, ranged, scale, tables
from vijax.explorer.jobs import Crew, Jobs, one_line
from vijax.explorer.motion import CellMotion, motion
from vijax.explorer.overlay import LaidCurves
from vijax.explorer.panels import PANEL_KINDS, PanelRequest
from vijax.explorer.plane import Axis, ExploredCell, ExploredPlane, cell, explored
from vijax.explorer.recipes import Recipe
from vijax.explorer.source import Source
from vijax.explorer.theme import written
from vijax.explorer.view import View
from vijax.explorer.worker import Tell
from vijax.model.quantities import AXES
from vijax.planes.sweep import sweep
from vijax.plots.cell_colours import coloured
from vijax.runtime import checks

MOST_CELLS = 10**6
"""Cells of a plane that is made without being asked for twice."""

LINE_DELAY = 200
"""Milliseconds for which a pick stands still before its line is computed."""

_TRAIL = 400  # impacts of picks that stay drawn in the line


class Channel(DataModel):
    """What a page asks and is told, each message a dictionary of JSON."""

    asked = Dict(String, AnyValue)
    told = Dict(String, AnyValue)


class ExplorerPage:
    """A page that somebody looks at.

    Args:
        document: Of the session.
        source: Where its map comes from.
        plane: The map.
        shown: The view that it opens with.
        crew: The threads of the server.
    """

    def __init__(self, document: Document, source: Source, plane: ExploredPlane, shown: View, crew: Crew) -> None:
        self.document, self.source, self.plane, self.view = document, source, plane, shown
        self.crew, self.jobs = crew, Jobs(crew, document.add_next_tick_callback)
        self.channel = Channel(name="channel")
        made = tables()
        self.drawing = Drawing(made, *figures(plane, made, source.curves.kinds if source.curves else ()))
        self.laid = LaidCurves()
        self.cell: ExploredCell | None = None
        self.motion: CellMotion | None = None
        self.exports: dict[str, Any] = {}
        self._trail: list[tuple[float, float]] = []
        self._made = False
        # Panels of the picked cell that hold or compute something; and those of the address, which wait for a motion.
        self._opened: set[str] = set()
        self._pending = shown.panels
        self._wait: Any = None  # The timer after which the line is computed.
        self._stamp = source.stamp()
        self.channel.on_change("asked", lambda attribute, old, new: self.heard(new))

    # --- messages ----------------------------------------------------------------------------------------------------

    def heard(self, message: dict[str, Any]) -> None:
        """Do what the page asks; an error is shown in one line.

        A message can be anything that JSON can hold: infinity, a number with 400 digits, a list where a name is due.
        """
        kinds = {
            "ready": self._ready,
            "pick": self._pick,
            "colour": self._colour,
            "value": self._value,
            "along": self._along,
            "follow": self._follow,
            "open": self._open,
            "cancel": self._cancel,
            "make": self._make,
            "export": self._export,
        }
        handler = kinds.get(str(message.get("kind")))
        if handler is None:
            return
        try:
            handler(message)
        except Exception as error:
            self.tell("note", text=one_line(error), error=True)
            self._tell_view()

    def tell(self, section: str, **content: Any) -> None:
        """Tell the page what one section of it is to show."""
        self.channel.update(told={"section": section, **content})

    def _ready(self, message: dict[str, Any]) -> None:
        self._tell_page()
        self._draw_map()
        self._scale_diagrams()
        self._run(0)

    def _pick(self, message: dict[str, Any]) -> None:
        columns, rows = self.plane.shape
        column, row, number = (view.whole(message, name) for name in ("column", "row", "number"))
        pick = min(max(column, 0), columns - 1), min(max(row, 0), rows - 1)
        values = dict(self.view.values)
        if self.view.follow and self.motion is not None:
            # A rigid gap holds its start, and a soft one nearly so: a start is never far within a membrane.
            half = 0.5 * float(self.plane.stored("d", pick, values))
            ends = dict(zip(("u0", "v0"), self.motion.end, strict=True))
            limits = view.bounds(self.plane) | {"u0": (-half, half)}
            values |= {name: min(max(end, limits[name][0]), limits[name][1]) for name, end in ends.items()}
        self.view = replace(self.view, pick=pick, values=values, panels=())
        self._run(number)

    def _colour(self, message: dict[str, Any]) -> None:
        asked = view.from_query(self.plane, {name: message[name] for name in ("variable", "scale", "curves")})
        self.view = replace(self.view, variable=asked.variable, scale=asked.scale, curves=asked.curves)
        self._draw_map()
        self._tell_view()

    def _value(self, message: dict[str, Any]) -> None:
        name, number = str(message["name"]), view.whole(message, "number")
        values = {key: value for key, value in self.view.values.items() if key != name}
        if message.get("value") is not None:
            values |= view.checked(self.plane, {name: message["value"]})
        self.view = replace(self.view, values=values, panels=())
        if name in self.plane.further:
            self._draw_map()
        self._run(number)

    def _along(self, message: dict[str, Any]) -> None:
        self.view = replace(self.view, along=view.from_query(self.plane, {"along": message["along"]}).along)
        self._trail.clear()
        self._scale_diagrams()
        self._clear_panels()
        if self.cell is not None:
            self.drawing.stand(self.cell.arguments[self.view.along])
        self._start("line")
        self._tell_view()

    def _follow(self, message: dict[str, Any]) -> None:
        number = view.whole(message, "number")
        values = {name: value for name, value in self.view.values.items() if name not in ("u0", "v0")}
        self.view = replace(self.view, follow=bool(message["follow"]), values=values)
        self._trail.clear()
        self._run(number)

    def _open(self, message: dict[str, Any]) -> None:
        name = checks.choice("open", message["name"], view.PANELS)
        self.view = replace(self.view, panels=tuple(one for one in view.PANELS if one in (*self.view.panels, name)))
        self._start(name)
        self._tell_view()

    def _cancel(self, message: dict[str, Any]) -> None:
        name = str(message["name"])
        if self.jobs.cancel(name):
            self.tell("panel", name=name, state="cancelled", text="Cancelled.", rows=[])

    # --- what is computed --------------------------------------------------------------------------------------------

    @property
    def axis(self) -> Axis:
        """Give the axis along which line, branch and optimum go."""
        return self.plane.x if self.view.along == self.plane.x.name else self.plane.y

    def _run(self, number: int) -> None:
        """Find what the picked cell does; `number` is of the page's request, and comes back with the answer."""
        self._clear_panels()
        column, row = self.view.pick
        self.drawing.pick(float(self.plane.x.values[column]), float(self.plane.y.values[row]))
        plane, pick, values = self.plane, self.view.pick, dict(self.view.values)

        # Not even a pair is made on the event loop: JAX may be compiling, and then waits.
        def work(tell: Tell) -> tuple[ExploredCell, CellMotion]:
            found = cell(plane, pick, values)
            return found, motion(found)

        self.jobs.start("motion", work, partial(self._moved, number), self._failed("motion"))
        self._tell_view()

    def _moved(self, number: int, answer: tuple[ExploredCell, CellMotion]) -> None:
        self.cell, self.motion = answer
        found = self.motion
        self.tell("panel", name="motion", state="done", text="", rows=[])
        self.drawing.motion(found)
        place = self.cell.arguments[self.view.along]
        self._trail += [(place, float(speed)) for speed in found.impacts["v"]]
        del self._trail[:-_TRAIL]
        self.drawing.visited(self._trail if self.view.follow else [])
        note = answers.disagreement(self.plane, dict(self.view.values), self.view.pick, found)
        rows = answers.cell_rows(self.cell, found)
        if not self.plane.differs(self.view.values):
            rows += answers.curves_row(self.laid, self.plane, self.view.pick)
        self.tell("cell", number=number, heading=answers.heading(found), rows=rows, note=note)
        self._tell_recipe("motion", recipes.of_motion(self.cell, found))
        self.exports["motion"] = (self.cell, found)
        self.drawing.stand(place)
        for name in self._pending:
            self._start(name)
        self._pending = ()
        self._line_later()

    def _line_later(self) -> None:
        """Compute the line once the pick has stood still for a moment: it would keep the motion from the screen."""
        if self._wait is not None:
            with suppress(ValueError):  # it has run meanwhile
                self.document.remove_timeout_callback(self._wait)
        self.jobs.cancel("line")
        self._wait = self.document.add_timeout_callback(lambda: self._start("line"), LINE_DELAY)

    def _start(self, name: str) -> None:
        """Compute a panel."""
        if self.cell is None or self.motion is None:
            return
        if name in view.PANELS:
            self._opened.add(name)
        kind, asked = PANEL_KINDS[name], PanelRequest(self.plane, self.cell, self.motion, self.axis)
        self.tell("panel", name=name, state="running", text="Computing\u2026", rows=[])

        def done(found: Any) -> None:
            text, rows = kind.show(self.drawing, asked, found)
            self.exports[name] = found
            self.tell("panel", name=name, state="done", text=text, rows=rows)
            self._tell_recipe(name, kind.recipe(asked))

        self.jobs.start(
            name, partial(kind.work, asked, self.crew.worker(name)), done, self._failed(name), self._progress(name)
        )

    def _clear_panels(self) -> None:
        """Take off the panels of another cell, and nothing else: to empty an empty figure is to draw it once more."""
        for name in self._opened:
            self.jobs.cancel(name)
            self.exports.pop(name, None)
            PANEL_KINDS[name].clear(self.drawing)
            self.tell("panel", name=name, state="idle", text="", rows=[])
        self._opened.clear()

    def _failed(self, name: str) -> Any:
        def failed(said: str) -> None:
            self.tell("panel", name=name, state="failed", text=said, rows=[])

        return failed

    def _progress(self, name: str) -> Any:
        return lambda done, total: self.tell("progress", name=name, done=done, total=total)

    # --- the plane ---------------------------------------------------------------------------------------------------

    def _make(self, message: dict[str, Any]) -> None:
        """Sweep the plane with the values of the sliders in place of the map's, in the background."""
        plane, values = self.plane, dict(self.view.values)
        count = plane.x.values.size * plane.y.values.size
        if count > MOST_CELLS and not message.get("sure"):
            self.tell("ask", text=f"This plane has {count:,} cells and may take long. Make it?")
            return
        first = plane.arguments((0, 0), values)
        axes: dict[str, Any] = first | {plane.x.name: plane.x.values, plane.y.name: plane.y.values}
        self.tell("panel", name="plane", state="running", text="Computing\u2026", rows=[])
        self.jobs.start(
            "plane",
            lambda tell: explored(sweep(device=plane.device, progress=tell, **plane.settings(), **axes)),
            self._remade,
            self._failed("plane"),
            self._progress("plane"),
        )

    def _remade(self, plane: ExploredPlane) -> None:
        self.plane, self._made = plane, True
        self._tell_page()
        self._draw_map()
        self.tell("panel", name="plane", state="done", text="The map is of these values.", rows=[])
        self._run(0)

    def refresh(self) -> None:
        """Read the store again if it has changed; a store that cannot be read any more leaves the map as it is."""
        stamp = self.source.stamp()
        if self._made or stamp == self._stamp:
            return
        self._stamp = stamp
        self.jobs.start("store", lambda tell: self.source.plane(), self._reread, self._unread)

    def _reread(self, plane: ExploredPlane) -> None:
        self.plane = plane
        self.tell("note", text="", error=False)
        self._draw_map()

    def _unread(self, said: str) -> None:
        self.tell("note", text=f"The store cannot be read any more; the map is as it was. {said}", error=True)

    def _draw_map(self) -> None:
        shown = self.plane.sliced(self.view.values)
        log = None if self.view.scale == "auto" else self.view.scale == "log"
        found = coloured(shown, self.view.variable, self.plane.x.name, self.plane.y.name, log)
        self.drawing.map(self.plane, found)
        self.exports["map"] = (shown, self.view.variable, *self._lay(shown))
        self._tell_recipe("map", recipes.of_map(self.source, self.plane, self.view, self._made, bool(self.laid.pieces)))
        entries = [[one.sign, one.colour, one.text, one.count] for one in found.legend]
        self.tell("legend", title=found.title, entries=entries)

    def _lay(self, shown: Any) -> tuple[Any, bool]:
        """Lay the curves over the part of the map that is shown; give what a picture of it draws of them."""
        curves = self.source.curves
        if curves is None:
            return None, False
        found = self.laid = overlay.laid(curves, self.plane, shown, self.view.curves)
        self.drawing.curves(found)
        legend, points = answers.curves_legend(found), answers.curves_points(found, self.plane)
        self.tell("curves", text=found.said, entries=legend, points=points)
        return (curves.dataset if found.pieces else None), self.view.curves == "unstable"

    def _scale_diagrams(self) -> None:
        """Put the axes of line and branch on the axis that they go along."""
        for one in (self.drawing.figures.line, self.drawing.figures.branch):
            one.x_range.update(**ranged(self.axis))
            scale(one, self.axis)

    # --- what is told ------------------------------------------------------------------------------------------------

    def _tell_page(self) -> None:
        plane = self.plane
        axes = {
            place: {
                "name": axis.name,
                "edges": axis.edges.tolist(),
                "values": axis.values.tolist(),
            }
            for place, axis in (("x", plane.x), ("y", plane.y))
        }
        sliders = [
            {"name": name, "label": written(name), "low": low, "high": high, "value": self._held(name)}
            for name, (low, high) in view.bounds(plane).items()
        ]
        self.tell("page", title=self.source.name, variables=list(plane.variables), axes=axes, sliders=sliders)

    def _held(self, name: str) -> float:
        """Give the value that the map has of what can be moved."""
        if name in self.plane.further:
            return float(self.plane.further[name][0])
        if name in self.plane.fixed:
            return self.plane.fixed[name]
        return float(self.plane.dataset[name].values.flat[0])

    def _tell_view(self) -> None:
        shown = self.view
        self.tell(
            "view",
            query=view.query(shown),
            variable=shown.variable,
            scale=shown.scale,
            curves=shown.curves,
            pick=list(shown.pick),
            values=dict(shown.values),
            along=shown.along,
            follow=shown.follow,
            moved=[AXES[name].text for name in self.plane.differs(shown.values)],
        )

    def _tell_recipe(self, name: str, recipe: Recipe) -> None:
        self.tell("recipe", name=name, command=recipe.command, python=recipe.python)

    def _export(self, message: dict[str, Any]) -> None:
        what, ending = str(message["what"]), str(message["format"])
        if what not in self.exports:
            raise ValueError(f"what must have been computed to be exported; got {checks.shown(what)}; compute it first")
        found = self.exports[what]
        self.jobs.start(
            "export",
            lambda tell: export.picture(what, found, ending),
            lambda content: self.tell("file", name=f"{what}.{ending}", content=content),
            lambda said: self.tell("note", text=said, error=True),
        )
