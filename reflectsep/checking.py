"""The check job: what a capture will bear, before anyone spends time on a fit; findings with numbers and verdicts."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.calibrate.alignment import Alignment, AlignOptions, align, aligned_stream
from reflectsep.calibrate.alpha import AlphaReport
from reflectsep.calibrate.exposure import developed_stream, exposure_ratio, missing_darks, response_of
from reflectsep.calibrate.stack import calibrate_stack, develop_pictures
from reflectsep.data import Capture, FrameStream, PhotometricStack
from reflectsep.errors import SweepError
from reflectsep.io.frames import open_sweep
from reflectsep.io.stack import RawPictures, read_full, read_mask
from reflectsep.model import Globals, reflectance
from reflectsep.progress import Progress, silent
from reflectsep.report.sheet import write_sheet
from reflectsep.scatter.gains import Gains, choose_samples, exponents, fine_noise, solve_gains
from reflectsep.scatter.options import ScatterOptions
from reflectsep.scatter.passage import Passage, speed_deviation, watch

Verdict = Literal["good", "doubtful", "bad"]
SATURATED = (0.005, 0.05)
"""Shares of the object from which clipping is doubtful, and bad."""
SPEED = (0.01, 0.05)
COVERAGE = (0.99, 0.9)
CONDITION = (6.0, 50.0)
NOISE = (0.01, 0.05)
SPLIT = (0.15, 0.5)
AGREEMENT_DEG = (2.0, 8.0)
EXPOSURE = (0.2, 0.6)
"""Of the logarithm of an exposure ratio, which the number of lit frames gives to a tenth or so."""
ODD_N_D = 0.05
"""From 1: light adds in radiance, so that another n_d is the camera's curve."""
NOMINAL_A = -0.91
NOMINAL_N_S = 10.0
"""A typical lobe (paper's wax and the simulated objects), for what a fit may expect of these lights and this noise."""
SPLIT_PIXELS = 2000


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One line of the check."""

    subject: str
    value: str
    verdict: Verdict
    advice: str = ""
    numbers: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """Everything that the check found, and what its pictures are drawn from."""

    capture: Capture
    findings: tuple[Finding, ...]
    stack: PhotometricStack
    pictures: Float[Tensor, "lights channels height width"]
    """As they are on disk, developed."""
    saturated: Bool[Tensor, "lights channels height width"]
    mask: Bool[Tensor, "height width"]
    alignment: Alignment
    passages: tuple[Passage, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst of all."""
        verdicts = {finding.verdict for finding in self.findings}
        return "bad" if "bad" in verdicts else ("doubtful" if "doubtful" in verdicts else "good")

    def document(self) -> dict[str, Any]:
        """For scripts."""
        return {
            "capture": str(self.capture.folder),
            "verdict": self.verdict,
            "findings": [asdict(finding) for finding in self.findings],
            "alignment": self.alignment.document(self.capture),
        }


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
    findings = [_count(capture), *_pictures(capture, raw, stack), *_lights(seen.lights, stack)]
    findings += _sweeps_there(capture)
    findings += seen.trouble + _sweeps(capture, stack, seen.passages, seen.gains)
    findings += [
        Finding(
            subject="clipped scattering" if "cut off" in text else "registration",
            value=text,
            verdict="bad" if "cut off" in text else "doubtful",
        )
        for text in alignment.warnings
    ]
    findings += [_alignment(capture, alignment), _split(stack)]
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
    still = [aligned_stream(stream, motion) for stream, motion in zip(streams, alignment.sweeps, strict=True)]
    passages, gains, trouble = _pass(stack, still, progress)
    return _Seen(alignment=alignment, stack=stack, lights=lights, passages=passages, gains=gains, trouble=trouble)


def graded(value: float, limits: tuple[float, float]) -> Verdict:
    """Good up to the first limit, bad from the second; the limits may fall."""
    first, second = limits
    if first > second:
        value, first, second = -value, -first, -second
    return "good" if value <= first else ("bad" if value >= second else "doubtful")


def _count(capture: Capture) -> Finding:
    count = len(capture.names)
    verdict: Verdict = "good" if count >= 6 else "bad"
    advice = "" if count >= 6 else "the fit needs 6 pictures or more: take the object under more lights"
    return Finding(subject="pictures", value=f"{count}", verdict=verdict, advice=advice, numbers={"count": count})


