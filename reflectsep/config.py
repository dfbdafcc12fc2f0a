"""Settings of every job: plain dataclasses that check themselves, made in Python or by the command alike.

Each field is made by `setting`, which holds its help text and its bounds; a `Literal` type lists its choices. From
these come the structured configs that Hydra checks overrides against (`reflectsep.cli.overrides`) and the help of the
command. Settings are not frozen. A job is what the function `run_*` of `reflectsep.jobs` of its name takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from reflectsep.errors import SettingsError
from reflectsep.settings import check, required, setting, shown

HOME_RIG = "six"
"""The rig that default folder names do not mention."""


@dataclass(kw_only=True)
class ObjectSettings:
    """What is pictured; all but the name matters to the simulator alone."""

    key: ClassVar[str] = "object."
    name: str = setting("", "names the default folders captures/NAME and results/NAME")
    preset: Literal["wax", "pudding", "plastic", "marble", "skin", "turtle"] = setting("wax", "simulated object")
    size_px: int = setting(96, "width and height of the simulated pictures", at_least=16, at_most=4096)
    channels: Literal[1, 3] = setting(1, "1 for grey, 3 for colour")
    full_exposure_s: float | None = setting(
        None, "of its full pictures when captured; null: the rig's", above=0.0, at_most=3600.0
    )
    slab_exposure_s: float | None = setting(
        None, "of its slab frames when captured; null: the rig's", above=0.0, at_most=3600.0
    )
    extent_mm: list[float] | None = setting(None, "where a capture's sweeps start and end; null: the rig's", length=2)

    def __post_init__(self) -> None:
        check(self)


@dataclass(kw_only=True)
class SweepSettings:
    """How the stage moves the slit in a capture."""

    key: ClassVar[str] = "rig.sweep."
    speed_mm_s: float = setting(10.0, "of the slit, constant over a sweep", above=0.0)
    rate_hz: float = setting(10.0, "frames a second", above=0.0, at_most=1000.0)
    extent_mm: list[float] | None = setting(
        None, "where the first and last frame are; null: around a simulated object", length=2
    )
    park_mm: float = setting(-1.0, "where the slit is out of the light, for full pictures")
    motion: Literal["continuous", "stepped"] = setting("continuous", "frames on the way, or at rest one by one")
    dark_frames: int = setting(16, "dark pictures averaged, for each exposure; 0: none", at_least=0, at_most=256)
    max_lost: float = setting(0.05, "share of a sweep's frames that may be lost", at_least=0.0, at_most=0.5)
    latency_s: float = setting(
        0.0, "from mid-exposure to the earliest arrival, where the camera's clock cannot be read", at_least=0.0
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(kw_only=True)
class DeviceSettings:
    """What a capture drives: `_target_` names a backend, the rest are its own settings; null: simulated."""

    key: ClassVar[str] = "rig.devices."
    stage: dict[str, Any] | None = setting(None, "grbl, marlin or simulated")
    camera: dict[str, Any] | None = setting(None, "aravis, gphoto2, folder, video, command or simulated")
    lights: dict[str, Any] | None = setting(None, "serial, command, manual or simulated")

    def __post_init__(self) -> None:
        check(self)


@dataclass(kw_only=True)
class RigSettings:
    """Lights, slab and camera; `simulate` renders them, `capture` drives them, a fit reads them from the capture."""

    key: ClassVar[str] = "rig."
    name: str = setting(HOME_RIG, f"added to the default folder names unless it is {HOME_RIG}")
    lights: int = setting(6, "full pictures, the three basis lights included", at_least=3, at_most=500)
    basis_angle_deg: float = setting(25.0, "angle of the basis lights off the view", above=0.0, at_most=85.0)
    spread_deg: float = setting(30.0, "largest angle of the other lights off the view", above=0.0, at_most=85.0)
    heldout: int = setting(
        3,
        "lights to relight, inside the cone of the basis; one more lies outside",
        at_least=0,
        at_most=100,
    )
    sweeps: int = setting(3, "lights that are swept with a slab, the basis first; 0: none", at_least=0)
    orthogonal: bool = setting(False, "sweep each of them along y as well as along x")
    slab_width_px: float = setting(4.0, "width of the slab", above=0.0)
    slab_step_px: float = setting(2.0, "its step from frame to frame", above=0.0)
    full_exposure_s: float = setting(0.01, "exposure of the full pictures", above=0.0)
    sweep_exposure_s: float = setting(0.01, "exposure of the slab frames", above=0.0)
    dark_level: float = setting(0.0, "what a covered lens reads, of full scale", at_least=0.0, at_most=0.9)
    read_noise: float = setting(0.0, "standard deviation at black, of full scale", at_least=0.0, at_most=0.5)
    shot_noise: float = setting(0.0, "standard deviation at full scale, of full scale", at_least=0.0, at_most=0.5)
    bits: int | None = setting(None, "quantisation; null: none", at_least=4, at_most=16)
    gamma: float | None = setting(
        None, "of the camera's files, value ^ (1 / gamma); null: linear", above=0.0, at_most=10.0
    )
    headroom: float = setting(1.25, "saturation level over the brightest full picture", above=0.0)
    oversample: int = setting(
        1, "patches along a pixel's side that are rendered and added up; 2 or more where the camera drifts", at_least=1
    )
    drift_px: float = setting(0.0, "shift of the camera between a light's full picture and its sweep", at_least=0.0)
    drift_deg: float = setting(0.0, "its rotation there", at_least=0.0, at_most=45.0)
    drift_across_px: float = setting(0.0, "shift of the camera between the lights' full pictures", at_least=0.0)
    drift_across_deg: float = setting(0.0, "its rotation there", at_least=0.0, at_most=45.0)
    drift_within_px: float = setting(0.0, "shift of the camera from a sweep's first frame to its last", at_least=0.0)
    auto_exposure: Literal["none", "full", "slab", "both"] = setting("none", "which a capture finds by test pictures")
    lights_file: str | None = setting(None, "a capture's lights (.lp, .json, .txt); null: as simulated", path=True)
    mask: Literal["auto", "none"] = setting("auto", "of a capture: where any light makes a difference, or none")
    sweep: SweepSettings = field(default_factory=SweepSettings)
    devices: DeviceSettings = field(default_factory=DeviceSettings)

    def __post_init__(self) -> None:
        check(self)


@dataclass(kw_only=True)
class FitSettings:
    """How Eqs. 20 and 21 are fitted."""

    key: ClassVar[str] = "fit."
    method: Literal["joint", "two_step"] = setting("joint", "all parameters at once, or globals on chosen pixels first")
    scattering: Literal["measured", "none", "unknown"] = setting(
        "measured", "from the sweeps, left out (Lin & Lee), or fitted (7 unknowns a pixel)"
    )
    lobe: Literal["ggx", "power"] = setting("ggx", "highlight of GGX microfacets, or the paper's power of a cosine")
    shading: Literal["fitted", "lambert"] = setting(
        "fitted", "Fresnel's losses and soft shadow edges are fitted, or the paper's clamp alone"
    )
    n_s: float | None = setting(None, "exponent of the lobe; null: fitted", above=0.0, at_most=5000.0)
    f: float | None = setting(
        0.0,
        "share of scattered light that has forgotten the normal; 0: Lin & Lee, 1: the paper, null: fitted",
        at_least=0.0,
        at_most=1.0,
    )
    materials: int | None = setting(
        None, "materials of different gloss; null: as many as the pictures want", at_least=1, at_most=4
    )
    refine_n_d: bool = setting(False, "fit n_d too")
    alpha_sd: float = setting(
        0.0,
        "uncertainty of stated alphas (directions in radians, relative intensities) within which they are refined by "
        "the joint fit; 0: held",
        at_least=0.0,
        at_most=1.0,
    )
    lambda_basis: float = setting(1.0, "weight of the basis pictures in Eq. 22", above=0.0)
    lambda_other: float = setting(1.0, "weight of the other pictures; 2 in the paper", above=0.0)
    robust: Literal["huber", "none"] = setting("huber", "loss that weighs cast shadows down")
    prior: Literal["auto", "none"] = setting("auto", "highlights of one height and alike in neighbours, or no prior")
    max_iterations: int = setting(30, "limit of every solve", at_least=1)
    tolerance: float = setting(
        1e-6, "relative change of the cost that ends a pixel's iterations", above=0.0, at_most=1.0
    )
    chunk: int = setting(4096, "pixels handled at once; bounds the memory", at_least=1)
    dtype: Literal["float32", "float64"] = setting("float64", "arithmetic of the fit")
    share: float = setting(
        1.0, "of the object that is fitted, in squares strewn evenly: for globals to hold", above=0.0, at_most=1.0
    )
    globals_from: str | None = setting(
        None, "result of another part of the object, or of another fit of it, to take the globals from", path=True
    )
    globals: Literal["held", "start"] = setting(
        "held", "those globals, C, n_d and priors are not fitted again, or the globals are where the fit starts"
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(kw_only=True)
class ScatterSettings:
    """How the scattering comes out of the sweeps (Eqs. 23 to 25)."""

    key: ClassVar[str] = "scatter."
    hole_filling: Literal["profile", "maximum", "interpolation"] = setting(
        "profile", "what stands in where the slab itself lit"
    )
    lit_band: Literal["threshold", "profile"] = setting("profile", "how the lit band of a frame is found")
    threshold: float = setting(0.25, "frame over full picture, above which a pixel is lit", above=0.0, at_most=1.0)
    n_d: float | None = setting(None, "exponent of the diffuse part; null: estimated", above=0.0, at_most=10.0)
    distance_px: float = setting(
        1.0, "light that leaves farther than this from where it entered counts as scattering", at_least=0.0
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(kw_only=True)
class CalibrationSettings:
    """What is corrected before anything is measured."""

    key: ClassVar[str] = "calibration."
    registration: Literal["all", "same_light", "none"] = setting(
        "all", "drift of the camera: of all pictures, of sweeps against their full pictures alone, or not looked for"
    )
    motion: Literal["translation", "rigid", "affine", "homography"] = setting(
        "homography", "the richest motion that the evidence may choose"
    )
    file: str | None = setting(
        None, "calibration to use; null: calibration.json in the capture's folder, where there is one", path=True
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(kw_only=True)
class SimulateJob:
    """Write a simulated capture with its truth beside it."""

    key: ClassVar[str] = ""
    object: ObjectSettings = field(default_factory=lambda: ObjectSettings(name="wax"))
    rig: RigSettings = field(default_factory=RigSettings)
    mode: Literal["transport", "paper"] = setting("transport", "light transport, or data exactly by the paper's model")
    seed: int = setting(0, "of the noise", at_least=0)
    out: str = setting("", "capture folder to write; default captures/NAME", path=True)
    overwrite: bool = setting(False, "replace what is there")

    def __post_init__(self) -> None:
        check(self)
        self.out = self.out or f"captures/{folder_name(self.object, self.rig)}"


@dataclass(kw_only=True)
class CaptureJob:
    """Take the pictures: drive stage, lights and camera through full, dark and sweep shots."""

    key: ClassVar[str] = ""
    object: ObjectSettings = field(default_factory=lambda: ObjectSettings(name="wax"))
    rig: RigSettings = field(default_factory=RigSettings)
    out: str = setting("", "capture folder to write; default captures/NAME", path=True)
    dry_run: bool = setting(False, "print the plan, with time and space, and touch nothing")
    resume: bool = setting(False, "go on with the session in the folder")
    zeroed: bool = setting(False, "the carriage of a stage without switches was put at zero for the resumption")

    def __post_init__(self) -> None:
        check(self)
        self.out = self.out or f"captures/{folder_name(self.object, self.rig)}"


@dataclass(kw_only=True)
class CaptureAndFitJob:
    """Take the pictures and separate them."""

    key: ClassVar[str] = ""
    object: ObjectSettings = field(default_factory=lambda: ObjectSettings(name="wax"))
    rig: RigSettings = field(default_factory=RigSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    scatter: ScatterSettings = field(default_factory=ScatterSettings)
    out: str = setting("", "capture folder to write; default captures/NAME", path=True)
    result: str = setting("", "result folder to write; default results/NAME", path=True)
    resume: bool = setting(False, "go on with the session in the folder")
    zeroed: bool = setting(False, "the carriage of a stage without switches was put at zero for the resumption")
    overwrite: bool = setting(False, "replace the result that is there")

    def __post_init__(self) -> None:
        check(self)
        name = folder_name(self.object, self.rig)
        self.out = self.out or f"captures/{name}"
        self.result = self.result or f"results/{name}"


@dataclass(kw_only=True)
class FitJob:
    """Separate a capture: write a result folder."""

    key: ClassVar[str] = ""
    object: ObjectSettings = field(default_factory=ObjectSettings)
    rig: RigSettings = field(default_factory=RigSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    scatter: ScatterSettings = field(default_factory=ScatterSettings)
    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    capture: str = setting("", "capture folder, or pictures with a light list; default captures/NAME", path=True)
    out: str = setting("", "result folder to write; default results/NAME", path=True)
    overwrite: bool = setting(False, "replace what is there")
    basis: list[str] | None = setting(None, "names of three basis lights; null: the capture's", length=3)
    region: list[int] | None = setting(
        None, "x, y, width, height in pixels from the top left: all that is kept of the pictures; null: all", length=4
    )
    heldout: list[str] | None = setting(None, "names of lights to leave out of the fit")
    lights_file: str | None = setting(None, "light directions (.lp, .txt, .json) instead of the capture's", path=True)
    report: bool = setting(True, "write report.html beside the result")
    baseline: bool | None = setting(
        None, "fit Lin & Lee's model as well, to stand beside in the report; null: where that takes a minute at most"
    )

    def __post_init__(self) -> None:
        check(self)
        if not self.capture and not self.object.name:
            raise SettingsError("no capture: give capture=FOLDER, or object=NAME for captures/NAME")
        if self.basis is not None and len(set(self.basis)) != len(self.basis):
            raise SettingsError(f"basis={shown(self.basis)}: the three lights must differ")
        name = folder_name(self.object, self.rig) if self.object.name else Path(self.capture).resolve().name
        self.capture = self.capture or f"captures/{name}"
        self.out = self.out or f"results/{name}"


@dataclass(kw_only=True)
class RelightJob:
    """Write pictures of a result under other lights."""

    key: ClassVar[str] = ""
    result: str = required("result folder to relight", path=True)
    lights: str | None = setting(None, "file of lights, .lp or .json", path=True)
    direction: list[float] | None = setting(None, "one light, from the object to the light", length=3)
    alpha: list[float] | None = setting(None, "one light as a mix of the basis lights", length=3)
    orbit: int | None = setting(None, "number of lights on a circle around the view", at_least=1, at_most=9999)
    elevation_deg: float = setting(45.0, "of the orbit above the picture plane", at_least=0.0, at_most=90.0)
    intensity: float = setting(1.0, "times that of every light", at_least=0.0)
    format: Literal["exr", "png", "gif", "mp4", "ffv1"] = setting(
        "exr", "linear pictures, or 8-bit pictures for a screen, or one film of all of them in their order"
    )
    fps: float = setting(25.0, "frames a second of a film", above=0.0, at_most=240.0)
    exposure_ev: float = setting(0.0, "stops brighter, of pictures for a screen and films", at_least=-20, at_most=20)
    out: str = setting("relit", "folder to write NAME.exr, NAME.png or film.* into", path=True)
    overwrite: bool = setting(False, "replace what is there")

    def __post_init__(self) -> None:
        check(self)
        ways = ("lights", "direction", "alpha", "orbit")
        given = [name for name in ways if getattr(self, name) is not None]
        if len(given) != 1:
            what = f"both {' and '.join(given)} are given" if given else "no light is given"
            raise SettingsError(f"{what}: give one of lights=FILE, direction=[x,y,z], alpha=[a1,a2,a3], orbit=N")
        if self.direction is not None and not math.hypot(*self.direction) > 1e-6:
            raise SettingsError(f"direction={shown(self.direction)}: must not be zero")


@dataclass(kw_only=True)
class CompareJob:
    """Draw a result beside Lin & Lee's and, for held-out lights, beside the real pictures."""

    key: ClassVar[str] = ""
    result: str = required("result folder to compare", path=True)
    capture: str | None = setting(None, "its capture; null: the folder that the result names", path=True)
    out: str = setting("compare.png", "figure to write (.png)", path=True)
    overwrite: bool = setting(False, "replace what is there")

    def __post_init__(self) -> None:
        check(self)
        if Path(self.out).suffix.lower() != ".png":
            raise SettingsError(f"out={self.out}: must end in .png")


