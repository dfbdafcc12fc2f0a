"""Compiled where it pays, plain torch where it does not or cannot be.

A compiled kernel is cached on disk by torch, so that only the first run on a machine waits for the C++ compiler.
"""

from __future__ import annotations

import functools
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

WORTH_COMPILING = 1 << 18
"""Pixels below which compilation costs more than it saves."""


@dataclass(frozen=True, kw_only=True)
class Speed:
    """How the kernels run."""

    compile: Literal["auto", "always", "never"] = "auto"
    """`auto`: from `WORTH_COMPILING` pixels on, where there is a C++ compiler."""


def accelerated(
    function: Callable[..., Any], form: tuple[Any, ...], pixels: int, speed: Speed, like: Tensor
) -> Callable[..., Any]:
    """`function` with its last arguments `form` bound, compiled if `speed` and the number of pixels say so."""
    wanted = speed.compile == "always" or (speed.compile == "auto" and pixels >= WORTH_COMPILING)
    if wanted and (like.is_cuda or has_compiler()):
        return compiled(function, form)
    return functools.partial(_bound, function, form)


def _bound(function: Callable[..., Any], form: tuple[Any, ...], *tensors: Tensor) -> Any:
    return function(*tensors, *form)


@functools.cache
def compiled(function: Callable[..., Any], form: tuple[Any, ...]) -> Callable[..., Any]:
    """One compiled kernel for every form."""

    def kernel(*tensors: Tensor) -> Any:
        return function(*tensors, *form)

    # Everything is to become one loop.
    options = {"max_fusion_size": 1 << 14}
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
