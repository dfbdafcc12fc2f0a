"""A program that runs sessions in children which the test kills: on its input a folder, and a line to ask how it ended.

Its output is the child's id, and then its status.

It forks from one process that has imported everything, so that a kill can hit any moment of the session itself.
"""

import os
import sys
from importlib import util
from pathlib import Path


def support():
    """tests/rig/conftest.py, by its path."""
    spec = util.spec_from_file_location("support", Path(__file__).with_name("conftest.py"))
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main():
    rig = support().Rig
    print("ready", flush=True)
    for line in sys.stdin:
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            os.read(read, 1)
            code = 1
            try:
                rig(Path(line.strip())).run(resume=True)
                code = 0
            finally:
                os._exit(code)
        print(child, flush=True)
        os.write(write, b"g")
        sys.stdin.readline()  # not before it is asked for: so the id stays the child's until it has been killed
        status = os.waitpid(child, 0)[1]
        os.close(read)
        os.close(write)
        print(status, flush=True)


if __name__ == "__main__":
    main()
