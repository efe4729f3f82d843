"""One open page on the server: requests of the browser's script, the jobs that they start, and the answers.

The script sends requests through `Channel.request`; `ExplorerPage` has one method per kind of request. The server
answers through `Channel.message`. The script displays answers as plain text, so that no content of a store is ever
interpreted as HTML. Begin with `ExplorerPage.handle_message`.
"""

from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

from bokeh.core.properties import Any as AnyValue
from bokeh.core.properties import Dict, String
from bokeh.document import Document
from bokeh.model import DataModel

from vijax.explorer import export, overlay, view
from vijax.explorer.analyses import recipes, results
from vijax.explorer.analyses.motion import CellMotion, motion
from vijax.explorer.analyses.recipes import Recipe
from vijax.explorer.drawing import Drawing
from vijax.explorer.figures import figures, range_limits, scale, tables
from vijax.explorer.overlay import DrawnCurves
from vijax.explorer.panels import PANEL_KINDS, PanelRequest
from vijax.explorer.plane import Axis, ExploredCell, ExploredPlane, cell, explored
from vijax.explorer.server.jobs import Jobs, JobThreads, error_line
from vijax.explorer.server.worker import ProgressCallback
from vijax.explorer.source import Source
from vijax.explorer.theme import axis_text
from vijax.explorer.view import View
from vijax.maps.sweep import sweep
from vijax.model.quantities import AXES
from vijax.plots.cell_colours import coloured
from vijax.runtime import validation

MOST_CELLS = 10**6
"""Most cells of a new map that the page computes without confirmation by the user."""

LINE_DELAY = 200
"""Milliseconds from the display of a cell's motion to the computation of its line; the next motion restarts them."""

_TRAIL = 400  # most impacts of earlier picked cells that stay drawn in the figure of the line


class Channel(DataModel):
    """Messages from the browser's script (`request`) and to the script (`message`), each a JSON dictionary."""

    request = Dict(String, AnyValue)
    message = Dict(String, AnyValue)


