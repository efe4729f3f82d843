"""Branches of periodic orbits: `vijax branch`.

python scripts/branch.py
python scripts/branch.py --help  # options and examples
"""

from vijax.cli.commands.branch import branch
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code; see `process.run`."""
    return run(branch, arguments)


if __name__ == "__main__":
    command(main)
