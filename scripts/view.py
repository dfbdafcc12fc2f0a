"""`python scripts/view.py KEY=VALUE ...` is `reflectsep view KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["view", *sys.argv[1:]]))
