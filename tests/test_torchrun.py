"""A fit shared among processes, as `torchrun` starts them."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from reflectsep.config import ObjectSettings, SimulateJob
from reflectsep.jobs import run_simulate
from reflectsep.separation import load

pytestmark = pytest.mark.slow

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}


def fit_words(capture: Path, out: Path) -> list[str]:
    quick = ["report=false", "fit.chunk=128", "fit.max_iterations=6"]
    return ["-m", "reflectsep", "fit", f"capture={capture}", f"out={out}", *quick]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shared") / "wax"
    run_simulate(SimulateJob(object=ObjectSettings(name="wax", size_px=32), out=str(folder)))
    return folder


def test_two_processes_give_the_result_of_one(tmp_path, capture):
    subprocess.run([sys.executable, *fit_words(capture, tmp_path / "one")], env=ENVIRONMENT, check=True)
    words = [*TORCHRUN, *fit_words(capture, tmp_path / "two"), "--progress"]
    shared = subprocess.run(words, env=ENVIRONMENT, check=True, capture_output=True, text=True, timeout=200)
    assert shared.stdout.count("Wu & Tang") == 1
    one, two = load(tmp_path / "one"), load(tmp_path / "two")
    for name in ("a", "n_s", "B", "d", "s", "specular", "scattering", "s_sd", "flags", "d_sd"):
        torch.testing.assert_close(getattr(two, name), getattr(one, name), rtol=1e-6, atol=1e-9)
    assert one.document["sweeps"] == two.document["sweeps"]
    for step in ("passage", "scattering"):  # the first process goes through the first and the third sweep
        walked = [line.split()[1] for line in shared.stderr.splitlines() if line.startswith("sweep ") and step in line]
        assert sorted(set(walked)) == ["L1", "L3"]
    assert one.document["alignment"] == two.document["alignment"]


def test_a_killed_process_ends_the_run_with_nothing_written(tmp_path, capture):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        shared = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
    words = [sys.executable, *fit_words(capture, tmp_path / "out"), "--progress"]
    first, second = (
        subprocess.Popen(words, env=ENVIRONMENT | shared | {"RANK": rank}, stderr=subprocess.PIPE, text=True)
        for rank in ("0", "1")
    )
    assert first.stderr is not None
    assert any("globals" in line for line in first.stderr)  # reads until it is under way
    second.send_signal(signal.SIGKILL)
    _, said = first.communicate(timeout=120)
    second.communicate(timeout=10)
    assert first.returncode == 1
    assert said.splitlines()[-1].startswith("reflectsep: error: another process of this run is gone")
    assert not (tmp_path / "out").exists()


def test_only_a_fit_is_shared(capture):
    words = [*TORCHRUN, "-m", "reflectsep", "info", str(capture)]
    ended = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=100)
    assert ended.returncode != 0
    assert ended.stderr.count("reflectsep: error: info: only fit shares its work among processes") == 1
