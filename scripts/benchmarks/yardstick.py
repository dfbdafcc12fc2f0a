"""The hand-written C++ kernel, compiled here, behind plain functions."""

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
from torch import Tensor

from reflectsep.kernel.problem import Lobe, PixelProblem
from reflectsep.kernel.search import Scan
from reflectsep.solve.joint import ReducedSystem, shared_step

from .problem import FLOOR, ITERATIONS, TOLERANCE, Case

FOLDER = Path(__file__).parent
FAST = ("-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512")


class NotInstalled(Exception):  # noqa: N818  (no error: the table says so)
    """What is missing, and how to install it."""


@functools.cache
def library(source: str, lights: int, flags: tuple[str, ...], links: tuple[str, ...] = ()) -> ctypes.CDLL:
    """The shared library of one source, compiled if its text or flags are new."""
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None:
        raise NotInstalled("no C++ compiler: apt-get install g++")
    text = (FOLDER / source).read_text()
    key = hashlib.sha256(repr((text, lights, flags, compiler)).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"reflectsep-benchmark-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    target = folder / f"{Path(source).stem}-{key}.so"
    if not target.exists():
        unfinished = target.with_suffix(f".{os.getpid()}")
        command = [compiler, *flags, f"-DLIGHTS={lights}", "-shared", "-fPIC", str(FOLDER / source), "-o"]
        run = subprocess.run([*command, str(unfinished), *links], capture_output=True, text=True, check=False)
        if run.returncode:
            raise NotInstalled(f"{source} does not compile: {(run.stderr.splitlines() or ['?'])[0]}")
        unfinished.replace(target)
    return ctypes.CDLL(str(target))


def pointer(values: Tensor) -> ctypes.c_void_p:
    """Of a contiguous tensor."""
    if not values.is_contiguous():
        raise ValueError(f"a tensor of shape {tuple(values.shape)} is not contiguous")
    return ctypes.c_void_p(values.data_ptr())


def constants(p: PixelProblem, lobe: Lobe) -> Tensor:
    """The C++ struct `Shared`."""
    alpha = p.alpha.double()
    parts = [alpha.flatten(), alpha @ lobe.a.double(), p.light_weight.double(), torch.tensor([lobe.n_s]), lobe.a]
    return torch.cat([part.double() for part in parts])


def _kernel(case: Case) -> ctypes.CDLL:
    return library("yardstick.cpp", len(case.problem.images), FAST)


def local_fit(case: Case) -> Tensor:
    """LM from the case's start; (4, pixels)."""
    p, local = case.problem, case.start.clone()
    cost, c = torch.empty(len(p)), constants(p, case.lobe).float()
    _kernel(case).local_fit(
        *(ctypes.c_int64(len(p)), pointer(p.images), pointer(p.s), pointer(c)),
        *(ctypes.c_float(TOLERANCE), ctypes.c_float(FLOOR), ITERATIONS, pointer(local), pointer(cost)),
    )
    return local


def whole_fit(case: Case) -> Tensor:
    """Search over B and polish; (4, pixels)."""
    p, offsets = case.problem, torch.tensor(Scan().offsets)
    local, cost, c = torch.empty_like(case.start), torch.empty(len(p)), constants(p, case.lobe).float()
    _kernel(case).whole_fit(
        *(ctypes.c_int64(len(p)), pointer(p.images), pointer(p.s), pointer(c), pointer(offsets), len(offsets)),
        *(ctypes.c_float(TOLERANCE), ctypes.c_float(FLOOR), ITERATIONS, pointer(local), pointer(cost)),
    )
    return local


def joint_fit(case: Case, local: Tensor, lobe: Lobe, tolerance: float, limit: int) -> tuple[Tensor, Lobe, int]:
    """Pixels and globals by the Schur complement: the loop of `kernel.joint` about the C++ pass."""
    p, here, spare = case.problem, local.clone(), torch.empty_like(local)

    def run(old: Lobe, new: Lobe) -> tuple[float, ReducedSystem]:
        sums, step = torch.empty(15, dtype=torch.float64), (new.shared - old.shared).float()
        before, after = constants(p, old).float(), constants(p, new).float()
        _kernel(case).joint_pass(
            *(ctypes.c_int64(len(p)), pointer(p.images), pointer(p.s), pointer(before), pointer(after), pointer(step)),
            *(ctypes.c_float(TOLERANCE), ctypes.c_float(FLOOR), pointer(here), pointer(spare), pointer(sums)),
        )
        S = torch.zeros(4, 4, dtype=torch.float64)
        S[tuple(torch.triu_indices(4, 4))] = sums[1:11]
        return float(sums[0]), ReducedSystem(S + S.triu(1).T, sums[11:])

    cost, system = run(lobe, lobe)
    here, spare, mu, quiet, passes = spare, here, 1e-4, 0, 1
    for _ in range(limit):
        while mu < 1e8:
            moved = lobe.moved(lobe.shared + shared_step(system, mu, None).to(lobe.a))
            trial, found = run(lobe, moved)
            passes += 1
            if trial < cost:
                break
            mu *= 8.0
        else:
            break
        quiet = quiet + 1 if cost - trial <= tolerance * cost else 0
        here, spare, lobe, cost, system, mu = spare, here, moved, trial, found, max(mu * 0.2, 1e-9)
        if quiet >= 2:
            break
    return here, lobe, passes
