"""START HERE: the frozen values that pass between the stages.

    Capture -> PhotometricStack -> Scattering -> Fit -> Separation

A `Capture` is what is on disk, by name; nothing has been read but its manifest. A `PhotometricStack` holds the full
pictures as linear tensors, one per light, the three basis lights first. `Scattering` is what the slab sweeps gave:
the part of every basis picture that left the object elsewhere than it entered. `Fit` holds the parameters of Eqs. 20
and 21. `Separation` (reflectsep/separation.py) is the result: all of it together, able to relight itself.

Pictures are (channels, height, width), stacks of them (lights, channels, height, width); row 0 is the top row.
Directions are unit vectors, x right, y up, z towards the camera, from the object to the light or to the camera.
Linear pictures are in the capture's units: scaled to the exposure of the first basis picture.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor

Vector = tuple[float, float, float]


def _notebook() -> Any:
    """Displays stand above everything else: they are looked up only when a person asks to see a value."""
    return import_module("reflectsep.notebook")


@dataclass(frozen=True, kw_only=True)
class Light:
    """A directional light."""

    name: str
    direction: Vector | None = None
    """Unit vector from the object to the light; None where it is unknown."""
    intensity: tuple[float, ...] = (1.0,)
    """One value, or one a channel; in any unit shared by the lights of a capture."""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A full picture (one light on), a dark one (none), or a flat one (an even matte target in the object's place)."""

    kind: Literal["full", "dark", "flat"]
    file: str
    light: str | None = None
    exposure_s: float | None = None
    sha256: str | None = None


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Frames of a thin slab of one light moving over the object (or of a stick's shadow)."""

    light: str
    kind: Literal["slab", "shadow"] = "slab"
    direction: Literal["x", "y"] = "x"
    """Axis along which the slab moves in the picture."""
    exposure_s: float | None = None
    frames: str | None = None
    """File name pattern of the frames with one integer field, e.g. `sweep/L1/{:04d}.exr`; or None for a video."""
    video: str | None = None
    video_start: int = 0
    """Index of the video frame that is frame 0 of the sweep."""
    fps: float | None = None
    count: int
    lost: frozenset[int] = frozenset()
    """Indices of frames that the capture lost; they have no file and are never invented."""
    position_mm: tuple[float | None, ...] | None = None
    time_s: tuple[float | None, ...] | None = None
    dark: str | None = None
    sha256: tuple[str | None, ...] | None = None
    bracket: tuple[Sweep, ...] = ()
    """The same sweep at other exposures, frame by frame; merged as it is read."""

    @property
    def exposures(self) -> tuple[Sweep, ...]:
        """Every exposure as a sweep of its own, this one first."""
        return (replace(self, bracket=()), *self.bracket)

    def _repr_html_(self) -> str:
        return _notebook().sweep_html(self)


@dataclass(frozen=True, kw_only=True)
class Encoding:
    """How stored values relate to radiance."""

    kind: Literal["linear", "gamma", "response"] = "linear"
    gamma: float | None = None
    """For kind `gamma`: value = radiance ** (1 / gamma)."""
    response: str | None = None
    """For kind `response`: a CSV of value, radiance rows inside the capture folder."""
    table: tuple[tuple[float, float], ...] | None = None
    """For kind `response`: those rows themselves, from a calibration."""


@dataclass(frozen=True, kw_only=True)
class Region:
    """A window of a picture, in whole pixels from its top left corner."""

    x: int
    y: int
    width: int
    height: int

    @property
    def rows(self) -> slice:
        """Of the whole picture."""
        return slice(self.y, self.y + self.height)

    @property
    def columns(self) -> slice:
        """Of the whole picture."""
        return slice(self.x, self.x + self.width)

    def of(self, picture: Tensor) -> Tensor:
        """The window of a picture (..., height, width), in memory of its own."""
        return picture[..., self.rows, self.columns].clone()

    def inside(self, size: tuple[int, int]) -> bool:
        """Whether all of it is in a picture of `size` (width, height)."""
        width, height = size
        some = self.width > 0 and self.height > 0
        return some and self.x >= 0 and self.y >= 0 and self.x + self.width <= width and self.y + self.height <= height

    def plain(self) -> list[int]:
        """x, y, width, height."""
        return [self.x, self.y, self.width, self.height]

    def __str__(self) -> str:
        return f"[{self.x},{self.y},{self.width},{self.height}]"


@dataclass(frozen=True, kw_only=True)
class Capture:
    """A capture folder's manifest: everything by name, no picture read yet."""

    folder: Path
    object: str = "object"
    created: str | None = None
    view: Vector = (0.0, 0.0, 1.0)
    encoding: Encoding = Encoding()
    size: tuple[int, int] | None = None
    """(width, height) of the files."""
    region: Region | None = None
    """The only part of every file that is to be kept; None: all of it."""
    mask: str | None = None
    lights: Mapping[str, Light]
    basis: tuple[str, str, str]
    images: tuple[Picture, ...]
    sweeps: tuple[Sweep, ...] = ()
    checksums: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 by file, of files without an entry of their own: the mask, a sweep's dark picture, the response."""

    @property
    def names(self) -> tuple[str, ...]:
        """Lights that have a full picture, the basis first, the others in the manifest's order."""
        others = [p.light for p in self.images if p.kind == "full" and p.light not in self.basis]
        return (*self.basis, *dict.fromkeys(name for name in others if name is not None))

    @property
    def exposure_s(self) -> float | None:
        """Exposure of the first basis picture: the unit of every result."""
        return self.full(self.basis[0]).exposure_s

    def full(self, light: str) -> Picture:
        """The full picture under `light`; of a bracket the first.

        Raises:
            KeyError: there is none.
        """
        for picture in self.images:
            if picture.kind == "full" and picture.light == light:
                return picture
        raise KeyError(light)

    def bracketed(self, light: str) -> bool:
        """Whether there are several exposures of `light`."""
        return sum(p.kind == "full" and p.light == light for p in self.images) > 1

    def _repr_html_(self) -> str:
        return _notebook().capture_html(self)

    def plot(self) -> Any:
        """The full pictures as a matplotlib figure, for a notebook."""
        return _notebook().capture_plot(self)


@runtime_checkable
class FrameStream(Protocol):
    """Frames of one sweep, read one at a time, as often as wanted; memory does not grow with their number."""

    @property
    def sweep(self) -> Sweep:
        """What is streamed."""
        ...

    def __len__(self) -> int:
        """Number of frames, lost ones included."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Frames in order, without the lost ones."""
        ...


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One frame of a sweep."""

    index: int
    values: Float[Tensor, "channels height width"]
    """In the capture's units once developed; dark-subtracted, so slightly negative values are normal."""
    saturated: Bool[Tensor, "channels height width"] | None = None


@dataclass(frozen=True, kw_only=True)
class PhotometricStack:
    """Full pictures, linear and on one scale, the basis lights first."""

    names: tuple[str, ...]
    images: Float[Tensor, "lights channels height width"]
    saturated: Bool[Tensor, "lights channels height width"]
    mask: Bool[Tensor, "height width"]
    alpha: Float[Tensor, "lights 3"]
    """Every light as a mix of the basis lights, intensity included (Eq. 15); rows 0-2 are the identity."""
    light_vectors: Float[Tensor, "lights 3"] | None = None
    """Direction times intensity where known for every light, else None."""
    view: Float[Tensor, "3"]
    flags: Int[Tensor, "height width"]


@dataclass(frozen=True, kw_only=True)
class SweepReport:
    """What Eq. 25 gave for one sweep."""

    light: str
    direction: str
    gain: float
    """C: the number of frames in which a patch is lit, times the exposure ratio to the power 1/n_d."""
    gain_sd: float
    lit_frames: float
    """Median number of frames in which a pixel is lit, from its profile over time."""
    speed_deviation: float
    """Robust relative deviation of the slab from constant speed."""
    coverage: float
    """Fraction of the object's pixels that the slab lit."""
    step_px: float = 1.0
    """Pixels that the slab moves in a frame."""


@dataclass(frozen=True, kw_only=True)
class Scattering:
    """Non-directional subsurface scattering, from the sweeps (Eqs. 23 to 25)."""

    root: Float[Tensor, "lights channels height width"]
    """s = I_scat^(1/n_d) of every light of the stack: measured where it has a sweep, mixed by alpha where not."""
    root_sd: Float[Tensor, "lights channels height width"] | None = None
    """Standard deviation of `root` by the noise of the frames."""
    measured: tuple[bool, ...]
    """Per light: has a sweep of its own."""
    n_d: float
    n_d_sd: float
    n_d_source: Literal["estimated", "fixed", "unidentifiable", "no sweeps"]
    sweeps: tuple[SweepReport, ...] = ()
    flags: Int[Tensor, "height width"]
    warnings: tuple[str, ...] = ()

    @property
    def invalid(self) -> Bool[Tensor, "height width"]:
        """Pixels whose root is not finite under at least one light; they are not fitted."""
        return ~self.root.isfinite().all(1).all(0)


@dataclass(frozen=True, kw_only=True)
class Learnt:
    """What a fit has found out of an object as a whole: all that pixels share, and that another fit can take over."""

    shared: tuple[float, ...]
    """Every global, as `reflectsep.fit.problem` orders them."""
    order: tuple[str, ...]
    """Of `covariance`: the globals that were free."""
    covariance: tuple[tuple[float, ...], ...]
    noise: float
    """Standard deviation of one residual, in the capture's units."""
    kinds: int = 1
    """Materials."""
    smooth: tuple[float, float] | None = None
    """Width in pixels of the neighbourhood that has a say in a pixel's lobe, and the spread of lobes about it."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Parameters of Eqs. 20 and 21, fitted jointly."""

    a: Float[Tensor, "3"]
    n_s: Float[Tensor, ""]
    n_d: Float[Tensor, ""]
    f: Float[Tensor, ""]
    """Share of the scattered light that has forgotten the normal; 1 in the paper, 0 in Lin & Lee."""
    softness: Float[Tensor, ""]
    """Softness of a shadow's edge, in units of the cosine; 0: hard, the paper's formula."""
    fresnel: Float[Tensor, ""]
    """Share of Schlick's Fresnel term that the body obeys; 0: none, the paper's formula."""
    ggx: bool
    """Whether the lobe is that of GGX microfacets; else the paper's power."""
    materials: Float[Tensor, "K 2"]
    """Of every material: C_1 over that of the first, and n_s; a and n_s are those of the first."""
    material: Int[Tensor, "height width"]
    """Which material a pixel is of, from 0."""
    global_names: tuple[str, ...]
    """Order of `covariance`: the globals that were free."""
    covariance: Float[Tensor, "globals globals"]
    d: Float[Tensor, "3 channels height width"]
    """D_k^(1/n_d), negative where the patch faces away from basis light k."""
    s: Float[Tensor, "lights channels height width"]
    B: Float[Tensor, "height width"]
    d_sd: Float[Tensor, "3 channels height width"]
    B_sd: Float[Tensor, "height width"]
    residual: Float[Tensor, "lights channels height width"]
    """Picture minus model, in the capture's units."""
    intensity: Float[Tensor, "lights"]
    """Of every light; d, s and B are for lights of unit intensity, a component is intensity times its power."""
    alpha: Float[Tensor, "lights 3"] | None = None
    """As the fit refined the stack's; None where it held them."""
    alpha_sd: Float[Tensor, "lights 3"] | None = None
    flags: Int[Tensor, "height width"]
    noise: float
    """Standard deviation of one residual, in the capture's units."""
    cost: float
    iterations: int
    history: tuple[Mapping[str, float], ...] = field(default=())
    learnt: Learnt | None = None
    warnings: tuple[str, ...] = ()
