"""A camera's response curve: a table of stored value against radiance."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.errors import CaptureError


def read_response(path: Path | str) -> tuple[Float[Tensor, " rows"], Float[Tensor, " rows"]]:
    """Read a CSV of `value,radiance` rows; `#` comments and one heading line are skipped.

    Args:
        path: the file; values 0 to 1 (an integer code divided by the largest), radiance in any unit.

    Returns:
        Values and radiances, float64, both strictly increasing, at least two rows.

    Raises:
        CaptureError: missing, not a table of two columns of numbers, or not strictly increasing in both.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        raise CaptureError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: cannot be read as text: {error}") from error
    rows: list[tuple[float, float]] = []
    heading = True
    for number, line in enumerate(lines, start=1):
        text = line.split("#", 1)[0].strip()
        if not text:
            continue
        row = _numbers(text)
        if row is None and heading:
            heading = False
            continue
        heading = False
        if row is None:
            raise CaptureError(f"{path}: line {number}: found {text!r}, expected two numbers: value,radiance")
        if not 0 <= row[0] <= 1:
            raise CaptureError(
                f"{path}: line {number}: value {row[0]:g}, expected 0 to 1 (codes divided by the largest)"
            )
        if rows and not (row[0] > rows[-1][0] and row[1] > rows[-1][1]):
            raise CaptureError(
                f"{path}: line {number}: {text!r} does not rise above the row before it, in both columns"
            )
        rows.append(row)
    if len(rows) < 2:
        raise CaptureError(f"{path}: {len(rows)} rows, expected at least 2")
    table = torch.tensor(rows, dtype=torch.float64)
    return table[:, 0].clone(), table[:, 1].clone()


def _numbers(text: str) -> tuple[float, float] | None:
    """The two finite numbers of a row, or None."""
    cells = text.replace(";", ",").split(",")
    try:
        value, radiance = (float(cell) for cell in cells)
    except ValueError:
        return None
    return (value, radiance) if math.isfinite(value) and math.isfinite(radiance) else None
