"""Stored values to linear ones on one scale: response undone, dark picture subtracted, exposures made equal.

    I = ratio * (f(value) - f(dark)),    ratio = exposure of the first basis picture / the picture's own

f is the inverse of the camera's response. Nothing is clipped: noise round zero stays round zero, or the sum of a
sweep's dark pixels would grow with the number of its frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.data import Capture, Frame, FrameStream, Light, Sweep
from reflectsep.errors import CaptureError
from reflectsep.io.files import inside
from reflectsep.io.manifest import frame_file
from reflectsep.io.response import read_response
from reflectsep.io.stack import read_sweep_dark

Response = Callable[[Tensor], Tensor]
"""Stored values to values linear in radiance, of any shape."""


def response_of(capture: Capture) -> Response:
    """The inverse response that the capture's `encoding` names.

    Raises:
        CaptureError: a response table that is missing, leaves the folder or is not a rising table.
    """
    encoding = capture.encoding
    if encoding.kind == "gamma":
        if encoding.gamma is None or not encoding.gamma > 0:
            raise CaptureError(f"{capture.folder}: encoding gamma is {encoding.gamma}; expected a positive number")
        return gamma_response(encoding.gamma)
    if encoding.kind == "response":
        if encoding.response is None:
            raise CaptureError(f"{capture.folder}: encoding names no response table; expected a CSV in the folder")
        return table_response(*read_response(inside(capture.folder, encoding.response)))
    return linear_response


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


def exposure_ratio(capture: Capture, exposure_s: float | None) -> float:
    """Exposure of the first basis picture over `exposure_s`; 1 where either is unknown."""
    unit_s = capture.exposure_s
    return 1.0 if unit_s is None or exposure_s is None else unit_s / exposure_s


def colour_of(light: Light, channels: int) -> Float[Tensor, "channels 1 1"] | None:
    """Intensity of a coloured light, one a channel, by which its pictures are divided; None for one of one value.

    Raises:
        CaptureError: neither one value nor one a channel, or a channel that gets no light.
    """
    if len(light.intensity) == 1:
        return None
    if len(light.intensity) != channels or not all(value > 0 for value in light.intensity):
        raise CaptureError(
            f"light {light.name}: intensity {list(light.intensity)} for pictures of {channels} channels; "
            "expected one positive value, or one a channel"
        )
    return torch.tensor(light.intensity, dtype=torch.float32)[:, None, None]


@dataclass(frozen=True, kw_only=True)
class DevelopedStream:
    """A stream of stored frames, developed one at a time as it is read."""

    stream: FrameStream
    response: Response
    dark: Float[Tensor, "channels height width"] | None
    """As stored, of the frames' exposure."""
    ratio: float
    light: Light
    """Of the sweep; its colour is divided out."""
    where: str
    """Names the capture in errors."""

    @property
    def sweep(self) -> Sweep:
        """What is streamed."""
        return self.stream.sweep

    def __len__(self) -> int:
        return len(self.stream)

    def __iter__(self) -> Iterator[Frame]:
        for frame in self.stream:
            name = f"{self.where}/{self._name(frame.index)}"
            shape = tuple(frame.values.shape)
            if self.dark is not None and self.dark.shape != frame.values.shape:
                raise CaptureError(
                    f"{name}: {shape} (channels, height, width), its dark picture {tuple(self.dark.shape)}"
                )
            values = develop(frame.values, self.response, self.dark, self.ratio)
            colour = colour_of(self.light, shape[0])
            values = values if colour is None else values / colour.to(values)
            bad = int((~torch.isfinite(values)).sum())
            if bad:
                raise CaptureError(f"{name}: {bad} values are not finite numbers; expected none")
            yield replace(frame, values=values)

    def _name(self, index: int) -> str:
        return frame_file(self.sweep, index) if self.sweep.video is None else f"{self.sweep.video}, frame {index}"


def developed_stream(capture: Capture, stream: FrameStream, response: Response | None = None) -> FrameStream:
    """`stream` in the capture's units: with the sweep's own dark picture, exposure and light colour.

    Lazy and as re-iterable as `stream`: one frame is in memory at a time.

    Args:
        capture: whose sweep it is.
        stream: of stored frames.
        response: the capture's, where it was read before.

    Raises:
        CaptureError: an unreadable dark picture or response table; while iterating, a frame with values that are not
            finite.
    """
    return DevelopedStream(
        stream=stream,
        response=response or response_of(capture),
        dark=read_sweep_dark(capture, stream.sweep),
        ratio=exposure_ratio(capture, stream.sweep.exposure_s),
        light=capture.lights[stream.sweep.light],
        where=str(capture.folder),
    )


def missing_darks(capture: Capture) -> tuple[str, ...]:
    """One line for every sweep that has no dark picture of its exposure although the capture has dark pictures.

    Ambient light and the sensor's offset add up over a sweep's frames, so this is worth a warning.

    Raises:
        CaptureError: a dark picture that cannot be read.
    """
    if not any(picture.kind == "dark" for picture in capture.images):
        return ()
    return tuple(
        f"sweep of {sweep.light} along {sweep.direction}: no dark picture of its exposure"
        + (f" ({sweep.exposure_s:g} s)" if sweep.exposure_s is not None else "")
        for sweep in capture.sweeps
        if read_sweep_dark(capture, sweep) is None
    )
