"""SIGKILL at random moments: the folder is always readable, and the capture is that of an undisturbed session."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import reflectsep
from reflectsep.errors import ReflectsepError
from reflectsep.io.capture import load_capture
from reflectsep.io.files import sha256
from reflectsep.rig.session import read_events

from .conftest import complete, whole


@contextmanager
def server():
    environment = os.environ | {"PYTHONPATH": str(Path(reflectsep.__file__).parent.parent)}
    command = [sys.executable, str(Path(__file__).with_name("killed.py"))]
    with subprocess.Popen(command, stdin=-1, stdout=-1, text=True, env=environment) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert process.stdout.readline() == "ready\n"
        yield process
        process.stdin.close()


def session(process, folder, kill_after_s=None):
    """Run a session; returns whether it came to its end, and how long it took."""
    began = time.monotonic()
    process.stdin.write(f"{folder}\n")
    process.stdin.flush()
    child = int(process.stdout.readline())
    if kill_after_s is not None:
        time.sleep(kill_after_s)
        os.kill(child, signal.SIGKILL)  # at the worst a zombie: the server waits for it only when asked
    process.stdin.write("wait\n")
    process.stdin.flush()
    status = int(process.stdout.readline())
    assert status in (0, signal.SIGKILL)
    return status == 0, time.monotonic() - began


def check_kills(tmp_path, kills):
    draw = random.Random(0)
    with server() as process:
        _, duration_s = session(process, tmp_path / "undisturbed")
        wanted = complete(tmp_path / "undisturbed")
        killed, tries, parts = 0, 0, set()
        while killed < kills:
            folder = tmp_path / f"killed{tries}"
            tries += 1
            done, _ = session(process, folder, draw.uniform(0, duration_s))
            killed += not done
            parts.add(len(check_readable(folder)))
            if done:
                continue
            # Half of them are killed a second time, while they resume.
            if draw.random() < 0.5:
                session(process, folder, draw.uniform(0, duration_s))
                check_readable(folder)
            assert session(process, folder)[0]
            check_same(complete(folder), wanted)
    print(f"{killed} killed of {tries}, after {sorted(parts)} steps")
    assert len(parts) > (3 if kills > 50 else 1)  # the moments differ


def check_readable(folder):
    done = whole(folder)
    if (folder / "events.jsonl").exists():
        named = [e["file"] for e in read_events(folder) if e["event"] == "frame" and e["file"]]
        assert all(isinstance(name, str) for name in named)
    if (folder / "capture.json").exists():
        complete(folder)
    elif folder.exists():
        with pytest.raises(ReflectsepError):
            load_capture(folder)
    return done


def check_same(found, wanted):
    assert [(p.file, p.sha256, p.exposure_s) for p in found.images] == [
        (p.file, p.sha256, p.exposure_s) for p in wanted.images
    ]
    (ours,), (theirs,) = found.sweeps, wanted.sweeps
    assert (ours.count, ours.lost) == (theirs.count, theirs.lost)
    assert np.array(ours.position_mm) == pytest.approx(np.array(theirs.position_mm), abs=1e-6)
    assert ours.sha256 == theirs.sha256
    assert sha256(found.folder / "mask.png") == sha256(wanted.folder / "mask.png")


def test_killed_at_some_moments(tmp_path):
    check_kills(tmp_path, 8)


@pytest.mark.slow
def test_killed_at_a_hundred_moments(tmp_path, record_fault):
    check_kills(tmp_path, 100)
    record_fault("SIGKILL", "nothing", "unknown until homed", "whole at 100 random moments", "the same files")
