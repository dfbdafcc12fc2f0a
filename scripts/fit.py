"""`python scripts/fit.py KEY=VALUE ...` is `reflectsep fit KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["fit", *sys.argv[1:]]))
