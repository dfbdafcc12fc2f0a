"""`python scripts/simulate.py KEY=VALUE ...` is `reflectsep simulate KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["simulate", *sys.argv[1:]]))
