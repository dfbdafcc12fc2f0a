"""`python scripts/compare.py KEY=VALUE ...` is `reflectsep compare KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["compare", *sys.argv[1:]]))
