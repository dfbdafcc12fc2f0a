"""`python scripts/capture.py KEY=VALUE ...` is `reflectsep capture KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["capture", *sys.argv[1:]]))
