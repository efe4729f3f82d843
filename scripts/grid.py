"""A map of harvested energy: `vijax sweep`, and `vijax compare` with --compare rigid.

python scripts/grid.py
python scripts/grid.py --help  # options, and more lines to begin with
"""

from vijax.cli.grid import grid
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and give its exit code; see `process.run`."""
    return run(grid, arguments)


if __name__ == "__main__":
    command(main)
