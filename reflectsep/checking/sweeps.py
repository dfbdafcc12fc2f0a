"""Findings on the sweeps: frames, speed, coverage, exposure, linearity."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from reflectsep.calibrate.exposure import exposure_ratio, missing_darks
from reflectsep.checking.findings import Finding, Verdict, graded
from reflectsep.data import Capture, FrameStream, PhotometricStack
from reflectsep.errors import SweepError
from reflectsep.progress import Progress
from reflectsep.scatter.gains import Gains, choose_samples, exponents, solve_gains
from reflectsep.scatter.options import ScatterOptions
from reflectsep.scatter.passage import Passage, speed_deviation, watch

SPEED = (0.01, 0.05)
COVERAGE = (0.99, 0.9)
EXPOSURE = (0.2, 0.6)
"""Of the logarithm of an exposure ratio, which the number of lit frames gives to a tenth or so."""
ODD_N_D = 0.05
"""From 1: light adds in radiance, so that another n_d is the camera's curve."""


def frames_there(capture: Capture) -> list[Finding]:
    """Missing sweeps, lost frames and missing dark pictures."""
    swept = {sweep.light for sweep in capture.sweeps}
    missing = [name for name in capture.basis if name not in swept]
    findings = []
    if missing:
        what = "no sweeps" if not swept else f"no sweep of {', '.join(missing)}"
        text = "without them the fit is the model of Lin & Lee" if not swept else "every basis light needs one"
        verdict: Verdict = "doubtful" if not swept else "bad"
        findings.append(Finding(subject="sweeps", value=what, verdict=verdict, advice=text))
    lost = {f"{s.light} {s.direction}": len(s.lost) for s in capture.sweeps if s.lost}
    if capture.sweeps:
        total = sum(sweep.count for sweep in capture.sweeps)
        share = sum(lost.values()) / total
        value = f"{sum(lost.values())} of {total} lost" if lost else f"{total}, none lost"
        advice = "sweep again: " + ", ".join(lost) if lost else ""
        findings.append(
            Finding(subject="frames", value=value, verdict=graded(share, (0.0, 0.1)), advice=advice, numbers=lost)
        )
    for text in missing_darks(capture):
        findings.append(
            Finding(
                subject="dark pictures",
                value=text,
                verdict="doubtful",
                advice="take one: what is not subtracted adds up over the frames of a sweep",
            )
        )
    return findings


def pass_over(
    stack: PhotometricStack, streams: Sequence[FrameStream], progress: Progress
) -> tuple[list[Passage], Gains | None, list[Finding]]:
    """First pass over every sweep, and Eq. 25."""
    swept = [(stream, stack.names.index(stream.sweep.light)) for stream in streams if stream.sweep.light in stack.names]
    options = ScatterOptions()
    grid = torch.tensor(exponents(options), dtype=torch.float64)
    chosen = choose_samples(stack, [k for _, k in swept])
    passages: list[Passage] = []
    try:
        for (stream, k), samples in zip(swept, chosen, strict=True):
            passages.append(
                watch(stream, stack.images[k], stack.mask, exponents=grid, samples=samples, progress=progress)
            )
    except SweepError as error:
        return [], None, [Finding(subject="sweeps", value=str(error), verdict="bad", advice="sweep again")]
    if not passages:
        return [], None, []
    return passages, solve_gains(stack, [k for _, k in swept], passages, chosen, options), []


