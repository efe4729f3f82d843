"""Statistics of one device under noise or a measured record: `vijax response`.

python scripts/response.py --noise 0.05,32
python scripts/response.py --help  # options and examples
"""

from vijax.cli.commands.response import response
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code; see `process.run`."""
    return run(response, arguments)


if __name__ == "__main__":
    command(main)
