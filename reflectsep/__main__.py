"""`python -m reflectsep` is the command `reflectsep`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main())
