"""The best membrane: `vijax design`.

python scripts/design.py
python scripts/design.py --help  # options, and more lines to begin with
"""

from vijax.cli.design import design
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and give its exit code; see `process.run`."""
    return run(design, arguments)


if __name__ == "__main__":
    command(main)
