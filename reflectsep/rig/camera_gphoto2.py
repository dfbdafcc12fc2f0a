"""A DSLR through gphoto2: the extra `gphoto2`. One picture at a time; the stage stands still for each.

Setting an exposure that the camera does not have raises nothing: it takes another. So one of its own choices is set,
and what it then says it has is what counts.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from reflectsep.errors import CameraError, MissingExtraError
from reflectsep.io.pictures import SUFFIXES
from reflectsep.rig.clock import Clock, HostClock
from reflectsep.rig.devices import CameraLimits, RawFrame
from reflectsep.rig.still import StillCamera, scratch_folder

SHUTTER = ("shutterspeed", "shutterspeed2", "exptime")
NO_ROOM = (-3, -115)
"""GP_ERROR_NO_MEMORY, which is how a store that is full is told over PTP, and GP_ERROR_NO_SPACE."""
KEPT = ("iso", "f-number", "aperture", "imageformat", "imagequality", "imagesize", "whitebalance", "serialnumber")
"""Settings that a session must not find changed when it goes on."""


class Gphoto2Camera(StillCamera):
    """One camera.

    Args:
        model: As gphoto2 names it; None: the only one there is.
        settings: Set when connecting, e.g. `iso: "100"`.
        delete: Take each picture off the card once it has been fetched, so that the card does not fill.
        clock: The session's.
        scratch: Folder for the files until they are taken over; None: the system's.
    """

    def __init__(
        self,
        *,
        model: str | None = None,
        settings: Mapping[str, str] | None = None,
        delete: bool = True,
        clock: Clock | None = None,
        scratch: Path | None = None,
    ) -> None:
        self._model, self._settings, self._delete = model, dict(settings or {}), delete
        self._clock = clock or HostClock()
        self._scratch = scratch
        self._gp: Any = None
        self._camera: Any = None
        self._shutter: str | None = None
        self._choices: dict[str, float] = {}
        self._identity: dict[str, str] = {}
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._count = 0

    @property
    def limits(self) -> CameraLimits:
        """By its choices of shutter speeds."""
        times = self._choices.values()
        return CameraLimits(exposure_s=(min(times), max(times)) if times else None, streams=False)

    @property
    def identity(self) -> Mapping[str, str]:
        """Model and the settings that matter."""
        return dict(self._identity)

    def connect(self) -> None:
        """Find it and read what it can do."""
        self._gp = _library()
        try:
            self._find()
        except BaseException:
            self.close()
            raise

    def set_exposure(self, exposure_s: float) -> float | None:
        """The nearest of the camera's own choices; what it says then."""
        if not self._choices or self._shutter is None:
            return None
        nearest = min(self._choices, key=lambda text: abs(math.log(self._choices[text] / exposure_s)))
        self._set(self._shutter, nearest)
        return self.read_exposure()

    def read_exposure(self) -> float | None:
        """As the camera says; None where that is no time."""
        said = self._get(self._shutter) if self._shutter else None
        return None if said is None else shutter_time(said)

    def snap(self, name: str) -> RawFrame:  # noqa: ARG002
        """Take one, fetch it, and take it off the card."""
        if self._camera is None or self._folder is None:
            raise CameraError("camera: not connected")
        with _Errors(self._gp, "the camera took no picture"):
            taken = self._camera.capture(self._gp.GP_CAPTURE_IMAGE)
        suffix = Path(taken.name).suffix.lower()
        if suffix not in SUFFIXES:
            raise CameraError(f"the camera gave {taken.name}; set it to one of {' '.join(SUFFIXES)}")
        file = Path(self._folder.name) / f"{self._count:06d}{suffix}"
        self._count += 1
        with _Errors(self._gp, f"{taken.name} cannot be fetched"):
            got = self._camera.file_get(taken.folder, taken.name, self._gp.GP_FILE_TYPE_NORMAL)
            got.save(str(file))
            if self._delete:
                self._camera.file_delete(taken.folder, taken.name)
        return RawFrame(pixels=None, file=file, host_time_s=self._clock.now())

    def close(self) -> None:
        """Let go of it."""
        with suppress(Exception):
            self._camera.exit()
        self._camera = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _find(self) -> None:
        self._folder = scratch_folder(self._scratch)
        with _Errors(self._gp, f"camera {self._model or '(any)'}"):
            self._camera = self._gp.Camera()
            self._camera.init()
        model = self._camera.get_abilities().model
        if self._model is not None and model != self._model:
            raise CameraError(f"camera {self._model}: found {model}")
        for name, value in self._settings.items():
            found = self._set(name, value)
            if found != value:
                raise CameraError(f"{model}: {name}={value} was set, but it reads back {found}")
        self._identity = {"model": model}
        for name in KEPT:
            value = self._get(name)
            if value is not None:
                self._identity[name] = value
            if value is not None and name in ("imageformat", "imagequality") and "+" in value:
                raise CameraError(f"{model}: {name}={value}: two files a picture; set one, raw or JPEG")
        self._shutter = next((name for name in SHUTTER if self._get(name) is not None), None)
        self._choices = self._times() if self._shutter else {}

    def _times(self) -> dict[str, float]:
        with _Errors(self._gp, "shutter speeds"):
            widget = self._camera.get_single_config(self._shutter)
            texts = [widget.get_choice(i) for i in range(widget.count_choices())]
        return {text: seconds for text in texts if (seconds := shutter_time(text)) is not None}

    def _get(self, name: str | None) -> str | None:
        if self._camera is None or name is None:
            return None
        try:
            return str(self._camera.get_single_config(name).get_value())
        except self._gp.GPhoto2Error:
            return None

    def _set(self, name: str, value: str) -> str | None:
        with _Errors(self._gp, f"{name}={value}"):
            widget = self._camera.get_single_config(name)
            known = widget.count_choices() if _has_choices(self._gp, widget) else 0
            choices = [widget.get_choice(i) for i in range(known)]
            if choices and value not in choices:  # some drivers break on what they do not know
                raise CameraError(f"{name}={value}: the camera has {', '.join(choices)}")
            widget.set_value(value)
            self._camera.set_single_config(name, widget)
        return self._get(name)


def _has_choices(gp: Any, widget: Any) -> bool:
    return widget.get_type() in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU)


class _Errors:
    """Context that makes gphoto2's errors ours."""

    def __init__(self, gp: Any, what: str) -> None:
        self._gp, self._what = gp, what

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if isinstance(error, self._gp.GPhoto2Error):
            said = "its card is full" if error.code in NO_ROOM else " ".join(str(error).split())
            raise CameraError(f"{self._what}: {said}") from error


def shutter_time(text: str) -> float | None:
    """Seconds of `1/250`, `0.0100s`, `2` or `1.3`; None of `bulb` and the like."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))?\s*s?", text.strip())
    if match is None:
        return None
    divisor = float(match[2] or 1)
    seconds = float(match[1]) / divisor if divisor else 0.0
    return seconds if seconds > 0 else None


def _library() -> Any:
    try:
        import gphoto2  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtraError("the camera needs gphoto2: pip install 'reflectsep[gphoto2]'") from None
    return gphoto2
