"""A GenICam camera (GigE Vision, USB3 Vision) through Aravis: the extra `aravis`, with the system's Aravis library.

Every buffer's status is looked at: one with missing packets is a lost frame, never a picture. A Bayer mosaic becomes a
colour picture of half the size, each pixel made of its own four samples: nothing is interpolated.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from reflectsep.errors import CameraError, MissingExtraError
from reflectsep.rig.clock import Clock, HostClock
from reflectsep.rig.devices import CameraLimits, ClockReading, RawFrame

BUFFERS = 64
ONE_FRAME_S = 5.0
BITS = {"8": 8, "10": 10, "12": 12, "14": 14, "16": 16}
BAYER = {"RG": (0, 1, 2, 3), "GR": (1, 0, 3, 2), "GB": (2, 3, 0, 1), "BG": (3, 2, 1, 0)}
"""Places, of the four samples (0 1 / 2 3), of red, green, green, blue."""


class AravisCamera:
    """One camera.

    Args:
        camera_id: As Aravis names it; None: the only one there is.
        pixel_format: To set; None: as the camera has it.
        clock: The session's.
    """

    def __init__(
        self, *, camera_id: str | None = None, pixel_format: str | None = None, clock: Clock | None = None
    ) -> None:
        self._id, self._format = camera_id, pixel_format
        self._clock = clock or HostClock()
        self._aravis: Any = None
        self._camera: Any = None
        self._stream: Any = None
        self._identity: dict[str, str] = {}
        self._bounds_s = (1e-5, 10.0)
        self._exposure_s = 0.0
        self._lost = False

    @property
    def limits(self) -> CameraLimits:
        """Counts of GigE Vision go from 1 to 65535 and around."""
        return CameraLimits(exposure_s=self._bounds_s, sequence_first=1, sequence_last=65535)

    @property
    def identity(self) -> Mapping[str, str]:
        """Model, number, format, region."""
        return dict(self._identity)

    def connect(self) -> None:
        """Find it; trigger off, continuous, exposure and gain by hand."""
        self._aravis = _library()
        # A camera that is opened without a look around first may connect and then send nothing.
        self._aravis.update_device_list()
        names = [self._aravis.get_device_id(i) for i in range(self._aravis.get_n_devices())]
        if not names or (self._id is None and len(names) > 1):
            raise CameraError(f"{len(names)} cameras ({', '.join(names)}): give rig.devices.camera.camera_id")
        try:
            self._camera = self._aravis.Camera.new(self._id or names[0])
            self._set_up()
        except Exception as error:
            # The library's errors are GLib.Error, which is known only once it is loaded.
            raise CameraError(f"camera {self._id or '(any)'}: {_words(error)} (here: {', '.join(names)})") from error

    def set_exposure(self, exposure_s: float) -> float | None:
        """In microseconds, read back."""
        self._do("set_exposure_time", exposure_s * 1e6)
        return self.read_exposure()

    def read_exposure(self) -> float | None:
        """As the camera says."""
        return float(self._do("get_exposure_time")) / 1e6

    def snap(self, name: str) -> RawFrame:
        """The first whole frame of a short acquisition."""
        self._begin()
        try:
            frame = self._pop(ONE_FRAME_S)
            while frame is not None and frame.fault is not None:
                frame = self._pop(ONE_FRAME_S)
        finally:
            self._end()
        if frame is None:
            raise CameraError(f"{name}: no whole frame from the camera in {ONE_FRAME_S:g} s")
        return frame

    def start(self, name: str, rate_hz: float) -> None:
        """Frames from now on."""
        with suppress(Exception):  # a few cameras have no rate to set: then theirs is what comes
            self._camera.set_frame_rate(rate_hz)
        rate = float(self._do("get_frame_rate"))
        if abs(rate / rate_hz - 1) > 0.02:
            raise CameraError(f"{name}: the camera takes {rate:g} frames a second, {rate_hz:g} were asked for")
        self._begin()

    def poll(self) -> Sequence[RawFrame]:
        """Buffers that are ready."""
        frames = []
        while self._stream is not None and (frame := self._pop(0.0)) is not None:
            frames.append(frame)
        if self._lost:
            raise CameraError("the camera is no longer there")
        return frames

    def read_clock(self) -> ClockReading | None:
        """By arrivals instead: few cameras latch their clock on request."""
        return None

    def stop(self) -> Sequence[RawFrame]:
        """The last buffers, and the end."""
        frames = list(self.poll())
        self._end()
        return frames

    def close(self) -> None:
        """Let go of it."""
        with suppress(Exception):
            self._end()
        self._camera = self._stream = None

    def _set_up(self) -> None:
        camera = self._camera
        device = camera.get_device()
        # A trigger set by another program outlives that program.
        for feature, value in (
            ("TriggerMode", "Off"),
            ("ExposureAuto", "Off"),
            ("GainAuto", "Off"),
            ("BalanceWhiteAuto", "Off"),
        ):
            with suppress(Exception):
                device.set_string_feature_value(feature, value)
        camera.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
        if self._format is not None:
            camera.set_pixel_format_from_string(self._format)
        region = camera.get_region()
        self._identity = {
            "vendor": camera.get_vendor_name(),
            "model": camera.get_model_name(),
            "serial": camera.get_device_serial_number() or "",
            "format": camera.get_pixel_format_as_string(),
            "region": "{}x{}+{}+{}".format(*(region[i] for i in (2, 3, 0, 1))),
        }
        low, high = camera.get_exposure_time_bounds()
        self._bounds_s = (low / 1e6, high / 1e6)
        self._lost = False

        def lost(_device: Any) -> None:
            self._lost = True

        device.connect("control-lost", lost)

    def _begin(self) -> None:
        self._stream = self._do("create_stream", None, None)
        payload = self._do("get_payload")
        for _ in range(BUFFERS):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(payload))
        self._exposure_s = self.read_exposure() or 0.0
        self._do("start_acquisition")

    def _end(self) -> None:
        if self._stream is not None:
            self._stream = None
            self._do("stop_acquisition")

    def _pop(self, wait_s: float) -> RawFrame | None:
        buffer = self._stream.timeout_pop_buffer(int(wait_s * 1e6)) if wait_s > 0 else self._stream.try_pop_buffer()
        if buffer is None:
            return None
        # The library marks arrivals by the wall clock; what counts is how long ago that was.
        age_s = time.time() - buffer.get_system_timestamp() / 1e9
        arrived_s = self._clock.now() - (age_s if 0 <= age_s < 5 else 0.0)
        status = buffer.get_status()
        good = status == self._aravis.BufferStatus.SUCCESS
        pixels, largest, fault = None, 255, None if good else str(status.value_nick)
        if good:
            try:
                pixels, largest = self._pixels(buffer)
            except (ValueError, CameraError) as error:
                fault = str(error)
        frame = RawFrame(
            pixels=pixels,
            largest=largest,
            sequence=int(buffer.get_frame_id()),
            device_time_s=buffer.get_timestamp() / 1e9 + self._exposure_s / 2,
            host_time_s=arrived_s,
            fault=fault,
        )
        self._stream.push_buffer(buffer)
        return frame

    def _pixels(self, buffer: Any) -> tuple[np.ndarray, int]:
        name = self._identity["format"]
        width, height = buffer.get_image_width(), buffer.get_image_height()
        return unpack(bytes(buffer.get_data()), name, width, height)

    def _do(self, method: str, *arguments: Any) -> Any:
        if self._camera is None:
            raise CameraError("camera: not connected")
        try:
            return getattr(self._camera, method)(*arguments)
        except Exception as error:
            raise CameraError(f"camera: {method}: {_words(error)}") from error


def unpack(data: bytes, pixel_format: str, width: int, height: int) -> tuple[np.ndarray, int]:
    """Pixels of a GenICam buffer.

    Args:
        data: Of the buffer.
        pixel_format: Mono8 to Mono16, BayerRG8 to BayerBG16, RGB8; 10 to 14 bits unpacked, in 16.
        width: In pixels.
        height: In pixels.

    Returns:
        (height, width), or (height, width, 3), of a Bayer mosaic half of each; and the code of full scale.

    Raises:
        CameraError: a format that is not known, or a buffer of another size.
    """
    family = next(
        (f for f in ("Mono", "BayerRG", "BayerGR", "BayerGB", "BayerBG", "RGB") if pixel_format.startswith(f)), ""
    )
    bits = BITS.get(pixel_format.removeprefix(family)) if family else None
    if bits is None:
        raise CameraError(f"pixel format {pixel_format}: expected Mono, Bayer or RGB of 8 to 16 bits, not packed")
    kind = np.dtype(np.uint8) if bits == 8 else np.dtype("<u2")
    samples = width * height * (3 if family == "RGB" else 1)
    if len(data) != samples * kind.itemsize:
        raise CameraError(
            f"a buffer of {len(data)} bytes; {width}x{height} in {pixel_format} has {samples * kind.itemsize}"
        )
    pixels = np.frombuffer(data, dtype=kind).astype(np.uint8 if bits == 8 else np.uint16)
    largest = 2**bits - 1
    if family == "RGB":
        return pixels.reshape(height, width, 3), largest
    pixels = pixels.reshape(height, width)
    if family == "Mono":
        return pixels, largest
    whole = pixels[: height // 2 * 2, : width // 2 * 2]
    four = [whole[0::2, 0::2], whole[0::2, 1::2], whole[1::2, 0::2], whole[1::2, 1::2]]
    red, green, other, blue = (four[i] for i in BAYER[family.removeprefix("Bayer")])
    mosaic = np.stack([red, (green.astype(np.uint32) + other + 1) // 2, blue], axis=-1)
    return mosaic.astype(pixels.dtype), largest


def _library() -> Any:
    try:
        import gi  # pyright: ignore[reportMissingImports]

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]
    except (ImportError, ValueError):
        raise MissingExtraError(
            "the camera needs Aravis: pip install 'reflectsep[aravis]', and the library itself with its "
            "introspection data (on Debian: gir1.2-aravis-0.8)"
        ) from None
    return Aravis


def _words(error: Exception) -> str:
    return " ".join(str(getattr(error, "message", error)).split())
