"""Flags of XLA for tests, without flags that the installed XLA does not support."""

import os
import re
import subprocess
import sys

_STARTS_XLA = "from jaxlib import xla_client; xla_client.make_cpu_client()"


def supported_flags(flags: tuple[str, ...]) -> tuple[str, ...]:
    """Return the flags that the installed XLA supports.

    A process ends at a flag in XLA_FLAGS that its XLA does not support. A child process therefore tries them.

    Raises:
        RuntimeError: The process ended for another reason.
    """
    environment = os.environ | {"XLA_FLAGS": " ".join(flags)}
    tried = subprocess.run(
        [sys.executable, "-c", _STARTS_XLA], env=environment, capture_output=True, text=True, check=False
    )
    if tried.returncode == 0:
        return flags
    report = re.search(r"Unknown flags? in XLA_FLAGS: (.*)", tried.stderr)
    if report is None:
        raise RuntimeError(f"XLA must start with the flags of the tests; got\n{tried.stderr}")
    unknown = report[1].split()
    return tuple(flag for flag in flags if flag not in unknown)
