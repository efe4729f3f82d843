"""Entry point of the command `vijax`, also run by `python -m vijax`."""

from typing import NoReturn


def command() -> NoReturn:
    """Run the command for a shell: the process ends with its exit code."""
    from vijax.cli import signals

    signals.own_signals()  # before any slow import
    from vijax.cli.main import main
    from vijax.cli.process import leave

    leave(main())


if __name__ == "__main__":
    command()
