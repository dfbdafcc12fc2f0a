"""What the stages of a fit take, by counts of pixels, lights, channels and frames.

The seconds are those of one core of a server of 2023, from fits of a simulated wax between 64 x 64 and 320 x 320
pixels, in grey and in colour, with and without sweeps. On other machines they are wrong by one factor, which
`estimate.TimeLeft` finds as the run goes; what counts here is how the stages stand to each other.
"""

from __future__ import annotations

from dataclasses import dataclass

from reflectsep.data import Capture
from reflectsep.estimate import Part
from reflectsep.fit.options import FitOptions
from reflectsep.fit.sample import SAMPLE

PIXEL_US = 50
"""Microseconds a pixel of a grey fit of few lights, all of its rounds; `_effort` says how it grows."""
GLOBALS_US = 1000
"""Of a pixel of the sample that the globals are fitted to."""


@dataclass(frozen=True, kw_only=True)
class Counts:
    """How large a capture is."""

    size: int
    """Pixels of a picture."""
    pixels: int
    """Pixels on the object."""
    lights: int
    channels: int


def _effort(counts: Counts) -> float:
    """Work a pixel: some of it goes by the pixel, some by its values."""
    return 1.0 + counts.lights * counts.channels / 24.0


def reading(capture: Capture, counts: Counts, *, aligned: bool, swept: bool) -> list[Part]:
    """Parts up to the fit: drift, pictures, sweeps."""
    values = 1e-6 * counts.size * counts.channels
    sweeps = [sweep for sweep in capture.sweeps if sweep.light in capture.names]
    parts = []
    if aligned:
        pairs = 0.2 + (counts.lights - 1) * (0.03 + 4e-6 * counts.pixels)
        parts = [Part(name="alignment", label="alignment", expected_s=pairs, steps="even")]
        parts += [
            Part(
                name=f"alignment {sweep.light} {sweep.direction}",
                label="alignment",
                expected_s=10e-6 * counts.pixels + 0.03 * values * sweep.count,
                steps="even",
            )
            for sweep in sweeps
        ]
    parts.append(
        Part(
            name="pictures",
            label="pictures",
            expected_s=0.2 + 0.2 * values * counts.lights,
            kind="reading",
            steps="even",
        )
    )
    for step in ("passage", "scattering") if swept else ():
        parts += [
            Part(
                name=f"sweep {sweep.light} {sweep.direction}: {step}",
                label=f"sweeps: {step}",
                expected_s=0.05 + 0.04 * values * sweep.count,
                kind="reading",
                steps="even",
            )
            for sweep in sweeps
        ]
    return parts


def solving(counts: Counts, options: FitOptions, *, swept: bool) -> list[Part]:
    """Parts of the fit itself."""
    effort = _effort(counts)
    parts = []
    if options.held is None:
        sampled = min(counts.pixels, SAMPLE)
        parts.append(
            Part(name="globals", label="globals", expected_s=1e-6 * GLOBALS_US * effort * sampled, steps="even")
        )
    seconds = 1e-6 * PIXEL_US * effort * counts.pixels * (1.0 if swept else 0.8)
    return [*parts, Part(name="pixels", label="pixels", expected_s=seconds, steps="even")]


def reporting(counts: Counts, sweeps: int) -> list[Part]:
    """The report: its figures."""
    figures = sweeps * (0.7 + 1e-6 * counts.size)
    seconds = 8.0 + figures + 2e-6 * counts.size * counts.lights * counts.channels
    return [Part(name="report", label="report", expected_s=seconds, kind="drawing", steps="uneven")]
