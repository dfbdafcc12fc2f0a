"""`python scripts/calibrate.py KEY=VALUE ...` is `reflectsep calibrate KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["calibrate", *sys.argv[1:]]))