@dataclass(kw_only=True)
class ReportJob:
    """Write the report of a result: one offline HTML file, to read or to print."""

    key: ClassVar[str] = ""
    result: str = required("result folder to report", path=True)
    capture: str | None = setting(None, "its capture; null: the folder that the result names", path=True)
    out: str = setting("", "report to write (.html); default RESULT/report.html", path=True)
    baseline: bool = setting(True, "fit Lin & Lee's model as well, to stand beside; takes as long as a fit")
    frames: list[int] | None = setting(None, "frames to show with their lit band and filled hole; null: three, evenly")
    overwrite: bool = setting(False, "replace what is there")

    def __post_init__(self) -> None:
        check(self)
        self.out = self.out or str(Path(self.result) / "report.html")
        if Path(self.out).suffix.lower() not in (".html", ".htm"):
            raise SettingsError(f"out={self.out}: must end in .html")


@dataclass(kw_only=True)
class ExportJob:
    """Write a result as files that RTI viewers and renderers open."""

    key: ClassVar[str] = ""
    result: str = required("result folder to export", path=True)
    format: Literal["relight_ptm", "relight_hsh", "ptm", "textures"] = setting(
        "relight_hsh", "info.json with planes (Relight, OpenLIME) of PTM or HSH; a .ptm file; textures for a renderer"
    )
    tilt_deg: float = setting(
        60.0, "largest angle off the view of the relit pictures that it is fitted to", at_least=5.0, at_most=80.0
    )
    out: str = setting("", "folder to write; default RESULT/FORMAT", path=True)
    overwrite: bool = setting(False, "replace what is there")

    def __post_init__(self) -> None:
        check(self)
        self.out = self.out or str(Path(self.result) / self.format)


