"""`python scripts/capture_and_fit.py KEY=VALUE ...` is `reflectsep capture_and_fit KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["capture_and_fit", *sys.argv[1:]]))
