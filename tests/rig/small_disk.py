"""A program that runs sessions on file systems of its own, too small or read-only, and prints what became of them.

It is run in namespaces where it may mount (`unshare -rm`); what it mounts is seen by nobody else, and gone with it.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from killed import support

from reflectsep.errors import ReflectsepError


def mount(folder, options):
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)


def attempt(rig, **options):
    """How a session ended: the error's class and text; empty where it came to its end."""
    try:
        rig.run(**options)
    except Exception as error:
        return [type(error).__name__, str(error), isinstance(error, ReflectsepError)]
    return []


def main(folder, sizes_kb):
    tools = support()
    for size_kb in sizes_kb:
        disk = folder / f"{size_kb}"
        disk.mkdir()
        mount(disk, f"size={size_kb}k")
        rig = tools.Rig(disk / "session")
        ended = attempt(rig)
        facts = {"size_kb": size_kb, "ended": ended, "at_rest": rig.at_rest(), "told": rig.told}
        facts["done"] = tools.whole(rig.folder)
        mount(disk, f"remount,size={size_kb + 4000}k")
        facts["resumed"] = attempt(tools.Rig(disk / "session"), resume=True)
        facts["frames"] = tools.complete(rig.folder).sweeps[0].count
        print(json.dumps(facts), flush=True)
    read_only(folder, tools)
    exr(folder)


def exr(folder):
    from reflectsep.io.exr import write_channels

    disk = folder / "exr"
    disk.mkdir()
    mount(disk, "size=16k")
    try:
        write_channels(disk / "a.exr", {"Y": np.random.default_rng(0).random((200, 200)).astype(np.float32)})
    except OSError as error:
        print(json.dumps({"exr": str(error), "left": [path.name for path in disk.iterdir()]}), flush=True)


def read_only(folder, tools):
    disk = folder / "read_only"
    disk.mkdir()
    mount(disk, "ro")
    rig = tools.Rig(disk / "session")
    facts = {"read_only": attempt(rig), "moved": len(rig.bench.board.motion_lines), "at_rest": rig.at_rest()}
    print(json.dumps(facts), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), [int(word) for word in sys.argv[2:]])
