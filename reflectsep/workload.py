"""What the stages of a fit take, by counts of pixels, lights, channels and frames.

The seconds are those of one core of a server of 2023, from fits between 64 x 64 and 512 x 512 pixels, in grey and in
colour, with and without sweeps. On other machines they are wrong by one factor, which `estimate.TimeLeft` finds as the
run goes; what counts here is how the stages stand to each other.
"""

from __future__ import annotations

from dataclasses import dataclass

from reflectsep.data import Capture
from reflectsep.estimate import Part
from reflectsep.fit.options import FitOptions

SOLVING_US = {
    "pixels": (195,),
    "joint fit": (135,),
    "shadow edges": (110,),
    "neighbourhood": (70, 95),
    "smooth lobes": (55, 48, 42, 42, 42, 42),
}
"""Microseconds a pixel of a grey fit of few lights; `_effort` says how it grows with what a pixel has."""
GLOBALS_S = (3.0, 2.6)
"""Of 300 pixels of a grey fit of few lights; it grows with the power 1.7 of `_effort`."""


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
        pairs = 0.2 + (counts.lights - 1) * (1.0 + 37e-6 * counts.pixels)
        parts = [Part(name="alignment", label="alignment", expected_s=pairs, steps="even")]
        parts += [
            Part(
                name=f"alignment {sweep.light} {sweep.direction}",
                label="alignment",
                expected_s=37e-6 * counts.pixels + 0.1 * values * sweep.count,
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
                expected_s=0.1 + 0.05 * values * sweep.count,
                kind="reading",
                steps="even",
            )
            for sweep in sweeps
        ]
    return parts


def solving(counts: Counts, options: FitOptions, *, swept: bool) -> list[Part]:
    """Parts of the fit itself."""
    effort = _effort(counts)
    globals_s = [s * effort**1.7 * options.globals_pixels / 300 for s in GLOBALS_S]
    if options.held is not None:
        globals_s = []
    elif options.prior != "auto":
        globals_s = globals_s[:1]
    parts = [Part(name="globals", label="globals", expected_s=s, steps="even") for s in globals_s]
    wanted = ["pixels"]
    if options.method == "joint":
        wanted.append("joint fit")
        if options.lobe != "single" and swept and options.held is None:
            wanted.append("shadow edges")
        if swept:
            wanted.append("neighbourhood")
        if options.prior == "auto":
            wanted.append("smooth lobes")
    for name in wanted:
        parts += [Part(name=name, label=name, expected_s=1e-6 * us * effort * counts.pixels) for us in SOLVING_US[name]]
    return parts


def reporting(counts: Counts, sweeps: int) -> list[Part]:
    """The report: its figures."""
    figures = sweeps * (0.7 + 1e-6 * counts.size)
    seconds = 8.0 + figures + 2e-6 * counts.size * counts.lights * counts.channels
    return [Part(name="report", label="report", expected_s=seconds, kind="drawing", steps="uneven")]
