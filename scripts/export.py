"""`python scripts/export.py KEY=VALUE ...` is `reflectsep export KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["export", *sys.argv[1:]]))
