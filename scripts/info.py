"""`python scripts/info.py KEY=VALUE ...` is `reflectsep info KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["info", *sys.argv[1:]]))
