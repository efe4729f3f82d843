"""Bifurcation curves over a map: `vijax curves`.

python scripts/curves.py
python scripts/curves.py --help  # options and examples
"""

from vijax.cli.commands.curves import curves
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code; see `process.run`."""
    return run(curves, arguments)


if __name__ == "__main__":
    command(main)
