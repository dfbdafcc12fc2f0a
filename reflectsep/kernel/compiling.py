"""Compiled where it pays, plain torch where it does not or cannot be.

A compiled kernel is cached on disk by torch, so that only the first run on a machine waits for the C++ compiler.
"""

from __future__ import annotations

import functools
import itertools
import os
import shutil
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor

Part = TypeVar("Part")

LEAST_PART = 1 << 14
"""Pixels: one block of a compiled kernel."""
WORTH_COMPILING = 1 << 18
"""Pixels below which compilation costs more than it saves."""
_ONE_AT_A_TIME = threading.Lock()


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

    @property
    def workers(self) -> int:
        """Cores that there are."""
        return torch.get_num_threads() if self.cores is None else self.cores

    def parts(self, pixels: int, most: int | None = None) -> list[slice]:
        """The pixels shared out to the cores, `LEAST_PART` at least and whole ones but for the last.

        As many parts for every core; where `most` is given, so many that all cores together are at `most` pixels.
        """
        at_work = max(1, min(self.workers, pixels // LEAST_PART))
        number = at_work * max(1, -(-pixels // most)) if most is not None else at_work
        # Every begun block costs as much as a full one.
        ends = [min(pixels, LEAST_PART * round(pixels * i / number / LEAST_PART)) for i in range(number)]
        return [slice(a, b) for a, b in itertools.pairwise([*ends, pixels]) if a < b]

    def of_a_part(self, pixels: int, like: Tensor) -> Speed:
        """How one of the parts of so many pixels runs: on one core, compiled if the whole is worth it."""
        return replace(self, compile="always" if self.compiles(pixels, like) else "never", cores=1)


def side_by_side(work: Callable[[slice], Part], parts: Sequence[slice], workers: int | None = None) -> list[Part]:
    """`work` on every part, `workers` (all) of them at a time, each on one core; results in the order of the parts."""
    threads = torch.get_num_threads()
    # Torch's own threads would fight over the cores that the parts are on; and a kernel is compiled for their number.
    torch.set_num_threads(1)
    try:
        if len(parts) == 1:
            return [work(parts[0])]
        with ThreadPoolExecutor(min(len(parts), workers or len(parts))) as pool:
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


def compiled(function: Callable[..., Any], form: tuple[Any, ...]) -> Callable[..., Any]:
    """One compiled kernel for every form, whichever core asks first."""
    with _ONE_AT_A_TIME:
        return _compiled(function, form)


@functools.cache
def _compiled(function: Callable[..., Any], form: tuple[Any, ...]) -> Callable[..., Any]:
    def kernel(*tensors: Tensor) -> Any:
        return function(*tensors, *form)

    # A code object of its own: torch counts the compilations of each, and gives up after eight.
    kernel.__code__ = kernel.__code__.replace(co_name=function.__name__)
    # Everything is to become one loop; a block is one core's work, other cores take other pixels, for which the call
    # must let go of Python's lock: only the C++ wrapper does.
    options: dict[str, Any] = {
        "max_fusion_size": 1 << 14,
        "cpp.threads": 1,
        "cpp_wrapper": True,
        "guard_filter_fn": _of_the_call,
    }
    return torch.compile(kernel, dynamic=False, fullgraph=True, options=options)


def _of_the_call(guards: Sequence[Any]) -> list[bool]:
    """Of torch's guards those about what a call is given: that code and constants are still the same need not be asked.

    There are a hundred of them, which take a twentieth of a kernel's time.
    """
    return [guard.guard_type in ("TENSOR_MATCH", "DUPLICATE_INPUT", "GRAD_MODE") for guard in guards]


@functools.cache
def has_compiler() -> bool:
    """Whether kernels can be compiled here, by a trial; where not, says once why, and that everything runs, slower."""
    found = shutil.which(os.environ.get("CXX", "g++")) or shutil.which("clang++")
    reason = "no C++ compiler (g++ or $CXX)" if found is None else _trouble()
    if reason is not None:
        print(f"reflectsep: {reason}: kernels run uncompiled, several times slower", file=sys.stderr)
    return reason is None


def _trouble() -> str | None:
    """What keeps torch from compiling: a compiler without Python's or OpenMP's headers, a cache that is read-only."""
    try:
        compiled(_twice, ())(torch.ones(64))
    except (RuntimeError, OSError, ImportError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        told = next((line for line in lines if "error:" in line), lines[0] if lines else "no reason given")
        return f"nothing can be compiled ({told})"
    return None


def _twice(values: Tensor) -> Tensor:
    return 2.0 * values
