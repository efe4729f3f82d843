"""Print the name of the file of tested versions that fits this Python: `python3 -m scripts.constraints`."""

import re
import sys
from pathlib import Path

_ROOT = Path(__file__).parent.parent


def file_for(version: tuple[int, ...]) -> str:
    """Return the name of the file for a version of Python.

    The newest JAX has no release for Python 3.11, so that one file does not serve all.
    """
    return "constraints-3.13.txt" if version >= (3, 13) else "constraints.txt"


def pinned(file: str) -> dict[str, str]:
    """Return the version of each distribution that a file names, by its normalized name."""
    pins = re.findall(r"^([\w.-]+)==(.+)$", (_ROOT / file).read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in pins}


if __name__ == "__main__":
    print(file_for(sys.version_info[:2]))