@dataclass(kw_only=True)
class ViewJob:
    """Write a page in which a result is relit by hand: one offline HTML file."""

    key: ClassVar[str] = ""
    result: str = required("result folder to show", path=True)
    other: str | None = setting(None, "a second result, to compare side by side", path=True)
    out: str = setting("", "page to write (.html); default RESULT/view.html", path=True)
    max_megapixels: float = setting(
        4.0, "finest level in the page; a larger result is halved until it fits", at_least=0.001, at_most=100.0
    )
    measured: bool = setting(True, "put the measured pictures in, to look at through the lens")
    overwrite: bool = setting(False, "replace what is there")

    def __post_init__(self) -> None:
        check(self)
        self.out = self.out or str(Path(self.result) / "view.html")
        if Path(self.out).suffix.lower() not in (".html", ".htm"):
            raise SettingsError(f"out={self.out}: must end in .html")


@dataclass(kw_only=True)
class InfoJob:
    """Say what is in a capture or a result."""

    key: ClassVar[str] = ""
    path: str = required("capture or result folder", path=True)

    def __post_init__(self) -> None:
        check(self)


@dataclass(kw_only=True)
class CheckJob:
    """Look at a capture before a fit: what is wrong with it, what can be expected, and what to do."""

    key: ClassVar[str] = ""
    capture: str = required("capture folder, or pictures with a light list", path=True)
    lights_file: str | None = setting(None, "light directions (.lp, .txt, .json) instead of the capture's", path=True)
    basis: list[str] | None = setting(None, "names of three basis lights; null: the capture's", length=3)
    sheet: str | None = setting(None, "picture sheet to write (.png)", path=True)
    json: bool = setting(False, "print JSON for scripts instead of a table; --json does the same")
    overwrite: bool = setting(False, "replace a sheet that is there")

    def __post_init__(self) -> None:
        check(self)
        if self.sheet is not None and Path(self.sheet).suffix.lower() != ".png":
            raise SettingsError(f"sheet={self.sheet}: must end in .png")


