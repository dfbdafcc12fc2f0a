"""Disks that are full, or cannot be written, in earnest: file systems of a few pages, mounted for the test alone."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import reflectsep
from reflectsep.errors import SessionError

SIZES_KB = (8, 16, 32, 100, 148)
"""From one in which the session hardly begins to one that fills with the last frames of the sweep."""


@pytest.fixture(scope="module")
def disks(tmp_path_factory):
    if subprocess.run(["unshare", "-rm", "true"], capture_output=True, check=False).returncode:
        pytest.skip("nobody may mount here")
    folder = tmp_path_factory.mktemp("disks")
    environment = os.environ | {"PYTHONPATH": str(Path(reflectsep.__file__).parent.parent)}
    program = [sys.executable, str(Path(__file__).with_name("small_disk.py")), str(folder), *map(str, SIZES_KB)]
    done = subprocess.run(["unshare", "-rm", *program], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize("size_kb", SIZES_KB)
def test_disk_that_fills_stops_the_rig_and_the_session_goes_on_when_there_is_room(size_kb, disks, record_fault):
    facts = next(item for item in disks if item.get("size_kb") == size_kb)
    kind, text, ours = facts["ended"]
    assert ours, kind
    assert text.endswith("No space left on device; the rig is stopped, resume=true goes on from this step")
    assert facts["at_rest"]
    assert facts["resumed"] == []
    assert facts["frames"] == 20
    record_fault(f"disk of {size_kb} kB", text, facts["told"][-1], f"{len(facts['done'])} steps whole", "completes")


def test_disks_fill_at_different_steps(disks):
    steps = {item["ended"][1].split(": ")[1] for item in disks if "ended" in item}
    assert {"start", "full-L1", "sweep-L1-x"} <= steps


def test_read_only_disk_says_so_before_anything_moves(disks, record_fault):
    facts = next(item for item in disks if "read_only" in item)
    kind, text, _ = facts["read_only"]
    assert kind == "SessionError"
    assert text.endswith("session: cannot be written: Read-only file system")
    assert facts["moved"] == 0
    record_fault("read-only folder", text, "not begun", "nothing", "elsewhere")


def test_folder_that_this_user_may_not_write_says_so(tmp_path, rig_in):
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o500)
    with pytest.raises(SessionError, match="session: cannot be written: Permission denied"):
        rig_in().run()
    tmp_path.chmod(0o700)


def test_exr_on_a_full_disk_is_an_error_of_the_disk_and_leaves_nothing(disks):
    (facts,) = [item for item in disks if "exr" in item]
    assert "No space left on device" in facts["exr"]
    assert facts["left"] == []