def _pictures(capture: Capture, raw: RawPictures, stack: PhotometricStack) -> list[Finding]:
    findings = []
    shares = {n: float(s.any(0)[stack.mask].float().mean()) for n, s in zip(raw.names, raw.saturated, strict=True)}
    worst = max(shares, key=lambda name: shares[name])
    verdict = graded(shares[worst], SATURATED)
    advice = "" if verdict == "good" else f"expose {worst} shorter, or bracket it"
    value = f"{shares[worst]:.1%} of the object clipped at most ({worst})" if shares[worst] else "nothing clipped"
    findings.append(Finding(subject="saturation", value=value, verdict=verdict, advice=advice, numbers=shares))
    peak = float(
        torch.stack(
            [
                p[:, stack.mask].flatten().kthvalue(max(1, int(0.999 * p[:, stack.mask].numel()))).values
                for p in raw.values
            ]
        ).amax()
    )
    if any(bool(s.any()) for s in raw.saturated) or not capture.full(capture.basis[0]).file.endswith(".exr"):
        findings.append(
            Finding(
                subject="level",
                value=f"brightest picture reaches {peak:.0%} of full scale",
                verdict=graded(peak, (0.25, 0.05)),
                advice="" if peak >= 0.25 else "expose longer: most of the camera's range is not used",
                numbers={"peak": peak},
            )
        )
    noise = [fine_noise(picture, stack.mask) for picture in stack.images]
    bright = float(
        stack.images[:, :, stack.mask].flatten().abs().topk(max(1, int(stack.mask.sum()) // 100)).values.min()
    )
    share = max(noise) / max(bright, 1e-12)
    findings.append(
        Finding(
            subject="noise",
            value=f"{share:.2%} of the bright end at most (fine texture counts as noise)",
            verdict=graded(share, NOISE),
            advice="" if share <= NOISE[0] else "average exposures, or expose longer",
            numbers={"noise": max(noise), "relative": share},
        )
    )
    return findings


def _lights(lights: AlphaReport, stack: PhotometricStack) -> list[Finding]:
    if lights.condition is None:
        return [
            Finding(
                subject="light directions",
                value="unknown: alpha comes from the pictures",
                verdict="doubtful",
                advice="give directions (chrome sphere: reflectsep calibrate chrome=FOLDER) to relight by direction",
            )
        ]
    assert stack.light_vectors is not None
    unit = stack.light_vectors / stack.light_vectors.norm(dim=1, keepdim=True)
    tilt = torch.rad2deg(torch.acos((unit @ stack.view).clamp(-1, 1)))
    inside = int((lights.alpha[3:] >= -0.05).all(1).sum())
    largest = float(lights.alpha.abs().max())
    verdict = graded(lights.condition, CONDITION)
    value = (
        f"basis condition {lights.condition:.1f}; lights {float(tilt.min()):.0f} to {float(tilt.max()):.0f} degrees "
        f"off the view, {inside} of {len(stack.names) - 3} inside the cone of the basis"
    )
    advice = "" if verdict == "good" else "choose basis lights further apart: basis=[A,B,C]"
    numbers = {"condition": lights.condition, "tilt_deg": tilt.tolist(), "largest_alpha": largest}
    findings = [Finding(subject="light geometry", value=value, verdict=verdict, advice=advice, numbers=numbers)]
    if lights.agreement:
        worst = max(lights.agreement, key=lambda a: a.angle_deg)
        # An estimate that is itself uncertain says less against the list.
        beyond = max(0.0, worst.angle_deg - 2 * worst.angle_sd_deg)
        findings.append(
            Finding(
                subject="lights against pictures",
                value=f"list and pictures {worst.angle_deg:.1f} +- {worst.angle_sd_deg:.1f} degrees and "
                f"{worst.magnitude_percent:+.0f} % apart at most ({worst.light}); the list is used",
                verdict=graded(beyond, AGREEMENT_DEG),
                advice="" if beyond <= AGREEMENT_DEG[0] else f"measure {worst.light} again, or leave its direction out",
                numbers={a.light: asdict(a) for a in lights.agreement},
            )
        )
    return findings


def _sweeps_there(capture: Capture) -> list[Finding]:
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


def _pass(
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


def _sweeps(
    capture: Capture, stack: PhotometricStack, passages: Sequence[Passage], gains: Gains | None
) -> list[Finding]:
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


def _split(stack: PhotometricStack) -> Finding:
    """What these lights and this noise leave uncertain of a typical lobe, at the object's own shading."""
    noise = max(float(torch.tensor([fine_noise(picture, stack.mask) for picture in stack.images]).median()), 1e-9)
    values = stack.images.mean(1)[:, stack.mask].double().clamp_min(0)
    values = values[:, :: max(1, values.shape[1] // SPLIT_PIXELS)]
    bright = float(values.flatten().kthvalue(max(1, int(0.99 * values.numel()))).values)
    d = values[:3].mT
    lit = d.min(1).values > 0.05 * bright
    if int(lit.sum()) < 16:
        return Finding(
            subject="expected split",
            value="too few pixels are lit by all three basis lights",
            verdict="bad",
            advice="choose basis lights nearer to the view",
        )
    relative, seen = _nominal_split(d[lit], stack.alpha.double(), noise, bright)
    verdict = graded(relative, SPLIT)
    return Finding(
        subject="expected split",
        value=f"noise alone leaves a typical lobe uncertain by {relative:.1%} of itself; {seen:.0%} of the object "
        "would show it in two pictures or more",
        verdict=verdict if seen > 0.02 else "doubtful",
        advice="" if verdict == "good" else "more lights, less noise, or lights nearer to the mirror direction",
        numbers={"relative": relative, "seen": seen},
    )


def _nominal_split(d: Tensor, alpha: Tensor, noise: float, bright: float) -> tuple[float, float]:
    """Median of sd over size of the specular root's power, and the share of pixels that see the lobe twice."""
    B = -2 * NOMINAL_A / d.mean(1)
    shared = Globals(
        a=torch.full((3,), NOMINAL_A, dtype=torch.float64),
        n_s=torch.tensor(NOMINAL_N_S, dtype=torch.float64),
        n_d=1.0,
        softness=torch.tensor(0.0, dtype=torch.float64),
        haze=torch.tensor(0.0, dtype=torch.float64),
    )

    def pictures(theta: Tensor) -> Tensor:
        still = torch.zeros(1, len(alpha), dtype=theta.dtype)
        edge = torch.zeros(1, 1, dtype=theta.dtype)
        return reflectance(theta[None, :3], theta[3], shared, s=still, alpha=alpha, width=edge)[0]

    theta = torch.cat([d, B[:, None]], 1)
    jacobian = torch.func.vmap(torch.func.jacfwd(pictures))(theta)  # (pixels, lights, 4)
    base = (NOMINAL_A + B[:, None] * d).clamp(0, 1.3)
    lobe = (base @ alpha.mT).clamp(0, 1.3) ** NOMINAL_N_S
    information = jacobian.mT @ jacobian / noise**2 + 1e-9 * torch.eye(4, dtype=d.dtype)
    covariance = torch.linalg.inv(information)
    power = NOMINAL_N_S * base ** (NOMINAL_N_S - 1)
    slope = torch.zeros(len(d), 3, 4, dtype=d.dtype)
    slope[:, range(3), range(3)] = power * B[:, None]
    slope[:, :, 3] = power * d
    sd = torch.einsum("pki,pij,pkj->pk", slope, covariance, slope).clamp_min(0).sqrt()
    size = base**NOMINAL_N_S
    shows = size > max(3 * noise, 0.02 * bright)
    relative = float((sd / size.clamp_min(1e-12))[shows].median()) if bool(shows.any()) else float("inf")
    return relative, float(((lobe > 3 * noise).sum(1) >= 2).double().mean())


def table(result: CheckResult, *, colour: bool, width: int = 110) -> str:
    """The findings as a table for a terminal; verdicts are words, and colours where wanted."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    styles = {"good": "green", "doubtful": "yellow", "bad": "bold red"}
    rows = Table(title=f"{result.capture.object} in {result.capture.folder}", title_justify="left", expand=False)
    for heading in ("", "found", "", "what to do"):
        rows.add_column(heading, overflow="fold")
    for finding in result.findings:
        verdict = Text(finding.verdict, style=styles[finding.verdict])
        rows.add_row(Text(finding.subject), Text(finding.value), verdict, Text(finding.advice))
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=colour, color_system="standard" if colour else None, width=width)
    console.print(rows)
    console.print(Text(f"verdict: {result.verdict}", style=styles[result.verdict]))
    return stream.getvalue().rstrip()


def draw(result: CheckResult, path: Path | str) -> None:
    """Write the picture sheet."""
    maps = {}
    for passage in result.passages:
        name = f"{passage.sweep.light} {passage.sweep.direction}"
        maps[f"{name}: frame of passage"] = passage.centre
        maps[f"{name}: lit frame / full"] = passage.peak
    write_sheet(
        path,
        result.stack.names,
        result.pictures,
        result.saturated,
        result.mask,
        maps=maps,
        motions=result.alignment.document(result.capture),
        lines=[(f.subject, f.value, f.verdict) for f in result.findings],
        title=f"{result.capture.object}: {result.verdict}",
    )
