"""How much time passes from a click on a map to the motion on the screen, and what else does the page cost?

    python -m benchmarks.explore                        # every figure: a few minutes
    python -m benchmarks.explore --clicks 100 --long 0  # clicks alone
    python -m benchmarks.explore --picture page.png     # the picture of README

Measured in Chromium, from the pointer event to the second frame after the answer, over random cells of the default map,
on a server with compiled programs. Needs the extra `test`, and Chromium.
"""

import argparse
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import vijax
from vijax.explorer.analyses.motion import MOST_IMPACTS
from vijax.model.label import label

SIDES = (64, 64)  # of the default map
D, KAPPA = np.linspace(0.05, 0.3, SIDES[0]), np.geomspace(3.0, 400.0, SIDES[1])
_COMPARED = 50  # cells for the comparison with the library's numbers
_ON_DEMAND = ((56, 56), (40, 40), (60, 30), (36, 50), (50, 20))  # cells for the timing of basins and branches
_WAIT = 600_000  # milliseconds; with an empty cache all programs are compiled first
_FRESH = 60  # clicks before the first memory measurement; compilation at the start is not growth

# Measures from the start of the next click to the second frame after its answer, in milliseconds, as `took`.
ARM = """() => {
    const number = vijax.number + 1;
    window.took = null;
    addEventListener("pointerdown", () => { window.began = performance.now(); }, { capture: true, once: true });
    const seen = new MutationObserver(() => {
        if (+document.body.dataset.shown < number) return;
        seen.disconnect();
        window.took = performance.now() - window.began;
    });
    seen.observe(document.body, { attributes: true });
}"""
FRAME = """() => {
    const frame = Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name("map")).frame.bbox;
    const box = document.getElementById("map").getBoundingClientRect();
    return [box.left + frame.left, box.top + frame.top, frame.width, frame.height];
}"""


