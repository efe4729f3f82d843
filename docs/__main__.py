"""Build the pages of vijax into docs/build: python docs [--execute]."""

import argparse
import sys
import time
from collections.abc import Iterable
from pathlib import Path

from sphinx.cmd.build import build_main

from docs import executed


def main(arguments: list[str] | None = None) -> int:
    """Build the pages, with warnings as errors, and give the exit code.

    With `--execute` the code of every page is executed anew first. What differs from the outputs that are kept is
    printed, the outputs are replaced, and the exit code is 1.
    """
    parser = argparse.ArgumentParser(prog="python docs", description="Build the pages of vijax into docs/build.")
    parser.add_argument("--execute", action="store_true", help="execute the code of all pages anew, and compare")
    parser.add_argument("--stale", action="store_true", help="execute only pages whose code has changed")
    parser.add_argument("--into", type=Path, default=executed.HERE / "build", help="folder to build into")
    asked = parser.parse_args(arguments)
    differences = 0
    if asked.execute or asked.stale:
        try:
            differences = _execute(executed.pages() if asked.execute else executed.changed())
        except KeyboardInterrupt:
            print("stopped; the outputs of the pages named above are kept", flush=True)
            return 130
        for path in executed.stray():  # of pages that are no more
            path.unlink()
    # In one process: a fork of one in which JAX runs threads may never end.
    options = ["-b", "html", "-W", "--keep-going", "-q", "-d", str(asked.into / "doctrees")]
    return build_main([*options, str(executed.HERE), str(asked.into / "html")]) or min(differences, 1)


def _execute(pages: Iterable[Path]) -> int:
    """Execute pages one after another, say what differs from the outputs that were kept, and count it."""
    counts = {}
    for page in pages:
        began = time.perf_counter()
        found = executed.execute(page)
        counts[page.name] = len(found)
        print(f"{page.name}: {time.perf_counter() - began:.0f} s", *found, sep="\n", flush=True)
    changed = [name for name, count in counts.items() if count]
    said = f"other outputs than before on {', '.join(changed)}" if changed else "all outputs as before"
    print(f"executed {len(counts)} pages: {said}", flush=True)
    return sum(counts.values())


if __name__ == "__main__":
    sys.exit(main())
