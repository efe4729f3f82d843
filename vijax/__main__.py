"""`python -m vijax` is the command `vijax`."""

import sys

from vijax.cli.main import main

sys.exit(main())
