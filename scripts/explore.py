"""A page in the browser to explore a map: `vijax explore`.

python scripts/explore.py
python scripts/explore.py --help  # options and examples
"""

from vijax.cli.commands.explore import explore
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code; see `process.run`."""
    return run(explore, arguments)


if __name__ == "__main__":
    command(main)
