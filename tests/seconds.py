"""Processor time of each test file, recorded in `tests/seconds.json`.

Two programs read the record: pytest starts the dearest files first, so that all workers end together, and
`scripts/tests_for.py` lists the cheapest files first. `pytest --record-seconds` measures it anew.
"""

import json
from pathlib import Path

RECORD = Path(__file__).with_name("seconds.json")


def recorded() -> dict[str, float]:
    """Return the seconds of each recorded test file, by its path relative to the root of the repository."""
    return json.loads(RECORD.read_text(encoding="utf-8"))


def record(seconds: dict[str, float]) -> None:
    """Write the seconds of each test file, to a tenth of a second."""
    rounded = {path: round(seconds[path], 1) for path in sorted(seconds)}
    RECORD.write_text(json.dumps(rounded, indent=1) + "\n", encoding="utf-8")
