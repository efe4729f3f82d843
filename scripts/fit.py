"""Identification of a device from measured impacts: `vijax fit`.

python scripts/fit.py impacts.txt --timing-error 1e-4 --s 8mm --omega 5pi --omega0 150
python scripts/fit.py --help  # options and examples
"""

from vijax.cli.commands.fit import fit
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code; see `process.run`."""
    return run(fit, arguments)


if __name__ == "__main__":
    command(main)
