"""`python scripts/report.py KEY=VALUE ...` is `reflectsep report KEY=VALUE ...`."""

import sys

from reflectsep.cli import main

if __name__ == "__main__":
    sys.exit(main(["report", *sys.argv[1:]]))
