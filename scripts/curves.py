"""Curves of bifurcations over a map: `vijax curves`.

python scripts/curves.py
python scripts/curves.py --help  # options, and more lines to begin with
"""

from vijax.cli.curves import curves
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and give its exit code; see `process.run`."""
    return run(curves, arguments)


if __name__ == "__main__":
    command(main)
