"""A map of harvested energy: `vijax sweep`, and `vijax compare` with --compare rigid.

python scripts/grid.py
python scripts/grid.py --help  # options and examples
"""

from vijax.cli.commands.grid import grid
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code; see `process.run`."""
    return run(grid, arguments)


if __name__ == "__main__":
    command(main)
