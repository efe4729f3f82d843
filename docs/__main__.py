"""Build the pages of vijax into docs/build: python docs [--execute]."""

import argparse
import asyncio
import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path

from nbclient.exceptions import CellControlSignal, DeadKernelError
from sphinx.cmd.build import build_main

from docs import executed

# Most of a page's time XLA compiles, on one core. A kernel takes a gigabyte.
AT_ONCE = min(os.cpu_count() or 1, 4)


def main(arguments: list[str] | None = None) -> int:
    """Build the pages, with warnings as errors, and give the exit code.

    With `--execute` the code of every page is executed anew first. What differs from the outputs that are kept is
    printed, the outputs are replaced, and the exit code is 1, as it is where a page fails.
    """
    parser = argparse.ArgumentParser(prog="python docs", description="Build the pages of vijax into docs/build.")
    parser.add_argument("--execute", action="store_true", help="execute the code of all pages anew, and compare")
    parser.add_argument("--stale", action="store_true", help="execute only pages whose code has changed")
    parser.add_argument("--into", type=Path, default=executed.HERE / "build", help="folder to build into")
    asked = parser.parse_args(arguments)
    wrong = 0
    if asked.execute or asked.stale:
        try:
            with asyncio.Runner(loop_factory=_Loop) as runner:
                wrong = runner.run(_execute(executed.pages() if asked.execute else executed.changed()))
        except KeyboardInterrupt:
            print("stopped; the outputs of the pages named above are kept", flush=True)
            return 130
        for path in executed.stray():  # of pages that are no more
            path.unlink()
    # In one process: a fork of one in which JAX runs threads may never end.
    options = ["-b", "html", "-W", "--keep-going", "-q", "-d", str(asked.into / "doctrees")]
    return build_main([*options, str(executed.HERE), str(asked.into / "html")]) or min(wrong, 1)


class _Loop(asyncio.SelectorEventLoop):
    """A loop in which Ctrl-C stops all pages: every client would take it for a wish to stop its own."""

    def add_signal_handler(self, *_: object) -> None:
        """Refuse, in the way that clients know from threads."""
        raise RuntimeError("Ctrl-C is handled by the loop")


async def _execute(pages: Iterable[Path]) -> int:
    """Execute pages, a few at once, say what failed or differs from outputs that were kept; count such pages."""
    free = asyncio.Semaphore(AT_ONCE)
    failed, changed, count = list[str](), list[str](), 0

    async def one(page: Path) -> None:
        async with free:
            began, found = time.perf_counter(), list[str]()
            try:
                found = await executed.execute(page)
                changed.extend([page.name] if found else [])
            except (CellControlSignal, DeadKernelError) as error:
                found = [f"failed: {error}"]
                failed.append(page.name)
            print(f"{page.name}: {time.perf_counter() - began:.0f} s", *found, sep="\n", flush=True)

    async with asyncio.TaskGroup() as group:
        for page in executed.longest_first(pages):
            group.create_task(one(page))
            count += 1
    said = f"other outputs than before on {', '.join(changed)}" if changed else "all outputs as before"
    if failed:
        said += f"; failed: {', '.join(failed)}"
    print(f"executed {count} pages: {said}", flush=True)
    return len(changed) + len(failed)


if __name__ == "__main__":
    sys.exit(main())
