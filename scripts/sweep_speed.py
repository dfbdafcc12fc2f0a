"""Speed of the sweep analysis against decoding its frames alone, and its memory against their number.

`python scripts/sweep_speed.py [frames=300] [size=1920x1080] [format=png] [n_d=1] [rounds=2] [memory=60,150,300]
[folder=TEMPORARY]`

Writes frames of a synthetic object (a bright slab over a scattering disc on a black level, sensor noise) and goes
through them as a fit does: dark level subtracted, first pass (passage), second pass (profiles and their fit), and what
comes once a sweep. Decoding alone and the analysis take turns, on one core and on all; time is the clock's, with the
processors' beside it. Memory is that of fresh processes with sweeps of different length over the same object.
`format`: png (16 bits), tif (16 bits, no compression) or exr (half, ZIP). `n_d=estimate` leaves the exponent open.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import tifffile
import torch

from reflectsep.calibrate.develop import linear_response
from reflectsep.calibrate.exposure import DevelopedStream
from reflectsep.data import FrameStream, Light, PhotometricStack, Sweep
from reflectsep.io.frames import FileFrames
from reflectsep.io.pictures import read_picture, write_picture
from reflectsep.scatter.measure import measure_scattering
from reflectsep.scatter.options import ScatterOptions

SPREAD_PX, NOISE, BLACK = 15.0, 40.0 / 65535, 1000.0 / 65535
LIT_FRAMES = 1.9
"""Width of the slab in steps of a frame."""
USAGE = __doc__


@dataclass(frozen=True, kw_only=True)
class Setup:
    """A swept disc on disk."""

    folder: Path
    frames: int
    size: tuple[int, int]
    kind: str

    def pictures(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Full picture (1, height, width) and mask."""
        full = read_picture(self.folder / "full.exr")[0]
        return full, full[0] > 0

    def streams(self) -> list[FrameStream]:
        """Three lights that share their files."""
        found: list[FrameStream] = []
        for name in ("L1", "L2", "L3"):
            sweep = Sweep(light=name, frames=f"{{:04d}}.{self.kind}", count=self.frames)
            files = FileFrames(sweep=sweep, folder=self.folder, size=self.size, channels=1)
            dark = torch.full((1, self.size[1], self.size[0]), BLACK)
            light = Light(name=name, direction=None)
            found.append(
                DevelopedStream(
                    stream=files, response=linear_response, dark=dark, ratio=1.0, light=light, where=str(self.folder)
                )
            )
        return found

    def files(self) -> FrameStream:
        """Of the first light, as stored."""
        stream = self.streams()[0]
        assert isinstance(stream, DevelopedStream)
        return stream.stream


def write_frames(setup: Setup) -> None:
    """Frames of a slab that moves from left to right, and the full picture."""
    width, height = setup.size
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    disc = (((x - width / 2) / (0.46 * width)) ** 2 + ((y - height / 2) / (0.46 * height)) ** 2) < 1
    step = width / setup.frames
    slab = LIT_FRAMES * step
    total = np.zeros((height, width))
    for index in range(setup.frames):
        away = np.abs(x[0] - (index + 0.5) * step)
        lit = np.clip(slab / 2 + 0.5 - away, 0, 1)
        spread = np.exp(-np.maximum(away - slab / 2, 0) / SPREAD_PX)
        frame = disc * (0.35 * lit + 0.12 * spread)[None]
        total += frame
        noisy = np.clip(frame + BLACK + NOISE * rng.standard_normal(frame.shape), 0, 1)
        write_frame(setup.folder / f"{index:04d}.{setup.kind}", noisy)
    write_picture(setup.folder / "full.exr", torch.from_numpy(total / LIT_FRAMES).float()[None])


def write_frame(path: Path, values: np.ndarray) -> None:
    """A frame in the format that its suffix names."""
    if path.suffix == ".exr":
        write_picture(path, torch.from_numpy(values).half()[None])
    elif path.suffix == ".png":
        write_picture(path, torch.from_numpy(values)[None], bits=16)
    else:
        tifffile.imwrite(path, np.rint(values * 65535).astype(np.uint16))


