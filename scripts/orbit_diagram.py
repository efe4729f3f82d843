"""An orbit diagram: `vijax orbit-diagram`.

python scripts/orbit_diagram.py
python scripts/orbit_diagram.py --help  # options and examples
"""

from vijax.cli.commands.orbit_diagram import orbit_diagram
from vijax.cli.process import command, run


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code; see `process.run`."""
    return run(orbit_diagram, arguments)


if __name__ == "__main__":
    command(main)
