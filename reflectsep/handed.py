"""Globals that a fit takes over from another result: read, and held against what is to be fitted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from reflectsep.calibrate.alignment import Alignment
from reflectsep.config import FitSettings, ScatterSettings
from reflectsep.data import Capture, Learnt, PhotometricStack, Region, Scattering, SweepReport
from reflectsep.errors import ResultError
from reflectsep.io.result import DOCUMENT, read_document
from reflectsep.io.stack import kept_size
from reflectsep.scatter.options import HeldSweeps

SAME = 1e-4
"""Components of stated light vectors and alphas that differ by less are alike; a result holds single precision."""
SAME_EXPOSURE = 0.01
ALIKE = ("scattering", "lobe", "shading", "dtype")
"""Settings of the fit that another fit's globals depend on."""


@dataclass(frozen=True, kw_only=True)
class Handed:
    """What a result has to hand on."""

    folder: Path
    use: Literal["held", "start"]
    learnt: Learnt
    names: tuple[str, ...]
    alpha: torch.Tensor
    """(lights, 3), as stated, before any refinement."""
    vectors: torch.Tensor | None
    """(lights, 3); None where they are unknown."""
    channels: int
    exposure_s: float | None
    settings: Mapping[str, Any]
    """Of the fit."""
    sweeps: HeldSweeps | None
    alignment: Alignment | None
    capture: str
    region: Region | None
    created: str

    @property
    def held(self) -> bool:
        """Whether nothing of it is fitted again."""
        return self.use == "held"

    def document(self) -> dict[str, Any]:
        """As it stands in the new result's `separation.json`."""
        return {"result": str(self.folder.resolve()), "use": self.use, "created": self.created}

    def wrong(self, what: str, found: object, expected: object) -> ResultError:
        """An error that names the folder."""
        return ResultError(f"{self.folder}: globals of a fit with {what} {found}, expected {expected}")

    def require_capture(self, capture: Capture, settings: FitSettings, scatter: ScatterSettings) -> None:
        """Refuse what can be told before a picture is read.

        Raises:
            ResultError: other lights, exposure, settings, or sweeps that it knows nothing of.
        """
        for name in ALIKE:
            theirs, own = self.settings.get(name), getattr(settings, name)
            if theirs != own:
                raise self.wrong(f"fit.{name}", theirs, own)
        if self.names[:3] != capture.names[:3]:
            raise self.wrong("basis lights", ", ".join(self.names[:3]), ", ".join(capture.names[:3]))
        if self.names != capture.names:
            raise self.wrong(
                f"{len(self.names)} lights",
                f"({', '.join(self.names)})",
                f"{len(capture.names)} ({', '.join(capture.names)})",
            )
        mine, theirs = capture.exposure_s, self.exposure_s
        if mine is not None and theirs is not None and abs(mine / theirs - 1) > SAME_EXPOSURE:
            raise self.wrong("pictures of", f"{theirs:g} s", f"{mine:g} s, the unit of every value")
        if self.held and settings.n_s is not None and not math.isclose(self.n_s, settings.n_s, rel_tol=SAME):
            raise self.wrong("n_s", f"{self.n_s:g}", f"fit.n_s={settings.n_s:g}; leave that out, or take globals=start")
        if self.held and settings.scattering == "measured":
            self._require_sweeps(capture, scatter)

    def motions(self, capture: Capture) -> Alignment | None:
        """Motions of the pictures of `capture`, where they are held and the result is of another part of it."""
        if not self.held or self.alignment is None or self.capture != str(capture.folder.resolve()):
            return None
        old, new = ((0, 0) if part is None else (part.x, part.y) for part in (self.region, capture.region))
        return self.alignment.in_window(new[0] - old[0], new[1] - old[1], kept_size(capture))

    @property
    def n_s(self) -> float:
        """Exponent of the lobe."""
        return math.exp(self.learnt.shared[3])

    def _require_sweeps(self, capture: Capture, scatter: ScatterSettings) -> None:
        swept = [sweep for sweep in capture.sweeps if sweep.light in capture.names]
        if bool(swept) != (self.sweeps is not None):
            words = ("scattering measured", "scattering taken as zero")
            raise ResultError(
                f"{self.folder}: globals of a fit with {words[self.sweeps is None]}, expected {words[not swept]}"
            )
        if self.sweeps is None:
            return
        if scatter.n_d is not None and not math.isclose(scatter.n_d, self.sweeps.n_d, rel_tol=SAME):
            raise self.wrong("n_d", f"{self.sweeps.n_d:g}", f"scatter.n_d={scatter.n_d:g}")
        known = {(report.light, report.direction) for report in self.sweeps.sweeps}
        for sweep in swept:
            if (sweep.light, sweep.direction) not in known:
                listed = ", ".join(f"{light} along {direction}" for light, direction in sorted(known))
                raise self.wrong("sweeps", listed, f"one of {sweep.light} along {sweep.direction}")

    def applied(self, stack: PhotometricStack) -> PhotometricStack:
        """The stack with the result's lights; those that are stated must be the same.

        Raises:
            ResultError: another number of channels, or other lights.
        """
        if stack.images.shape[1] != self.channels:
            raise self.wrong("channels", self.channels, stack.images.shape[1])
        if (stack.light_vectors is None) != (self.vectors is None):
            words = ("unknown", "known")
            raise self.wrong(
                "directions of lights", words[self.vectors is not None], words[stack.light_vectors is not None]
            )
        if stack.light_vectors is not None and self.vectors is not None:
            off = (stack.light_vectors.double() - self.vectors).abs().amax(1)
            j = int(off.argmax())
            if float(off[j]) > SAME * float(self.vectors.abs().amax()):
                raise self.wrong(
                    f"light {self.names[j]} at", rounded(self.vectors[j]), f"{rounded(stack.light_vectors[j])}"
                )
            return stack
        # Estimated from the pictures: one of the things that all parts of an object must share.
        return replace(stack, alpha=self.alpha.to(stack.alpha)) if self.held else stack


