"""The best design of a harvester: `vijax design`.

python scripts/design.py
python scripts/design.py --help  # options and examples
"""

from vijax.cli.commands.design import design
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code; see `process.run`."""
    return run(design, arguments)


if __name__ == "__main__":
    command(main)
