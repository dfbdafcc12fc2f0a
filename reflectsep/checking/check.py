"""The check job: what a capture will bear, before anyone spends time on a fit; findings with numbers and verdicts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from reflectsep.calibrate.align_options import AlignOptions
from reflectsep.calibrate.alignment import Alignment, align
from reflectsep.calibrate.alpha import AlphaReport
from reflectsep.calibrate.exposure import developed_stream, response_of
from reflectsep.calibrate.stack import calibrate_stack, develop_pictures
from reflectsep.checking.findings import CheckResult, Finding
from reflectsep.checking.pictures import light_findings, picture_count, picture_findings
from reflectsep.checking.split import expected_split
from reflectsep.checking.sweeps import ODD_N_D, frames_there, pass_over, sweep_findings
from reflectsep.data import Capture, FrameStream, PhotometricStack
from reflectsep.io.frames import open_sweep
from reflectsep.io.stack import RawPictures, read_full, read_mask
from reflectsep.progress import Progress, silent
from reflectsep.scatter.gains import Gains
from reflectsep.scatter.passage import Passage


def check_capture(capture: Capture, progress: Progress = silent) -> CheckResult:
    """Look at every picture and frame of a capture.

    Raises:
        ReflectsepError: a file that cannot be read, or too little to make anything of.
    """
    response = response_of(capture)
    raw = read_full(capture)
    mask = read_mask(capture)
    pictures, saturated = develop_pictures(capture, raw, response)
    streams: list[FrameStream] = [
        developed_stream(capture, open_sweep(capture, sweep), response) for sweep in capture.sweeps
    ]
    seen = _seen(capture, raw, (pictures, saturated, mask), streams, 1.0, progress)
    if seen.gains is not None and seen.gains.source == "estimated" and abs(seen.gains.n_d - 1) > ODD_N_D:
        # Of pictures that are not linear the sum of roots is the full picture, not the sum of frames.
        seen = _seen(capture, raw, (pictures, saturated, mask), streams, seen.gains.n_d, progress)
    stack, alignment = seen.stack, seen.alignment
    findings = [picture_count(capture), *picture_findings(capture, raw, stack), *light_findings(seen.lights, stack)]
    findings += frames_there(capture)
    findings += seen.trouble + sweep_findings(capture, stack, seen.passages, seen.gains)
    findings += [
        Finding(
            subject="clipped scattering" if "cut off" in text else "registration",
            value=text,
            verdict="bad" if "cut off" in text else "doubtful",
        )
        for text in alignment.warnings
    ]
    findings += [_alignment(capture, alignment), expected_split(stack)]
    return CheckResult(
        capture=capture,
        findings=tuple(findings),
        stack=stack,
        pictures=pictures,
        saturated=saturated,
        mask=mask,
        alignment=alignment,
        passages=tuple(seen.passages),
    )


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """A capture, aligned and passed over once."""

    alignment: Alignment
    stack: PhotometricStack
    lights: AlphaReport
    passages: list[Passage]
    gains: Gains | None
    trouble: list[Finding]


def _seen(
    capture: Capture,
    raw: RawPictures,
    developed: tuple[Tensor, Tensor, Tensor],
    streams: Sequence[FrameStream],
    n_d: float,
    progress: Progress,
) -> _Seen:
    pictures, saturated, mask = developed
    alignment = align(
        capture, raw.names, pictures, saturated, mask, streams, options=AlignOptions(n_d=n_d), progress=progress
    )
    stack, lights = calibrate_stack(capture, minimum=3, alignment=alignment, condition_limit=math.inf)
    still = [alignment.placed(i, stream) for i, stream in enumerate(streams)]
    passages, gains, trouble = pass_over(stack, still, progress)
    return _Seen(alignment=alignment, stack=stack, lights=lights, passages=passages, gains=gains, trouble=trouble)


def _alignment(capture: Capture, alignment: Alignment) -> Finding:
    moved = {name: m.displacement_px for name, m in alignment.pictures.items() if m.applied}
    moved |= {
        f"sweep {sweep.light} {sweep.direction}": m.displacement_px
        for sweep, m in zip(capture.sweeps, alignment.against_full, strict=True)
        if m.applied
    }
    if not moved:
        return Finding(subject="alignment", value="nothing moved beyond chance", verdict="good", numbers={})
    worst = max(moved, key=lambda name: moved[name])
    return Finding(
        subject="alignment",
        value=f"{len(moved)} moved, by {moved[worst]:.2f} px at most ({worst})",
        verdict="doubtful" if moved[worst] < 20 else "bad",
        advice="a fit undoes it; fix the camera, and set exposures without touching it",
        numbers=moved,
    )