def rounded(vector: torch.Tensor) -> list[float]:
    """A vector as it stands in a message."""
    return [round(float(value), 4) for value in vector]


def learnt_document(
    learnt: Learnt | None, stack: PhotometricStack, scattering: Scattering | None, exposure_s: float | None
) -> dict[str, Any]:
    """What `separation.json` says for another fit to take over; `read_handed` reads it."""
    if learnt is None:
        return {}
    values = asdict(learnt)
    del values["order"], values["covariance"]
    vectors = stack.light_vectors
    return {
        "learnt": {
            **values,
            "channels": stack.images.shape[1],
            "exposure_s": exposure_s,
            "alpha": stack.alpha.double().tolist(),
            "vectors": None if vectors is None else vectors.double().tolist(),
            "n_d": None if scattering is None else scattering.n_d,
        }
    }


def read_handed(settings: FitSettings) -> Handed | None:
    """What `fit.globals_from` has to hand on; None where nothing is to be taken over.

    Raises:
        ResultError: no such folder, no result, or one that says too little.
    """
    if settings.globals_from is None:
        return None
    folder = Path(settings.globals_from)
    if not folder.is_dir():
        raise ResultError(
            f"{folder}: {'a file, a result folder' if folder.exists() else 'no such folder; a result'} was expected"
        )
    document = read_document(folder)
    if not isinstance(document.get("learnt"), dict):
        raise ResultError(f"{folder / DOCUMENT}: no learnt in it, of which a fit takes its globals: fit it again")
    try:
        return _handed(folder, document, settings.globals)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise ResultError(
            f"{folder / DOCUMENT}: its globals cannot be taken over ({type(error).__name__}: {error})"
        ) from error


def _handed(folder: Path, document: Mapping[str, Any], use: Literal["held", "start"]) -> Handed:
    known, covariance = document["learnt"], document["covariance"]
    order = tuple(str(name) for name in covariance["order"])
    learnt = Learnt(
        shared=numbers(known["shared"]),
        order=order,
        covariance=tuple(numbers(row) for row in covariance["values"]),
        noise=positive(known["noise"]),
        kinds=int(known["kinds"]),
        smooth=None if known["smooth"] is None else (positive(known["smooth"][0]), positive(known["smooth"][1])),
    )
    basis = [str(name) for name in document["basis"]]
    names = (*basis, *(str(name) for name in document["lights"] if name not in basis))
    own = 8 + 2 * (learnt.kinds - 1)
    wide = own + 3 * (len(names) - 3)
    if len(learnt.shared) not in (own, wide):
        raise ValueError(f"{len(learnt.shared)} globals; {own} or {wide} were expected")
    if any(len(row) != len(order) for row in (learnt.covariance, *learnt.covariance)):
        raise ValueError(f"a covariance that is not {len(order)} x {len(order)}")
    alpha = matrix(known["alpha"], len(names))
    sweeps = None
    if known["n_d"] is not None:
        sweeps = HeldSweeps(
            n_d=positive(known["n_d"]),
            n_d_sd=numbers([document["n_d_sd"]])[0],
            n_d_source=document["n_d_source"],
            sweeps=tuple(SweepReport(**report) for report in document["sweeps"]),
        )
    region = document.get("region")
    return Handed(
        folder=folder,
        use=use,
        learnt=learnt,
        names=names,
        alpha=alpha,
        vectors=None if known["vectors"] is None else matrix(known["vectors"], len(names)),
        channels=int(known["channels"]),
        exposure_s=None if known["exposure_s"] is None else positive(known["exposure_s"]),
        settings=dict(document["settings"]["fit"]),
        sweeps=sweeps,
        alignment=None if document.get("alignment") is None else Alignment.from_document(document["alignment"]),
        capture=str(document.get("capture", "")),
        region=None if region is None else Region(**dict(zip(("x", "y", "width", "height"), region, strict=True))),
        created=str(document.get("created", "")),
    )


def numbers(values: Sequence[Any]) -> tuple[float, ...]:
    """Finite numbers.

    Raises:
        TypeError, ValueError: one of them is none.
    """
    found = tuple(float(value) for value in values)
    if not all(map(math.isfinite, found)):
        raise ValueError(f"{found}: finite numbers were expected")
    return found


def positive(value: Any) -> float:
    """A finite number above zero.

    Raises:
        TypeError, ValueError: it is none.
    """
    number = numbers([value])[0]
    if not number > 0:
        raise ValueError(f"{number}: a number above 0 was expected")
    return number


def matrix(rows: Sequence[Sequence[Any]], count: int) -> torch.Tensor:
    """`count` rows of three finite numbers, float64.

    Raises:
        TypeError, ValueError: it is none.
    """
    found = torch.tensor([numbers(row) for row in rows], dtype=torch.float64)
    if found.shape != (count, 3):
        raise ValueError(f"a matrix of {tuple(found.shape)}, expected ({count}, 3)")
    return found
