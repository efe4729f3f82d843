"""`python -m vijax` is the command `vijax`."""

from vijax.cli.main import command

if __name__ == "__main__":
    command()