class ExplorerPage:
    """One open page.

    Args:
        document: Document of the session.
        source: Source of the map and its curves.
        plane: The map.
        first_view: The view that the page opens with.
        threads: Threads of the server, which run the page's jobs.
    """

    def __init__(
        self, document: Document, source: Source, plane: ExploredPlane, first_view: View, threads: JobThreads
    ) -> None:
        self.document, self.source, self.plane, self.view = document, source, plane, first_view
        self.threads, self.jobs = threads, Jobs(threads, document.add_next_tick_callback)
        self.channel = Channel(name="channel")
        page_tables = tables()
        self.drawing = Drawing(page_tables, *figures(plane, page_tables, source.curves.kinds if source.curves else ()))
        self.drawn_curves = DrawnCurves()
        self.cell: ExploredCell | None = None
        self.motion: CellMotion | None = None
        self.exports: dict[str, Any] = {}
        self._trail: list[tuple[float, float]] = []
        self._recomputed = False
        # `_opened`: panels of the picked cell that have a result or a running job. `_pending`: panels that the address
        # of the page requests; they are opened after the first motion is computed.
        self._opened: set[str] = set()
        self._pending = first_view.panels
        self._wait: Any = None  # timer after which the line is computed
        self._stamp = source.stamp()
        self.channel.on_change("request", lambda attribute, old, new: self.handle_message(new))

    # --- messages ----------------------------------------------------------------------------------------------------

    def handle_message(self, message: dict[str, Any]) -> None:
        """Handle a request of the browser's script; the page shows an error in one line.

        A request is not trusted: it may hold any JSON, such as a number with 400 digits or a list in place of a name.
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
            self.send("note", text=error_line(error), error=True)
            self._send_view()

    def send(self, section: str, **content: Any) -> None:
        """Send a message: the new content of one section of the page."""
        self.channel.update(message={"section": section, **content})

    def _ready(self, message: dict[str, Any]) -> None:
        self._send_page()
        self._draw_map()
        self._scale_diagrams()
        self._run(0)

    def _pick(self, message: dict[str, Any]) -> None:
        columns, rows = self.plane.shape
        column, row, number = (view.read_integer(message, name) for name in ("column", "row", "number"))
        pick = min(max(column, 0), columns - 1), min(max(row, 0), rows - 1)
        values = dict(self.view.values)
        if self.view.follow and self.motion is not None:
            # A start must lie within the gap. The end of a motion may lie slightly outside, in contact with a membrane,
            # so it is clipped.
            half = 0.5 * float(self.plane.stored("d", pick, values))
            ends = dict(zip(("u0", "v0"), self.motion.end, strict=True))
            limits = view.bounds(self.plane) | {"u0": (-half, half)}
            values |= {name: min(max(end, limits[name][0]), limits[name][1]) for name, end in ends.items()}
        self.view = replace(self.view, pick=pick, values=values, panels=())
        self._run(number)

    def _colour(self, message: dict[str, Any]) -> None:
        requested = view.from_query(self.plane, {name: message[name] for name in ("variable", "scale", "curves")})
        self.view = replace(self.view, variable=requested.variable, scale=requested.scale, curves=requested.curves)
        self._draw_map()
        self._send_view()

    def _value(self, message: dict[str, Any]) -> None:
        name, number = str(message["name"]), view.read_integer(message, "number")
        values = {key: value for key, value in self.view.values.items() if key != name}
        if message.get("value") is not None:
            values |= view.validated_values(self.plane, {name: message["value"]})
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
        self._send_view()

    def _follow(self, message: dict[str, Any]) -> None:
        number = view.read_integer(message, "number")
        values = {name: value for name, value in self.view.values.items() if name not in ("u0", "v0")}
        self.view = replace(self.view, follow=bool(message["follow"]), values=values)
        self._trail.clear()
        self._run(number)

    def _open(self, message: dict[str, Any]) -> None:
        name = validation.validate_choice("open", message["name"], view.PANELS)
        self.view = replace(
            self.view, panels=tuple(panel for panel in view.PANELS if panel in (*self.view.panels, name))
        )
        self._start(name)
        self._send_view()

    def _cancel(self, message: dict[str, Any]) -> None:
        name = str(message["name"])
        if self.jobs.cancel(name):
            self.send("panel", name=name, state="cancelled", text="Cancelled.", rows=[])

    # --- computation -------------------------------------------------------------------------------------------------

    @property
    def axis(self) -> Axis:
        """Return the axis along which the line, the branch and the optima are computed."""
        return self.plane.x if self.view.along == self.plane.x.name else self.plane.y

    def _run(self, number: int) -> None:
        """Compute the motion of the picked cell; the answer to the script repeats the request's `number`."""
        self._clear_panels()
        column, row = self.view.pick
        self.drawing.pick(float(self.plane.x.values[column]), float(self.plane.y.values[row]))
        plane, pick, values = self.plane, self.view.pick, dict(self.view.values)

        # The thread builds the cell too, because `cell` may wait for a compilation and would block the event loop.
        def work(report: ProgressCallback) -> tuple[ExploredCell, CellMotion]:
            picked_cell = cell(plane, pick, values)
            return picked_cell, motion(picked_cell)

        self.jobs.start("motion", work, partial(self._show_motion, number), self._failed("motion"))
        self._send_view()

    def _show_motion(self, number: int, answer: tuple[ExploredCell, CellMotion]) -> None:
        self.cell, self.motion = answer
        cell_motion = self.motion
        self.send("panel", name="motion", state="done", text="", rows=[])
        self.drawing.motion(cell_motion)
        position = self.cell.arguments[self.view.along]
        self._trail += [(position, float(speed)) for speed in cell_motion.impacts["v"]]
        del self._trail[:-_TRAIL]
        self.drawing.visited(self._trail if self.view.follow else [])
        note = results.disagreement(self.plane, dict(self.view.values), self.view.pick, cell_motion)
        rows = results.cell_rows(self.cell, cell_motion)
        if not self.plane.differs(self.view.values):
            rows += results.curves_row(self.drawn_curves, self.plane, self.view.pick)
        self.send("cell", number=number, heading=results.heading(cell_motion), rows=rows, note=note)
        self._send_recipe("motion", recipes.of_motion(self.cell, cell_motion))
        self.exports["motion"] = (self.cell, cell_motion)
        self.drawing.stand(position)
        for name in self._pending:
            self._start(name)
        self._pending = ()
        self._schedule_line()

    def _schedule_line(self) -> None:
        """Compute the line `LINE_DELAY` after the last displayed motion, so that it does not delay a dragged pick."""
        if self._wait is not None:
            with suppress(ValueError):  # raised if the timer has already run
                self.document.remove_timeout_callback(self._wait)
        self.jobs.cancel("line")
        self._wait = self.document.add_timeout_callback(lambda: self._start("line"), LINE_DELAY)

    def _start(self, name: str) -> None:
        """Start the job that computes a panel of the picked cell, and show the result when the job is done."""
        if self.cell is None or self.motion is None:
            return
        if name in view.PANELS:
            self._opened.add(name)
        kind, request = PANEL_KINDS[name], PanelRequest(self.plane, self.cell, self.motion, self.axis)
        self.send("panel", name=name, state="running", text="Computing\u2026", rows=[])

        def done(result: Any) -> None:
            text, rows = kind.show(self.drawing, request, result)
            self.exports[name] = result
            self.send("panel", name=name, state="done", text=text, rows=rows)
            self._send_recipe(name, kind.recipe(request))

        self.jobs.start(
            name, partial(kind.work, request, self.threads.worker(name)), done, self._failed(name), self._progress(name)
        )

    def _clear_panels(self) -> None:
        """Clear the opened panels of the previous cell; empty figures stay, because Bokeh would redraw cleared ones."""
        for name in self._opened:
            self.jobs.cancel(name)
            self.exports.pop(name, None)
            PANEL_KINDS[name].clear(self.drawing)
            self.send("panel", name=name, state="idle", text="", rows=[])
        self._opened.clear()

    def _failed(self, name: str) -> Any:
        def failed(message: str) -> None:
            self.send("panel", name=name, state="failed", text=message, rows=[])

        return failed

    def _progress(self, name: str) -> Any:
        return lambda done, total: self.send("progress", name=name, done=done, total=total)

    # --- the plane ---------------------------------------------------------------------------------------------------

    def _make(self, message: dict[str, Any]) -> None:
        """Start a job that computes the map anew, with the sliders' values in place of the map's fixed values."""
        plane, values = self.plane, dict(self.view.values)
        count = plane.x.values.size * plane.y.values.size
        if count > MOST_CELLS and not message.get("confirmed"):
            self.send("confirm", text=f"This plane has {count:,} cells and may take long. Make it?")
            return
        first = plane.arguments((0, 0), values)
        axes: dict[str, Any] = first | {plane.x.name: plane.x.values, plane.y.name: plane.y.values}
        self.send("panel", name="plane", state="running", text="Computing\u2026", rows=[])
        self.jobs.start(
            "plane",
            lambda report: explored(sweep(device=plane.device, progress=report, **plane.settings(), **axes)),
            self._remade,
            self._failed("plane"),
            self._progress("plane"),
        )

    def _remade(self, plane: ExploredPlane) -> None:
        self.plane, self._recomputed = plane, True
        self._send_page()
        self._draw_map()
        self.send("panel", name="plane", state="done", text="The map is of these values.", rows=[])
        self._run(0)

    def refresh(self) -> None:
        """Read the map again if its store has changed; if the store is unreadable, the displayed map stays."""
        stamp = self.source.stamp()
        if self._recomputed or stamp == self._stamp:
            return
        self._stamp = stamp
        self.jobs.start("store", lambda report: self.source.plane(), self._show_reread_map, self._report_read_error)

    def _show_reread_map(self, plane: ExploredPlane) -> None:
        self.plane = plane
        self.send("note", text="", error=False)
        self._draw_map()

    def _report_read_error(self, message: str) -> None:
        self.send("note", text=f"The store cannot be read any more; the map is as it was. {message}", error=True)

    def _draw_map(self) -> None:
        map_part = self.plane.sliced(self.view.values)
        log = None if self.view.scale == "auto" else self.view.scale == "log"
        coloured_map = coloured(map_part, self.view.variable, self.plane.x.name, self.plane.y.name, log)
        self.drawing.map(self.plane, coloured_map)
        self.exports["map"] = (map_part, self.view.variable, *self._draw_curves(map_part))
        self._send_recipe(
            "map", recipes.of_map(self.source, self.plane, self.view, self._recomputed, bool(self.drawn_curves.pieces))
        )
        entries = [[entry.sign, entry.colour, entry.text, entry.count] for entry in coloured_map.legend]
        self.send("legend", title=coloured_map.title, entries=entries)

    def _draw_curves(self, map_part: Any) -> tuple[Any, bool]:
        """Draw the curves over the map; return the curves' dataset or None, and whether unstable parts are shown."""
        curves = self.source.curves
        if curves is None:
            return None, False
        drawn_curves = self.drawn_curves = overlay.select_curves(curves, self.plane, map_part, self.view.curves)
        self.drawing.curves(drawn_curves)
        legend, points = results.curves_legend(drawn_curves), results.curves_points(drawn_curves, self.plane)
        self.send("curves", text=drawn_curves.note, entries=legend, points=points)
        return (curves.dataset if drawn_curves.pieces else None), self.view.curves == "unstable"

    def _scale_diagrams(self) -> None:
        """Set the horizontal axes of the figures of line and branch to the selected axis of the map, `self.axis`."""
        for diagram in (self.drawing.figures.line, self.drawing.figures.branch):
            diagram.x_range.update(**range_limits(self.axis))
            scale(diagram, self.axis)

    # --- messages to the page's script -------------------------------------------------------------------------------

    def _send_page(self) -> None:
        plane = self.plane
        axes = {
            place: {"name": axis.name, "edges": axis.edges.tolist(), "values": axis.values.tolist()}
            for place, axis in (("x", plane.x), ("y", plane.y))
        }
        sliders = [
            {"name": name, "label": axis_text(name), "low": low, "high": high, "value": self._map_value(name)}
            for name, (low, high) in view.bounds(plane).items()
        ]
        self.send("page", title=self.source.name, variables=list(plane.variables), axes=axes, sliders=sliders)

    def _map_value(self, name: str) -> float:
        """Return the value of a slider's quantity in the map, where the slider stands before the user moves it."""
        if name in self.plane.further:
            return float(self.plane.further[name][0])
        if name in self.plane.fixed:
            return self.plane.fixed[name]
        return float(self.plane.dataset[name].values.flat[0])

    def _send_view(self) -> None:
        current = self.view
        self.send(
            "view",
            query=view.query(current),
            variable=current.variable,
            scale=current.scale,
            curves=current.curves,
            pick=list(current.pick),
            values=dict(current.values),
            along=current.along,
            follow=current.follow,
            moved=[AXES[name].text for name in self.plane.differs(current.values)],
        )

    def _send_recipe(self, name: str, recipe: Recipe) -> None:
        self.send("recipe", name=name, command=recipe.command, python=recipe.python)

    def _export(self, message: dict[str, Any]) -> None:
        panel, extension = str(message["panel"]), str(message["format"])
        if panel not in self.exports:
            raise ValueError(
                f"panel must have been computed to be exported; got {validation.value_text(panel)}; compute it first"
            )
        content = self.exports[panel]
        self.jobs.start(
            "export",
            lambda report: export.picture(panel, content, extension),
            lambda file_content: self.send("file", name=f"{panel}.{extension}", content=file_content),
            lambda message: self.send("note", text=message, error=True),
        )
