"""Speed of the sweep analysis against decoding its frames alone, and its memory against their number.

`python scripts/sweep_speed.py [frames=300] [size=1920x1080] [format=png] [folder=TEMPORARY]`

Writes synthetic 16-bit frames (a bright slab over a scattering disc, sensor noise) and reports processor time a frame:
decoding alone, the first pass (passage), the second pass (profiles), and what comes once a sweep whatever the number
of frames (the fit of the profiles). `format`: png, or tif without compression.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tifffile
import torch

from reflectsep.data import PhotometricStack, Sweep
from reflectsep.io.frames import FileFrames
from reflectsep.io.pictures import write_picture
from reflectsep.progress import silent
from reflectsep.scatter.gains import choose_samples, exponents
from reflectsep.scatter.measure import measure_scattering
from reflectsep.scatter.options import ScatterOptions
from reflectsep.scatter.passage import watch

SLAB_PX, SPREAD_PX, NOISE = 12.0, 15.0, 40.0 / 65535


@dataclass(frozen=True)
class Setup:
    """A swept disc: its full picture and the frames' place."""

    stack: PhotometricStack
    sweep: Sweep
    folder: Path


def write_frames(folder: Path, frames: int, size: tuple[int, int], kind: str) -> Setup:
    """Frames of a slab that moves from left to right."""
    width, height = size
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    disc = (((x - width / 2) / (0.46 * width)) ** 2 + ((y - height / 2) / (0.46 * height)) ** 2) < 1
    step = width / frames
    total = np.zeros((height, width))
    for index in range(frames):
        away = np.abs(x[0] - (index + 0.5) * step)
        lit = np.clip(SLAB_PX / 2 + 0.5 - away, 0, 1)
        spread = np.exp(-np.maximum(away - SLAB_PX / 2, 0) / SPREAD_PX)
        frame = disc * (0.35 * lit + 0.12 * spread)[None]
        total += frame
        codes = np.rint(65535 * np.clip(frame + NOISE * rng.standard_normal(frame.shape), 0, 1)).astype(np.uint16)
        path = folder / f"{index:04d}.{kind}"
        if kind == "png":
            write_picture(path, torch.from_numpy(codes)[None])
        else:
            tifffile.imwrite(path, codes)
    gain = SLAB_PX / step
    pictures = torch.from_numpy(np.stack([total / gain] * 3)).float()[:, None]
    stack = PhotometricStack(
        names=("L1", "L2", "L3"),
        images=pictures,
        mask=torch.from_numpy(disc),
        saturated=torch.zeros_like(pictures, dtype=torch.bool),
        flags=torch.zeros(disc.shape, dtype=torch.int32),
        alpha=torch.eye(3),
        light_vectors=None,
        view=torch.tensor([0.0, 0.0, 1.0]),
    )
    return Setup(stack, Sweep(light="L1", frames=f"{{:04d}}.{kind}", count=frames), folder)


def resident_peak() -> float:
    """MiB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("/proc/self/status has no VmHWM")


def measure(setup: Setup, frames: int) -> None:
    """Print the table."""
    stack, options = setup.stack, ScatterOptions()
    width, height = stack.mask.shape[1], stack.mask.shape[0]
    streams = [
        FileFrames(sweep=replace(setup.sweep, light=name), folder=setup.folder, size=(width, height), channels=1)
        for name in stack.names
    ]
    began = time.process_time()
    for _ in streams[0]:
        pass
    decode = time.process_time() - began
    grid, chosen = torch.tensor(exponents(options), dtype=torch.float64), choose_samples(stack, 0)
    began = time.process_time()
    watch(streams[0], stack.images[0], stack.mask, exponents=grid, samples=chosen, progress=silent)
    first = time.process_time() - began
    ends: dict[str, float] = {}
    second = {"began": 0.0, "total": 0.0}

    def watcher(stage: str, done: int, total: int) -> None:
        if stage.endswith("scattering"):
            if done == 1:
                second["began"] = time.process_time()
            if done == total:
                second["total"] += time.process_time() - second["began"]
        ends[stage] = time.process_time()

    began = time.process_time()
    measure_scattering(stack, streams, options=options, progress=watcher)
    whole = time.process_time() - began
    passes = second["total"] / 3 * frames / max(frames - 1, 1)
    once = (whole - 3 * first - 3 * passes) / 3
    each = 1e3 / frames
    print(f"{frames} frames of {width}x{height}; processor time, ms a frame")
    print(f"  decoding alone     {decode * each:8.1f}   {1 / (decode / frames):6.1f} frames a second")
    print(f"  first pass         {first * each:8.1f}   {first / decode:6.2f} x decoding")
    print(f"  second pass        {passes * each:8.1f}   {passes / decode:6.2f} x decoding")
    print(f"  once a sweep       {once:8.1f} s")
    print(f"  all, against two passes of decoding: {whole / (6 * decode):.2f}   peak {resident_peak():.0f} MiB")


def main(arguments: list[str]) -> int:
    """Write frames, measure, clean up."""
    given = dict(argument.split("=", 1) for argument in arguments)
    unknown = given.keys() - {"frames", "size", "format", "folder"}
    if unknown or given.get("format", "png") not in ("png", "tif"):
        print("usage: sweep_speed.py [frames=300] [size=1920x1080] [format=png|tif] [folder=...]", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    frames = int(given.get("frames", "300"))
    width, height = map(int, given.get("size", "1920x1080").split("x"))
    with tempfile.TemporaryDirectory(dir=given.get("folder")) as folder:
        measure(write_frames(Path(folder), frames, (width, height), given.get("format", "png")), frames)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
