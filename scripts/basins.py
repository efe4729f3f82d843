"""Which attractor each start ends on: `vijax basins`.

python scripts/basins.py
python scripts/basins.py --help  # options, and more lines to begin with
"""

from vijax.cli.basins import basins
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and give its exit code; see `process.run`."""
    return run(basins, arguments)


if __name__ == "__main__":
    command(main)
