"""The command `vijax`, which `python -m vijax` is too."""

from typing import NoReturn


def command() -> NoReturn:
    """Run the command as a shell calls it: the process ends with its exit code."""
    from vijax.cli import signals

    signals.own_process()  # before anything is imported that takes time
    from vijax.cli.main import main
    from vijax.cli.process import leave

    leave(main())


if __name__ == "__main__":
    command()
