"""Build the pages of vijax into docs/build: python docs [--execute]."""

import argparse
import sys
import time
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
    for page in executed.pages():
        if asked.execute or (asked.stale and executed.kept(executed.read_page(page)) is None):
            began = time.perf_counter()
            found = executed.execute(page)
            differences += len(found)
            print(f"{page.name}: {time.perf_counter() - began:.0f} s", *found, sep="\n", flush=True)
    if asked.execute or asked.stale:
        for path in executed.stray():  # of pages that are no more
            path.unlink()
    # In one process: a fork of one in which JAX runs threads may never end.
    options = ["-b", "html", "-W", "--keep-going", "-q", "-d", str(asked.into / "doctrees")]
    return build_main([*options, str(executed.HERE), str(asked.into / "html")]) or min(differences, 1)


if __name__ == "__main__":
    sys.exit(main())
