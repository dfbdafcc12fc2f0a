"""`python scripts/relight.py KEY=VALUE ...` is `reflectsep relight KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["relight", *sys.argv[1:]]))
