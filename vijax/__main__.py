"""`python -m vijax` is the command `vijax`."""

import sys

from vijax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
