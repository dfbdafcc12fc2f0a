"""One stored picture to linear values: response undone, dark picture subtracted, exposure made equal."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

Response = Callable[[Tensor], Tensor]
"""Stored values to values linear in radiance, of any shape."""


def linear_response(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The values as they are."""
    return values


def gamma_response(gamma: float) -> Response:
    """sign(v) |v|^gamma, which undoes value = radiance^(1/gamma) and leaves noise round zero where it is."""
    return lambda values: torch.sign(values) * values.abs() ** gamma


def table_response(values: Float[Tensor, " rows"], radiances: Float[Tensor, " rows"]) -> Response:
    """Linear interpolation in a table, its end segments drawn on beyond it.

    Args:
        values: stored values, strictly increasing, two or more.
        radiances: what they stand for, strictly increasing.
    """

    def response(stored: Tensor) -> Tensor:
        table, meaning = values.to(stored), radiances.to(stored)
        left = (torch.searchsorted(table, stored.contiguous(), right=True) - 1).clamp(0, table.numel() - 2)
        slope = (meaning[left + 1] - meaning[left]) / (table[left + 1] - table[left])
        return meaning[left] + slope * (stored - table[left])

    return response


def develop(
    values: Float[Tensor, "channels height width"],
    response: Response,
    dark: Float[Tensor, "channels height width"] | None,
    ratio: float,
) -> Float[Tensor, "channels height width"]:
    """One stored picture in the capture's units, never clipped.

    Args:
        values: as stored.
        response: the inverse response.
        dark: picture without light of the same exposure, as stored; None where there is none.
        ratio: exposure of the first basis picture over the picture's own.

    Returns:
        Linear values; NaN where `values` or `dark` are not finite.
    """
    radiance = response(values)
    if dark is not None:
        radiance = radiance - response(dark)
    return radiance * ratio
