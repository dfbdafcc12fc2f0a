"""Compiled where it pays, plain torch where it does not or cannot be.

A compiled kernel is cached on disk by torch, so that only the first run on a machine waits for the C++ compiler.
"""

from __future__ import annotations

import functools
import itertools
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor

Part = TypeVar("Part")

LEAST_PART = 1 << 14
WORTH_COMPILING = 1 << 18
"""Pixels below which compilation costs more than it saves."""


@dataclass(frozen=True, kw_only=True)
class Speed:
    """How the kernels run."""

    compile: Literal["auto", "always", "never"] = "auto"
    """`auto`: from `WORTH_COMPILING` pixels on, where there is a C++ compiler."""
    cores: int | None = None
    """Parts that are worked on side by side; None: as many as torch has threads."""

    def compiles(self, pixels: int, like: Tensor) -> bool:
        """Whether so many pixels are worth a compiled kernel, and there is a compiler."""
        wanted = self.compile == "always" or (self.compile == "auto" and pixels >= WORTH_COMPILING)
        return wanted and (like.is_cuda or has_compiler())

    def block(self, pixels: int, most: int, like: Tensor) -> int:
        """Slots of a block: always `most` for a compiled kernel, which is made for one size, else no more than needed.

        Whole numbers of vectors, so that no pixel is ever a remainder that is computed otherwise.
        """
        return -(-(most if self.compiles(pixels, like) else min(most, pixels)) // 64) * 64

    def parts(self, pixels: int) -> list[slice]:
        """The pixels shared out to the cores; a part has `LEAST_PART` pixels at least."""
        cores = torch.get_num_threads() if self.cores is None else self.cores
        number = max(1, min(cores, pixels // LEAST_PART))
        ends = [pixels * i // number for i in range(number + 1)]
        return [slice(a, b) for a, b in itertools.pairwise(ends)]


def side_by_side(work: Callable[[slice], Part], parts: Sequence[slice]) -> list[Part]:
    """`work` on every part, each on a core of its own; results in the order of the parts."""
    if len(parts) == 1:
        return [work(parts[0])]
    threads = torch.get_num_threads()
    # Torch's own threads would fight over the cores that the parts are on.
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(len(parts)) as pool:
            return list(pool.map(work, parts))
    finally:
        torch.set_num_threads(threads)


def accelerated(
    function: Callable[..., Any], form: tuple[Any, ...], pixels: int, speed: Speed, like: Tensor
) -> Callable[..., Any]:
    """`function` with its last arguments `form` bound, compiled if `speed` and the number of pixels say so."""
    if speed.compiles(pixels, like):
        return compiled(function, form)
    return functools.partial(_bound, function, form)


def _bound(function: Callable[..., Any], form: tuple[Any, ...], *tensors: Tensor) -> Any:
    return function(*tensors, *form)


@functools.cache
def compiled(function: Callable[..., Any], form: tuple[Any, ...]) -> Callable[..., Any]:
    """One compiled kernel for every form."""

    def kernel(*tensors: Tensor) -> Any:
        return function(*tensors, *form)

    # Everything is to become one loop; a block is one core's work, other cores take other pixels, for which the call
    # must let go of Python's lock: only the C++ wrapper does.
    options: dict[str, Any] = {"max_fusion_size": 1 << 14, "cpp.threads": 1, "cpp_wrapper": True}
    return torch.compile(kernel, dynamic=False, fullgraph=True, options=options)


@functools.cache
def has_compiler() -> bool:
    """Whether a C++ compiler is at hand; says once that without one everything runs, slower."""
    found = shutil.which(os.environ.get("CXX", "g++")) or shutil.which("clang++")
    if found is None:
        print(
            "reflectsep: no C++ compiler (g++ or $CXX): kernels run uncompiled, several times slower", file=sys.stderr
        )
    return found is not None