@dataclass(kw_only=True)
class CalibrateJob:
    """Find the lights and the camera's response, once for a bench, and write them beside a capture."""

    key: ClassVar[str] = ""
    capture: str = required("capture folder, or pictures with a light list", path=True)
    chrome: str | None = setting(None, "folder of pictures of a chrome ball, NAME.png a light", path=True)
    circle: list[float] | None = setting(None, "the ball: x, y, radius in pixels; null: its mask, or found", length=3)
    intensity: Literal["keep", "sphere", "pictures"] = setting(
        "keep", "strengths of the lights: as listed, from a matte ball, or jointly from the pictures"
    )
    matte: str | None = setting(None, "folder of pictures of a matte ball of one colour", path=True)
    response: Literal["keep", "debevec", "robertson"] = setting(
        "keep", "the camera's curve: as the manifest says, or from a bracket of one light"
    )
    out: str | None = setting(None, "file to write; null: calibration.json in the capture's folder", path=True)
    overwrite: bool = setting(False, "replace what is there")

    def __post_init__(self) -> None:
        check(self)


@dataclass(kw_only=True)
class DemoJob:
    """Simulate an object, separate and relight it, and show it beside the truth, to see the whole thing."""

    key: ClassVar[str] = ""
    object: ObjectSettings = field(default_factory=lambda: ObjectSettings(name="turtle", preset="turtle", channels=3))
    rig: RigSettings = field(default_factory=RigSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    scatter: ScatterSettings = field(default_factory=ScatterSettings)
    out: str = setting("demo", "folder to write", path=True)
    overwrite: bool = setting(False, "replace what is there")

    def __post_init__(self) -> None:
        check(self)


Job = (
    SimulateJob
    | CaptureJob
    | CaptureAndFitJob
    | FitJob
    | RelightJob
    | CompareJob
    | ReportJob
    | ViewJob
    | ExportJob
    | InfoJob
    | CheckJob
    | CalibrateJob
    | DemoJob
)

JOBS: dict[str, type[Job]] = {
    "simulate": SimulateJob,
    "capture": CaptureJob,
    "capture_and_fit": CaptureAndFitJob,
    "fit": FitJob,
    "relight": RelightJob,
    "compare": CompareJob,
    "report": ReportJob,
    "view": ViewJob,
    "export": ExportJob,
    "info": InfoJob,
    "check": CheckJob,
    "calibrate": CalibrateJob,
    "demo": DemoJob,
}


def folder_name(item: ObjectSettings, rig: RigSettings) -> str:
    """Last part of the default folders: the object's name, and the rig's where it is not the usual one.

    Raises:
        SettingsError: the object has no name, or one that is no plain folder name.
    """
    if not item.name:
        raise SettingsError("the object has no name: give object=NAME, object.name=NAME or the folder itself")
    if Path(item.name).name != item.name:
        raise SettingsError(f"object.name={item.name}: must be a plain name, not a path")
    return item.name if rig.name == HOME_RIG else f"{item.name}-{rig.name}"
