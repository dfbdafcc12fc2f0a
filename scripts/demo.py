"""`python scripts/demo.py KEY=VALUE ...` is `reflectsep demo KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["demo", *sys.argv[1:]]))
