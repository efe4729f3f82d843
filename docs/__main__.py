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

# XLA compiles during most of the time of a page, on one core. A kernel takes a gigabyte of memory.
AT_ONCE = min(os.cpu_count() or 1, 4)


def main(arguments: list[str] | None = None) -> int:
    """Build the pages, with warnings as errors, and return the exit code.

    With `--execute`, the code of all pages is executed first. Differences from the stored outputs are printed, the
    outputs are replaced, and the exit code is 1. The exit code is also 1 if a page fails.
    """
    parser = argparse.ArgumentParser(prog="python docs", description="Build the pages of vijax into docs/build.")
    parser.add_argument("--execute", action="store_true", help="execute the code of all pages anew, and compare")
    parser.add_argument("--stale", action="store_true", help="execute only pages whose code has changed")
    parser.add_argument("--into", type=Path, default=executed.HERE / "build", help="folder to build into")
    parsed = parser.parse_args(arguments)
    wrong = 0
    if parsed.execute or parsed.stale:
        try:
            with asyncio.Runner(loop_factory=_Loop) as runner:
                wrong = runner.run(_execute(executed.pages() if parsed.execute else executed.changed()))
        except KeyboardInterrupt:
            print("stopped; the outputs of the pages named above are kept", flush=True)
            return 130
        for path in executed.stray():  # of pages that no longer exist
            path.unlink()
    # In one process: the fork of a process with threads of JAX may hang.
    options = ["-b", "html", "-W", "--keep-going", "-q", "-d", str(parsed.into / "doctrees")]
    return build_main([*options, str(executed.HERE), str(parsed.into / "html")]) or min(wrong, 1)


class _Loop(asyncio.SelectorEventLoop):
    """An event loop that stops all pages at Ctrl-C; a client of a kernel would stop only its page."""

    def add_signal_handler(self, *_: object) -> None:
        """Raise the error that clients handle as in threads."""
        raise RuntimeError("Ctrl-C is handled by the loop")


async def _execute(pages: Iterable[Path]) -> int:
    """Execute pages, a few at once; print failures and changed outputs, and return the number of such pages."""
    free = asyncio.Semaphore(AT_ONCE)
    failed, changed, count = list[str](), list[str](), 0

    async def execute_page(page: Path) -> None:
        async with free:
            began, differences = time.perf_counter(), list[str]()
            try:
                differences = await executed.execute(page)
                changed.extend([page.name] if differences else [])
            except (CellControlSignal, DeadKernelError) as error:
                differences = [f"failed: {error}"]
                failed.append(page.name)
            print(f"{page.name}: {time.perf_counter() - began:.0f} s", *differences, sep="\n", flush=True)

    async with asyncio.TaskGroup() as group:
        for page in executed.longest_first(pages):
            group.create_task(execute_page(page))
            count += 1
    summary = f"other outputs than before on {', '.join(changed)}" if changed else "all outputs as before"
    if failed:
        summary += f"; failed: {', '.join(failed)}"
    print(f"executed {count} pages: {summary}", flush=True)
    return len(changed) + len(failed)


if __name__ == "__main__":
    sys.exit(main())
