"""`python scripts/check.py KEY=VALUE ...` is `reflectsep check KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["check", *sys.argv[1:]]))