def resident_peak() -> float:
    """MiB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("/proc/self/status has no VmHWM")


class Times:
    """Clock and processor seconds of the parts of a run."""

    def __init__(self) -> None:
        self.clock: dict[str, float] = {}
        self.processor: dict[str, float] = {}
        self._last = (time.perf_counter(), time.process_time())

    def lap(self, part: str) -> None:
        """What has passed since the last lap belongs to `part`."""
        now = (time.perf_counter(), time.process_time())
        self.clock[part] = self.clock.get(part, 0.0) + now[0] - self._last[0]
        self.processor[part] = self.processor.get(part, 0.0) + now[1] - self._last[1]
        self._last = now


def analyse(setup: Setup, n_d: float | None) -> Times:
    """The whole analysis of three sweeps, its parts timed by what it tells of its progress."""
    full, mask = setup.pictures()
    images = full.expand(3, *full.shape).contiguous()
    stack = PhotometricStack(
        names=("L1", "L2", "L3"),
        images=images,
        mask=mask,
        saturated=torch.zeros_like(images, dtype=torch.bool),
        flags=torch.zeros(mask.shape, dtype=torch.int32),
        alpha=torch.eye(3),
        light_vectors=None,
        view=torch.tensor([0.0, 0.0, 1.0]),
    )
    times = Times()

    def watch(stage: str, done: int, total: int) -> None:  # noqa: ARG001
        # The first frame of a pass comes after what was done once before it.
        times.lap("once" if done == 1 else stage.rsplit(" ", 1)[1])

    measure_scattering(stack, setup.streams(), options=ScatterOptions(n_d=n_d), progress=watch)
    times.lap("once")
    return times


def decode(setup: Setup) -> Times:
    """Every frame once, nothing done with it."""
    times = Times()
    for _ in setup.files():
        pass
    times.lap("decode")
    return times


def use_cores(count: int) -> None:
    """Keep to so many of the cores that this process was given."""
    torch.set_num_threads(count)
    with suppress(AttributeError):
        os.sched_setaffinity(0, sorted(CORES)[-count:])


CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def compare(setup: Setup, cores: int, rounds: int, n_d: float | None) -> None:
    """Decoding and analysis in turn; medians of the ratios within a round."""
    use_cores(cores)
    runs = [(decode(setup), analyse(setup, n_d)) for _ in range(rounds)]
    frames = setup.frames

    def ratio(parts: list[str], passes: int) -> str:
        """Of these parts to as many passes of decoding, by the clock and by the processors."""
        clock = median(sum(a.clock[p] for p in parts) / passes / d.clock["decode"] for d, a in runs)
        busy = median(sum(a.processor[p] for p in parts) / passes / d.processor["decode"] for d, a in runs)
        return f"{clock:6.2f} x decoding ({busy:.2f} x by processor time)"

    alone = median(d.clock["decode"] for d, _ in runs)
    whole = median(sum(a.clock.values()) / 3 for _, a in runs)
    print(f"{cores} core{'s' if cores > 1 else ''}: decoding alone {1e3 * alone / frames:.1f} ms a frame, ", end="")
    print(f"{frames / alone:.1f} frames a second; both passes {frames / whole:.1f} frames a second")
    for part, name in (("passage", "first pass"), ("scattering", "second pass"), ("once", "once a sweep")):
        print(f"  {name:36s} {ratio([part], 3)}")
    print(f"  {'all, to two passes of decoding':36s} {ratio(['passage', 'scattering', 'once'], 6)}")


def memory(setup: Setup, n_d: float | None) -> dict[str, float]:
    """Peak of a fresh process: MiB before, after decoding alone, and after the analysis."""
    use_cores(len(CORES))
    start = resident_peak()
    decode(setup)
    decoded = resident_peak()
    analyse(setup, n_d)
    return {"start": start, "decode": decoded, "analysis": resident_peak()}


def memories(setup: Setup, counts: list[int], n_d: str) -> None:
    """Peaks for sweeps of different length over the same object."""
    for count in counts:
        with tempfile.TemporaryDirectory(dir=setup.folder.parent) as folder:
            shorter = replace(setup, folder=Path(folder), frames=count)
            write_frames(shorter)
            size = "x".join(map(str, setup.size))
            said = [f"frames={count}", f"size={size}", f"format={setup.kind}", f"n_d={n_d}", f"measure={folder}"]
            done = subprocess.run([sys.executable, __file__, *said], check=True, capture_output=True, text=True)
            peak = json.loads(done.stdout)
        print(f"  {count:5d} frames: peak {peak['analysis']:.0f} MiB, decoding alone {peak['decode']:.0f}, "
              f"before {peak['start']:.0f}")  # fmt: skip


def settings(arguments: list[str]) -> dict[str, Any]:
    """What the command line says.

    Raises:
        ValueError: an unknown name or an impossible value.
    """
    given = {"frames": "300", "size": "1920x1080", "format": "png", "n_d": "1", "rounds": "2", "memory": "60,150,300"}
    given |= {"folder": "", "measure": ""}
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name not in given:
            raise ValueError(f"{argument}: known are {', '.join(given)}")
        given[name] = value
    if given["format"] not in ("png", "tif", "exr"):
        raise ValueError(f"format={given['format']}: png, tif or exr was expected")
    width, height = map(int, given["size"].split("x"))
    counts = [int(count) for count in given["memory"].split(",") if count]
    n_d = None if given["n_d"] == "estimate" else float(given["n_d"])
    found = {"frames": int(given["frames"]), "rounds": int(given["rounds"])}
    return {**given, **found, "size": (width, height), "memory": counts, "exponent": n_d}


def main(arguments: list[str]) -> int:
    """Write frames, measure, clean up."""
    try:
        given = settings(arguments)
    except ValueError as error:
        print(f"{error}\n\n{USAGE}", file=sys.stderr)
        return 2
    setup = Setup(folder=Path(), frames=given["frames"], size=given["size"], kind=given["format"])
    if given["measure"]:
        print(json.dumps(memory(replace(setup, folder=Path(given["measure"])), given["exponent"])))
        return 0
    with tempfile.TemporaryDirectory(dir=given["folder"] or None) as folder:
        setup = replace(setup, folder=Path(folder) / "sweep")
        setup.folder.mkdir()
        write_frames(setup)
        width, height = setup.size
        print(f"{setup.frames} frames of {width}x{height}, {setup.kind}; medians of {given['rounds']} rounds")
        for cores in sorted({1, len(CORES)}):
            compare(setup, cores, given["rounds"], given["exponent"])
        print("memory:")
        memories(setup, given["memory"], given["n_d"])
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