@contextmanager
def default_map_server() -> Iterator[tuple[str, int]]:
    """Serve the default map; yield the address of its page and the number of the process."""
    line = [sys.executable, "-m", "vijax", "explore", "--no-browser", "--port", "0"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip(), process.pid
        finally:
            process.kill()


@contextmanager
def page_of(address: str, width: int = 1280, height: int = 800) -> Iterator[Any]:
    """Open a page in Chromium, and wait until everything is compiled."""
    from playwright.sync_api import sync_playwright

    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        raise FileNotFoundError("Chromium must be installed to look at the page with; got none")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": height})
        page.goto(address, timeout=_WAIT)
        settle(page)
        yield page
        browser.close()


def settle(page: Any) -> None:
    """Wait until the first motion is shown and all programs are compiled."""
    page.wait_for_function("document.body.dataset.shown !== undefined", timeout=_WAIT)
    page.wait_for_function("document.getElementById('compilation').hidden", timeout=_WAIT)


def memory(process: int) -> float:
    """Return the memory of a process in MB."""
    status = Path(f"/proc/{process}/status").read_text()
    (kilobytes,) = re.findall(r"^VmRSS:\s+(\d+) kB", status, re.M)
    return int(kilobytes) / 1024


def picks(count: int, seed: int) -> np.ndarray:
    """Draw random cells."""
    return np.random.default_rng(seed).integers(0, SIDES, (count, 2))


def page_numbers(page: Any) -> dict[str, str]:
    """Read the numbers of the picked cell from the page."""
    rows = page.evaluate(
        "[...document.querySelectorAll('#rows div')].map((row) => [...row.children].map((x) => x.textContent))"
    )
    return {str(name): str(text) for name, text in rows}


def expected(column: int, row: int) -> dict[str, str]:
    """Return the same numbers by vijax alone, with the same digits."""
    d, kappa = float(D[column]), float(KAPPA[row])
    dataset = vijax.sweep(d=d, kappa=kappa)
    cell_label = str(label(*(dataset[name].values for name in ("period", "impacts_left", "impacts_right", "status"))))
    error = float(dataset["P_stderr"])
    power = f"{float(dataset['P']):.6g} J per half period" + (f" \u00b1 {error:.2g} J" if error > 0 else "")
    pair, start = vijax.impact_pair(d, kappa, 0.5), (float(dataset["u0"]), float(dataset["v0"]))
    end = vijax.trajectory(pair, *start, periods=400).states
    multipliers, period = "no orbit", int(dataset["period"])
    impacts = int(dataset["impacts_left"] + dataset["impacts_right"])
    if period > 0 and impacts > MOST_IMPACTS:
        multipliers = f"not solved for, {impacts} impacts"
    elif period > 0:
        orbit = vijax.orbits_from_states(pair, end.u[-1], end.v[-1], period=period)
        if int(orbit.status[0]) == 0 and str(vijax.orbit_labels(orbit)[0]) == cell_label:
            values = np.asarray(orbit.multipliers)[0]
            multipliers = ", ".join(f"{x.real:.6g}" + (f"{x.imag:+.6g}i" if x.imag else "") for x in values)
    return {"label": cell_label, "P": power, "multipliers": multipliers}


def click(page: Any, pick: Any) -> float:
    """Click on a cell; return the milliseconds until its motion is on the screen, 0 for the current cell."""
    if page.evaluate("new URLSearchParams(location.search).get('cell')") == f"{pick[0]},{pick[1]}":
        return 0.0
    page.evaluate("scrollTo(0, 0)")
    left, top, width, height = page.evaluate(FRAME)
    page.evaluate(ARM)
    page.mouse.click(left + width * (pick[0] + 0.5) / SIDES[0], top + height * (1 - (pick[1] + 0.5) / SIDES[1]))
    page.wait_for_function("window.took !== null", timeout=_WAIT)
    return float(page.evaluate("window.took"))


def seconds(page: Any, name: str) -> float:
    """Measure the seconds of a panel from its button to its answer."""
    before = time.perf_counter()
    page.click(f'.compute[data-name="{name}"]')
    page.wait_for_function(
        f"""['done', 'failed'].includes(document.querySelector('[data-panel="{name}"]').dataset.state)""", timeout=_WAIT
    )
    return time.perf_counter() - before


def measure(clicks: int, long: int) -> Iterator[str]:
    """Measure all figures, one line each."""
    with default_map_server() as (address, process), page_of(address) as page:
        for pick in picks(_FRESH, 1):
            click(page, pick)
        times = [click(page, pick) for pick in picks(clicks, 2)]
        median, upper = np.percentile(times, [50, 95])
        yield f"click to motion on the screen, {clicks} cells: median {median:.0f} ms, 95 % within {upper:.0f} ms"
        different = 0
        for pick in picks(_COMPARED, 3):
            click(page, pick)
            library_numbers, page_values = expected(*pick), page_numbers(page)
            different += any(page_values[name] != text for name, text in library_numbers.items())
        yield f"cells whose label, P or multipliers differ from the library's: {different} of {_COMPARED}"
        for name in ("basin", "branch"):
            durations = []
            for pick in _ON_DEMAND:
                click(page, pick)
                durations.append(seconds(page, name))
            yield f"{name}, {len(durations)} cells: median {np.median(durations):.2f} s, at most {max(durations):.2f} s"
        before = time.perf_counter()
        page.goto(address, timeout=_WAIT)
        page.wait_for_function("document.body.dataset.shown !== undefined", timeout=_WAIT)
        yield f"load until the first motion is shown, all compiled: {time.perf_counter() - before:.2f} s"
        if long:
            memory_before = memory(process)
            for pick in picks(long, 4):
                click(page, pick)
            yield f"memory of the server over {long} clicks: {memory_before:.0f} to {memory(process):.0f} MB"


def picture(path: str, width: int, height: int) -> None:
    """Save a picture of the page with computed basins and branch."""
    with (
        default_map_server() as (address, _),
        page_of(f"{address}?variable=P&cell=40%2C46&along=kappa", width, height) as page,
    ):
        for name in ("basin", "branch"):
            seconds(page, name)
        page.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
        page.wait_for_timeout(500)
        page.screenshot(path=path)


def main() -> int:
    """Measure or draw, as the command line selects."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--clicks", type=int, default=100, help="cells that are clicked on [100]")
    parser.add_argument("--long", type=int, default=1000, help="clicks during which memory is measured [1000]")
    parser.add_argument("--picture", metavar="FILE.png", help="draw the page instead")
    parser.add_argument("--size", default="1280x800", metavar="WxH", help="of the picture [1280x800]")
    options = parser.parse_args()
    if options.picture:
        width, _, height = options.size.partition("x")
        picture(options.picture, int(width), int(height))
        return 0
    for line in measure(options.clicks, options.long):
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
