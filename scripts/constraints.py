"""Print the name of the constraints file for this version of Python: `python3 -m scripts.constraints`."""

import re
import sys
from pathlib import Path

_ROOT = Path(__file__).parent.parent


def file_for(version: tuple[int, ...]) -> str:
    """Return the name of the constraints file for a version of Python.

    The newest JAX has no release for Python 3.11, so one file cannot serve all versions.
    """
    return "constraints-3.13.txt" if version >= (3, 13) else "constraints.txt"


def pinned(file: str) -> dict[str, str]:
    """Return the pinned version of each distribution in a file, by normalised name."""
    pins = re.findall(r"^([\w.-]+)==(.+)$", (_ROOT / file).read_text(encoding="utf-8"), re.M)
    # Normalisation of PEP 503: runs of - _ . become one -.
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in pins}


if __name__ == "__main__":
    print(file_for(sys.version_info[:2]))
