"""The hand-written C++ solver, compiled here, behind a plain function."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.fit.problem import globals_of, log_size

from .problem import END, Case

SOURCE = Path(__file__).with_name("yardstick.cpp")
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-std=c++17", "-Wno-psabi")
WIDTH = 8
"""Pixels in a vector."""


class NotInstalled(Exception):  # noqa: N818  (no error: whoever measures says so)
    """What is missing, and how to install it."""


@functools.cache
def library(lights: int, channels: int) -> ctypes.CDLL:
    """The shared library, compiled if its text or flags are new."""
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None:
        raise NotInstalled("no C++ compiler: apt-get install g++")
    sizes = [f"-DLIGHTS={lights}", f"-DCHANNELS={channels}", f"-DWIDTH={WIDTH}"]
    key = hashlib.sha256(repr((SOURCE.read_text(), sizes, FLAGS, compiler)).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"reflectsep-benchmark-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    target = folder / f"yardstick-{key}.so"
    if not target.exists():
        unfinished = target.with_suffix(f".{os.getpid()}")
        command = [compiler, *FLAGS, *sizes, "-shared", "-fPIC", str(SOURCE), "-o", str(unfinished)]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        if run.returncode:
            raise NotInstalled(f"{SOURCE.name} does not compile: {(run.stderr.splitlines() or ['?'])[0]}")
        unfinished.replace(target)
    return ctypes.CDLL(str(target))


def constants(case: Case) -> Float[Tensor, "values"]:
    """The C++ struct `Shared`."""
    p, g = case.problem, globals_of(case.shared, case.problem.obs)
    if not g.ggx or p.huber is None:
        raise ValueError("the yardstick has the lobe of GGX microfacets and Huber's loss alone")
    size = log_size(case.shared, p.obs)
    near = 0.0 if p.neighbours is None else 0.5 / float(size.exp())
    single = [g.n_s, g.f, g.softness, g.fresnel, g.n_d, size, p.height_spread, p.huber, near]
    parts = [p.obs.alpha, p.weight, g.M, g.a, torch.tensor([float(value) for value in single])]
    return torch.cat([part.double().flatten() for part in parts])


def values(case: Case) -> Float[Tensor, "values pixels"]:
    """What the C++ struct `Pixel` holds, a row each."""
    p, obs = case.problem, case.problem.obs
    around = obs.images.new_zeros(9, len(p))
    if p.neighbours is not None:
        around = torch.cat([p.neighbours.R, p.neighbours.vector])
    return torch.cat([part.double().flatten(0, -2) for part in (obs.images, obs.s, obs.clipped, around)]).contiguous()


def solve(case: Case) -> tuple[Float[Tensor, "P pixels"], Float[Tensor, "pixels"]]:
    """Where every pixel ends, and its cost."""
    lights, channels, pixels = case.problem.obs.images.shape
    local, cost = case.start.double().contiguous().clone(), torch.empty(pixels, dtype=torch.float64)
    rows, shared = values(case), constants(case)
    at = [ctypes.c_void_p(tensor.data_ptr()) for tensor in (rows, shared, local, cost)]
    end = (ctypes.c_double(END.tolerance), ctypes.c_int64(END.max_iterations))
    library(lights, channels).solve_pixels(ctypes.c_int64(pixels), at[0], at[1], *end, at[2], at[3])
    return local, cost
