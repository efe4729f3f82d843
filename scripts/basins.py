"""The attractor that each start reaches: `vijax basins`.

python scripts/basins.py
python scripts/basins.py --help  # options and examples
"""

from vijax.cli.commands.basins import basins
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code; see `process.run`."""
    return run(basins, arguments)


if __name__ == "__main__":
    command(main)
