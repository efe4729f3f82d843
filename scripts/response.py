"""What one device does under noise or a measured record: `vijax response`.

python scripts/response.py --noise 0.05,32
python scripts/response.py --help  # options, and more lines to begin with
"""

from vijax.cli.process import command, run
from vijax.cli.response import response


def main(arguments: list[str] | None = None) -> int:
    """Run the command and give its exit code; see `process.run`."""
    return run(response, arguments)


if __name__ == "__main__":
    command(main)
