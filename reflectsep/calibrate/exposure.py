"""Stored values to linear ones on one scale: response undone, dark picture subtracted, exposures made equal.

    I = ratio * (f(value) - f(dark)),    ratio = exposure of the first basis picture / the picture's own

f is the inverse of the camera's response. Nothing is clipped: noise round zero stays round zero, or the sum of a
sweep's dark pixels would grow with the number of its frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from reflectsep.calibrate.bracket import NEARLY
from reflectsep.calibrate.bracketed_sweep import BracketedStream
from reflectsep.calibrate.develop import Response, gamma_response, linear_response, table_response
from reflectsep.calibrate.flat import flat_of
from reflectsep.data import Capture, Frame, FrameStream, Light, Sweep
from reflectsep.errors import CaptureError
from reflectsep.io.ahead import frames_of
from reflectsep.io.files import inside
from reflectsep.io.frames import open_sweep
from reflectsep.io.manifest import frame_file
from reflectsep.io.response import read_response
from reflectsep.io.stack import read_sweep_dark


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
        if encoding.table is not None:
            values, radiances = torch.tensor(encoding.table, dtype=torch.float64).unbind(1)
            return table_response(values, radiances)
        if encoding.response is None:
            raise CaptureError(f"{capture.folder}: encoding names no response table; expected a CSV in the folder")
        return table_response(*read_response(inside(capture.folder, encoding.response)))
    return linear_response


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
    flat: Float[Tensor, "channels height width"] | None = None
    """Uneven light over the field, divided out."""
    limit: float = math.inf
    """Stored values above it count as clipped in a frame that clips anywhere."""

    @property
    def sweep(self) -> Sweep:
        """What is streamed."""
        return self.stream.sweep

    def __len__(self) -> int:
        return len(self.stream)

    def __iter__(self) -> Iterator[Frame]:
        dark = None if self.dark is None else self.response(self.dark)
        with frames_of(self.stream) as frames:
            for frame in frames:
                name = f"{self.where}/{self._name(frame.index)}"
                values = self._developed(frame, name, dark)
                # One sum tells whether any value is no number; how many are is counted only then.
                if not bool(torch.isfinite(values.sum())):
                    bad = int((~torch.isfinite(values)).sum())
                    if bad:
                        raise CaptureError(f"{name}: {bad} values are not finite numbers; expected none")
                saturated = frame.saturated
                if saturated is not None and math.isfinite(self.limit) and bool(saturated.any()):
                    saturated = saturated | (frame.values > self.limit)
                yield replace(frame, values=values, saturated=saturated)

    def _developed(self, frame: Frame, name: str, dark: Tensor | None) -> Tensor:
        """As `develop` does it, the dark picture's response undone once for all frames."""
        shape = tuple(frame.values.shape)
        if self.dark is not None and self.dark.shape != frame.values.shape:
            raise CaptureError(f"{name}: {shape} (channels, height, width), its dark picture {tuple(self.dark.shape)}")
        values = self.response(frame.values)
        if dark is not None:
            values = values - dark.to(values)
        if self.ratio != 1.0:
            values = values * self.ratio
        colour = colour_of(self.light, shape[0])
        values = values if colour is None else values / colour.to(values)
        if self.flat is not None:
            if self.flat.shape != values.shape:
                raise CaptureError(f"{name}: {shape} (channels, height, width), its flat {tuple(self.flat.shape)}")
            values = values / self.flat.to(values)
        return values

    def _name(self, index: int) -> str:
        return frame_file(self.sweep, index) if self.sweep.video is None else f"{self.sweep.video}, frame {index}"


def developed_stream(capture: Capture, stream: FrameStream, response: Response | None = None) -> FrameStream:
    """`stream` in the capture's units: with the sweep's own dark picture, exposure and light colour.

    Lazy and as re-iterable as `stream`: one frame is in memory at a time, of a sweep at several exposures one of each.

    Args:
        capture: whose sweep it is.
        stream: of stored frames; the other exposures of a bracket are opened here.
        response: the capture's, where it was read before.

    Raises:
        CaptureError: an unreadable dark picture or response table; while iterating, a frame with values that are not
            finite.
    """
    response = response or response_of(capture)
    if stream.sweep.bracket:
        each = [stream, *(open_sweep(capture, sweep) for sweep in stream.sweep.bracket)]
        developed = tuple(replace(_developed(capture, one, response), limit=NEARLY) for one in each)
        return BracketedStream(streams=developed, where=str(capture.folder))
    return _developed(capture, stream, response)


def _developed(capture: Capture, stream: FrameStream, response: Response) -> DevelopedStream:
    """One exposure."""
    return DevelopedStream(
        stream=stream,
        response=response,
        flat=flat_of(capture, stream.sweep.light, response),
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
        for sweep in (one for sweep in capture.sweeps for one in sweep.exposures)
        if read_sweep_dark(capture, sweep) is None
    )
