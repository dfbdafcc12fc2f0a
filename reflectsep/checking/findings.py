"""What a check finds: one line a subject, with a verdict, and all of them together."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from jaxtyping import Bool, Float
from torch import Tensor

from reflectsep.calibrate.alignment import Alignment
from reflectsep.data import Capture, PhotometricStack
from reflectsep.scatter.passage import Passage

Verdict = Literal["good", "doubtful", "bad"]


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


def graded(value: float, limits: tuple[float, float]) -> Verdict:
    """Good up to the first limit, bad from the second; the limits may fall."""
    first, second = limits
    if first > second:
        value, first, second = -value, -first, -second
    return "good" if value <= first else ("bad" if value >= second else "doubtful")