def sweep_findings(
    capture: Capture, stack: PhotometricStack, passages: Sequence[Passage], gains: Gains | None
) -> list[Finding]:
    """Speed, coverage, exposure and clipping of every sweep, and n_d; none where there are no sweeps to judge."""
    if gains is None:
        return []
    findings = []
    for i, passage in enumerate(passages):
        sweep = passage.sweep
        full = stack.images[stack.names.index(sweep.light)]
        name = f"sweep of {sweep.light} along {sweep.direction}"
        speed = speed_deviation(passage, full, stack.mask)
        findings.append(
            Finding(
                subject=name,
                value=f"speed within {speed:.1%}, {passage.step_px(stack.mask):.2f} px a frame, lit for "
                f"{gains.lit_frames[i]:.2f} frames, C {gains.gains[i]:.3f}",
                verdict=graded(speed, SPEED),
                advice="" if speed <= SPEED[0] else "the slab did not move evenly: sweep by motor, or more slowly",
                numbers={"speed": speed, "gain": gains.gains[i], "lit_frames": gains.lit_frames[i]},
            )
        )
        lit = passage.narrow & (passage.peak > 0) & stack.mask
        reached = float(lit.sum() / stack.mask.sum())
        if reached < COVERAGE[0]:
            findings.append(
                Finding(
                    subject=f"{name}: coverage",
                    value=f"the slab was seen to pass {reached:.1%} of the object",
                    verdict="bad" if reached < 0.5 else "doubtful",
                    advice="cast shadows count as not passed; else begin earlier and end later",
                    numbers={"coverage": reached},
                )
            )
        findings += _clipped_frames(capture, passage, stack, gains, i, name)
    findings.append(_exponent(capture, gains))
    return findings


def _clipped_frames(
    capture: Capture, passage: Passage, stack: PhotometricStack, gains: Gains, i: int, name: str
) -> list[Finding]:
    clipped = float((passage.clipped & stack.mask).sum() / stack.mask.sum())
    findings = []
    if clipped > 0.01:
        solved = not any(name in text and "Eq. 25" in text for text in gains.warnings)
        known = passage.sweep.exposure_s is not None and capture.exposure_s is not None
        way_out = "give exposure_s of frames and pictures" if not known else "C rests on the exposures in the manifest"
        findings.append(
            Finding(
                subject=f"{name}: clipping",
                value=f"{clipped:.0%} of the object clipped while lit" + ("" if solved else ": Eq. 25 has no solution"),
                verdict="doubtful" if solved or known else "bad",
                advice=""
                if solved
                else f"{way_out}; or bracket, or expose frames shorter, or give the slab's "
                "width and step (scatter.lit_frames)",
                numbers={"clipped": clipped, "solved": solved},
            )
        )
    elif gains.lit_frames[i] > 0:
        ratio = gains.gains[i] / gains.lit_frames[i]
        stated = exposure_ratio(capture, passage.sweep.exposure_s)
        off = abs(math.log(max(ratio, 1e-12)))
        known = passage.sweep.exposure_s is not None
        what = "against the manifest's exposures" if known else "none is given"
        findings.append(
            Finding(
                subject=f"{name}: exposure",
                value=f"frames are {ratio / stated:.3g} times the pictures' exposure by Eq. 25 ({what})",
                verdict="good" if not known or off < EXPOSURE[0] else graded(off, EXPOSURE),
                advice="C absorbs it" if off >= EXPOSURE[0] else "",
                numbers={"ratio": ratio / stated},
            )
        )
    return findings


def _exponent(capture: Capture, gains: Gains) -> Finding:
    value = f"n_d {gains.n_d:.4f} +- {gains.n_d_sd:.2g} ({gains.source})"
    odd = gains.source == "estimated" and abs(gains.n_d - 1) > max(ODD_N_D, 4 * gains.n_d_sd)
    advice = ""
    if odd:
        advice = f"light adds in radiance: the pictures seem encoded with gamma {1 / gains.n_d:.2f}; say so in encoding"
        if capture.encoding.kind != "linear":
            advice = f"the {capture.encoding.kind} in encoding does not make these pictures linear"
    verdict: Verdict = "bad" if odd and abs(math.log(gains.n_d)) > 0.3 else ("doubtful" if odd else "good")
    return Finding(
        subject="linearity", value=value, verdict=verdict, advice=advice, numbers={"n_d": gains.n_d, "sd": gains.n_d_sd}
    )
