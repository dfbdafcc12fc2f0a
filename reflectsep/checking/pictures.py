"""Findings on the full pictures and their lights: level, clipping, noise, geometry."""

from __future__ import annotations

from dataclasses import asdict

import torch

from reflectsep.calibrate.alpha import AlphaReport
from reflectsep.checking.findings import Finding, Verdict, graded
from reflectsep.data import Capture, PhotometricStack
from reflectsep.io.stack import RawPictures
from reflectsep.scatter.gains import fine_noise

SATURATED = (0.005, 0.05)
"""Shares of the object from which clipping is doubtful, and bad."""
CONDITION = (6.0, 50.0)
NOISE = (0.01, 0.05)
AGREEMENT_DEG = (2.0, 8.0)


def picture_count(capture: Capture) -> Finding:
    """Whether there are as many pictures as a fit needs."""
    count = len(capture.names)
    verdict: Verdict = "good" if count >= 6 else "bad"
    advice = "" if count >= 6 else "the fit needs 6 pictures or more: take the object under more lights"
    return Finding(subject="pictures", value=f"{count}", verdict=verdict, advice=advice, numbers={"count": count})


def picture_findings(capture: Capture, raw: RawPictures, stack: PhotometricStack) -> list[Finding]:
    """Clipping, level and noise of the full pictures."""
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


def light_findings(lights: AlphaReport, stack: PhotometricStack) -> list[Finding]:
    """Geometry of the lights, and whether vectors and pictures agree."""
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
