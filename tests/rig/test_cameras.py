"""The backends of cameras, each against what can be had of the real thing."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time

import imagecodecs
import numpy as np
import pytest

from reflectsep.errors import CameraError, MissingExtraError, ReflectsepError, SettingsError
from reflectsep.rig.backends import BACKENDS, build
from reflectsep.rig.camera_aravis import AravisCamera, unpack
from reflectsep.rig.camera_command import CommandCamera
from reflectsep.rig.camera_folder import FolderCamera
from reflectsep.rig.camera_gphoto2 import Gphoto2Camera, shutter_time
from reflectsep.rig.camera_video import VideoCamera
from reflectsep.rig.clock import HostClock, VirtualClock
from reflectsep.rig.devices import Devices
from reflectsep.rig.exposure import AIM, brightness, find_exposure
from reflectsep.rig.frames import Stored, row
from reflectsep.rig.marks import Switched, clock_of_marks

from .conftest import complete
from .recorder import Recorder

PYTHON = sys.executable


def png(value, size=(12, 16)):
    return imagecodecs.png_encode(np.full(size, value, np.uint8))


# External command.


def command(tmp_path, body, **settings):
    program = tmp_path / "camera.py"
    program.write_text(body)
    return CommandCamera(take=[PYTHON, str(program), "{file}", "{exposure_s}", "{name}"], **settings)


def test_command_writes_the_file_and_gets_the_exposure_as_one_argument(tmp_path):
    picture = png(77)
    (tmp_path / "p.png").write_bytes(picture)
    body = "import shutil, sys\nassert sys.argv[2:] == ['0.02', 'a; rm -rf b']\n"
    body += f"shutil.copy({str(tmp_path / 'p.png')!r}, sys.argv[1])"
    camera = command(tmp_path, body)
    camera.connect()
    assert camera.set_exposure(0.02) is None
    frame = camera.snap("a; rm -rf b")
    assert frame.file is not None
    assert frame.file.read_bytes() == picture
    camera.close()
    assert not frame.file.exists()


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("raise SystemExit('no battery')", "failed with exit code 1: no battery"),
        ("import time; time.sleep(60)", "not done after 0.5 s; it was killed"),
        ("", "succeeded, but wrote no file"),
    ],
)
def test_command_that_fails_hangs_or_writes_nothing(body, words, tmp_path):
    camera = command(tmp_path, body, timeout_s=0.5 if "sleep" in body else 20.0)
    camera.connect()
    began = time.monotonic()
    with pytest.raises(CameraError, match=words):
        camera.snap("x")
    assert time.monotonic() - began < 15
    camera.close()


def test_command_is_a_list_and_never_a_string():
    with pytest.raises(SettingsError, match="expected a list of arguments"):
        CommandCamera(take="shoot {file}")  # type: ignore[arg-type]


def test_command_that_is_not_there():
    camera = CommandCamera(take=["/no/such/program"])
    camera.connect()
    with pytest.raises(CameraError, match="cannot be run: No such file"):
        camera.snap("x")
    camera.close()


# Watched folder.


def test_folder_takes_whole_files_only_and_tells_their_order(tmp_path, record_fault):
    clock = VirtualClock()
    (tmp_path / "old-0001.png").write_bytes(png(1))
    camera = FolderCamera(folder=str(tmp_path), clock=clock)
    camera.connect()
    camera.start("s", 10.0)
    data = png(50)
    (tmp_path / "shot-0003.png").write_bytes(data)
    (tmp_path / "shot-0002.png").write_bytes(data[: len(data) // 2])
    (tmp_path / "notes.txt").write_text("no picture")
    assert camera.poll() == []
    clock.sleep(0.3)
    assert [f.sequence for f in camera.poll()] == [3]
    (tmp_path / "shot-0002.png").write_bytes(data)
    camera.poll()
    clock.sleep(0.3)
    (frame,) = camera.poll()
    assert frame.sequence == 2
    assert camera.stop() == []
    record_fault("watched folder: half-written, out of order", "nothing", "goes on", "whole files only", "not needed")


def test_folder_says_what_it_waited_for(tmp_path):
    camera = FolderCamera(folder=str(tmp_path), timeout_s=1.0, clock=VirtualClock())
    camera.connect()
    with pytest.raises(CameraError, match="no picture for L1 in 1 s: nothing new came"):
        camera.snap("L1")
    (tmp_path / "a1.png").write_bytes(png(3)[:30])
    with pytest.raises(CameraError, match=r"a1\.png is there, but not whole"):
        camera.snap("L1")


def test_frames_that_came_out_of_order_are_put_in_order_with_gaps():
    stored = [
        Stored(file=f"f{n}", sequence=n, device_time_s=None, host_time_s=t, fault=None)  # type: ignore[arg-type]
        for n, t in ((4, 0.4), (6, 0.6), (5, 0.7), (8, 0.8))
    ]
    slots = row(stored, first=0, last=None, period_s=0.1)
    assert [slot.file for slot in slots] == ["f4", "f5", "f6", None, "f8"]
    assert np.diff([slot.time_s for slot in slots]) == pytest.approx(0.1)


# Video.


def test_video_is_tied_to_the_motion_by_the_light_going_on_and_off(rig_in, tmp_path):
    pytest.importorskip("av")
    rig = rig_in()
    eye = rig.devices.camera
    camera = Recorder(eye, path=str(tmp_path / "{name}.mkv"), clock=rig.bench.clock, settle_s=0.1)
    rig.devices = Devices(stage=rig.devices.stage, camera=camera, lights=rig.devices.lights, names={})
    truth, render = {}, rig.bench.scene.render

    def remembered(view):
        pixels = render(view)
        truth[pixels.tobytes()] = view.slit
        return pixels

    rig.bench.scene.render = remembered
    rig.run()
    sweep = complete(rig.folder).sweeps[0]
    assert sweep.exposure_s is None
    # The light's switching is known to within half a frame's way at each end, 0.5 mm here.
    from reflectsep.io.pictures import read_picture

    errors = []
    for index, position in enumerate(sweep.position_mm or ()):
        pixels = (255 * read_picture(rig.folder / sweep.frames.format(index))[0][0].numpy()).round().astype(np.uint8)
        errors.append(position - truth[pixels.tobytes()][1])
    assert len(errors) == 20
    assert np.abs(errors).max() <= 0.5
    stated = json.loads((rig.folder / "session.json").read_text())["steps"]["sweep-L1-x"]["position_sd_mm"]
    assert 0.1 < max(stated) < 0.3  # 1 mm / sqrt(12), of two switchings


def test_video_that_ends_early_or_is_none(tmp_path):
    pytest.importorskip("av")
    rng = np.random.default_rng(0)
    path = tmp_path / "s.mkv"
    Recorder.write(path, [(0.1 * k, rng.integers(0, 255, (12, 16)).astype(np.uint8)) for k in range(20)])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    camera = VideoCamera(path=str(tmp_path / "{name}.mkv"), clock=VirtualClock(), timeout_s=5.0)
    camera.start("s", 10.0)
    frames = camera.stop()
    assert 0 < len(frames) < 20
    (tmp_path / "t.mkv").write_bytes(b"not a video")
    with pytest.raises(CameraError, match=r"t\.mkv"):
        camera.snap("t")
    with pytest.raises(CameraError, match=r"u\.mkv: no whole video in 5 s"):
        camera.snap("u")


def test_clock_of_marks_finds_the_offset_and_refuses_frames_that_show_nothing():
    times = np.arange(0, 6, 0.04)
    levels = np.where((times > 1.0) & (times < 5.0), 50.0, 2.0) + 0.1 * np.sin(37 * times)
    line = clock_of_marks(times, levels, Switched(on_s=101.0, off_s=105.0))
    assert line.at(np.array([3.0]))[0] == pytest.approx(103.0, abs=0.04)
    assert line.value_sd < 0.04
    with pytest.raises(CameraError, match="do not show the light going on"):
        clock_of_marks(times, np.full(len(times), 2.0), Switched(on_s=101.0, off_s=105.0))
    with pytest.raises(CameraError, match=r"was on for 8\.000 s, but for 3\.9"):
        clock_of_marks(times, levels, Switched(on_s=101.0, off_s=109.0))


# gphoto2, against the virtual camera of its wheel.


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("1/30", 1 / 30), ("0.0100s", 0.01), ("2", 2.0), ("1.3", 1.3), ("bulb", None), ("1/0", None), ("", None)],
)
def test_shutter_times_as_cameras_write_them(text, seconds):
    assert shutter_time(text) == seconds


@pytest.mark.skipif(importlib.util.find_spec("gphoto2") is None, reason="only with the extra `gphoto2`")
def test_gphoto2_takes_fetches_and_reads_back(tmp_path):
    (tmp_path / "DCIM").mkdir()
    (tmp_path / "DCIM" / "a.jpg").write_bytes(imagecodecs.jpeg8_encode(np.full((48, 64, 3), 100, np.uint8)))
    program = """
import sys
from reflectsep.rig.camera_gphoto2 import Gphoto2Camera
from reflectsep.errors import CameraError
from reflectsep.io.pictures import read_picture
camera = Gphoto2Camera()
camera.connect()
assert camera.identity["model"] == "Nikon DSC D750", camera.identity
assert camera.limits.exposure_s == (0.0001, 1.0), camera.limits
assert not camera.limits.streams
# 1/30 s is none of its choices: the nearest is 1/20, and that is what is said.
assert camera.set_exposure(1 / 30) in (0.02, 0.05)
assert camera.set_exposure(0.01) == camera.read_exposure() == 0.01
frame = camera.snap("L1")
assert read_picture(frame.file)[0].shape == (3, 48, 64)
camera.close()
assert not frame.file.exists()
try:
    Gphoto2Camera(settings={"f-number": "f/99"}).connect()
except CameraError as error:
    assert "f-number=f/99: the camera has f/2.8, " in str(error)
else:
    raise SystemExit("an impossible aperture was taken")
"""
    environment = os.environ | {"VCAMERADIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run([PYTHON, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_extras_that_are_missing_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    monkeypatch.setitem(sys.modules, "gi", None)
    with pytest.raises(MissingExtraError, match=r"reflectsep\[gphoto2\]"):
        Gphoto2Camera().connect()
    with pytest.raises(MissingExtraError, match=r"reflectsep\[aravis\]"):
        AravisCamera().connect()


# Aravis, against its own fake camera on the loopback interface.


@pytest.fixture
def fake_camera():
    program = shutil.which("arv-fake-gv-camera-0.8")
    if program is None or importlib.util.find_spec("gi") is None:
        pytest.skip("needs Aravis' fake camera and its introspection data")
    with subprocess.Popen(
        [program, "-i", "127.0.0.1"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        time.sleep(1.0)
        yield process
        process.kill()


ARAVIS = """
import time
import numpy as np
from reflectsep.rig.camera_aravis import AravisCamera
from reflectsep.rig.sync import fit_clock
camera = AravisCamera(pixel_format={format!r})
camera.connect()
assert camera.identity["format"] == {format!r}
assert camera.set_exposure(0.005) == 0.005
assert camera.snap("L1").pixels.shape == {shape}
camera.start("s", 10.0)
frames, end = [], time.monotonic() + 4
while time.monotonic() < end:
    frames += camera.poll()
    time.sleep(0.004)
frames += camera.stop()
whole = [f for f in frames if f.fault is None]
assert len(whole) >= 25, [f.fault for f in frames]
line = fit_clock(whole, [], 0.0)
period = np.diff(line.at(np.array([f.device_time_s for f in whole]))) / np.diff([f.sequence for f in whole])
# The fake camera's first frame comes at once, the others on its grid; it is late at times.
assert abs(np.median(period) - 0.1) < 0.001, period
assert (np.abs(period - 0.1) < 0.01).mean() > 0.85, period
camera.close()
camera.close()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pixel_format", "shape"), [("Mono8", (512, 512)), ("Mono16", (512, 512)), ("BayerRG8", (256, 256, 3))]
)
def test_aravis_streams_with_times_and_status(pixel_format, shape, fake_camera):
    program = ARAVIS.format(format=pixel_format, shape=shape)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run([PYTHON, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_buffers_of_every_depth_and_mosaic():
    codes = np.arange(16, dtype=np.uint16).reshape(4, 4)
    for depth in (10, 12, 14, 16):
        pixels, largest = unpack(codes.tobytes(), f"Mono{depth}", 4, 4)
        assert (pixels == codes).all()
        assert largest == 2**depth - 1
    mosaic = np.array([[1, 20], [30, 4]], np.uint8)
    expected = {"RG": (1, 25, 4), "BG": (4, 25, 1), "GR": (20, 3, 30), "GB": (30, 3, 20)}
    for order, colours in expected.items():
        pixels, _ = unpack(mosaic.tobytes(), f"Bayer{order}8", 2, 2)
        assert tuple(pixels[0, 0]) == colours
    with pytest.raises(CameraError, match="a buffer of 3 bytes; 2x2 in Mono8 has 4"):
        unpack(b"abc", "Mono8", 2, 2)
    with pytest.raises(CameraError, match="Mono12Packed: expected"):
        unpack(b"abc", "Mono12Packed", 1, 2)


# Building, and exposure.


@pytest.mark.parametrize(
    ("kind", "config", "words"),
    [
        ("stage", {}, r"rig.devices.stage._target_=None: no such backend"),
        ("stage", {"_target_": "grlb"}, "did you mean grbl"),
        ("camera", {"_target_": "subprocess.Popen"}, "no such backend"),
        ("camera", {"_target_": "folder"}, "rig.devices.camera.folder: folder needs it"),
        ("camera", {"_target_": "folder", "foldr": "x"}, r"no such setting of folder; did you mean folder\?"),
        (
            "lights",
            {"_target_": "serial", "port": "p", "off": False},
            r"off=False: expected text \(YAML reads",
        ),
        ("lights", {"_target_": "serial", "port": "p", "baud": "fast"}, r"baud='fast': expected a whole number"),
        ("stage", {"_target_": "grbl", "port": 3, "axes": {}}, r"stage\.port=3: expected text"),
        ("camera", {"_target_": "folder", "folder": "f", "timeout_s": "long"}, "timeout_s='long': expected a number"),
        ("camera", {"_target_": "gphoto2", "delete": "no"}, "delete='no': expected true or false"),
        ("lights", {"_target_": "command", "on": "echo", "off": ["x"]}, "expected a list of arguments"),
        ("lights", {"_target_": "simulated"}, "needs a simulated bench"),
        ("stage", {"_target_": "grbl", "port": "p", "axes": {"x": {"letter": "X"}}}, "axes.x.travel_mm: missing"),
    ],
)
def test_configurations_that_cannot_be_built(kind, config, words):
    with pytest.raises(ReflectsepError, match=words):
        build(kind, config, clock=HostClock(), bench=None)


def test_backends_of_the_package_s_rigs_can_be_built():
    from reflectsep.cli.overrides import hydra_ready, settings_of

    with hydra_ready():
        for rig in ("bench", "bench_dslr"):
            devices = settings_of("capture", ["object=wax", f"rig={rig}"]).rig.devices
            for kind in BACKENDS:
                build(kind, getattr(devices, kind), clock=HostClock())


def test_settings_of_a_dslr_can_be_configured():
    camera = build("camera", {"_target_": "gphoto2", "settings": {"iso": "100"}}, clock=HostClock())
    assert camera._settings == {"iso": "100"}


def test_every_backend_is_there():
    for kind, names in BACKENDS.items():
        for name, place in names.items():
            module, attribute = place.split(":")
            assert hasattr(importlib.import_module(module), attribute), (kind, name)


@pytest.mark.parametrize("brightest", [0.001, 0.02, 0.4, 3.0, 40.0])
def test_exposure_is_found_from_any_start(brightest):
    """A scene whose brightest part reaches `brightest` of full scale at 10 ms."""
    takes = []

    def take(exposure_s):
        takes.append(exposure_s)
        return exposure_s, np.clip(np.linspace(0, brightest * exposure_s / 0.01, 10_000), 0, 1)

    found = find_exposure(take, 0.01, (1e-5, 100.0))
    high = brightness(take(found)[1]).high
    assert 0.5 <= high <= 0.9
    assert abs(high / AIM - 1) < 0.4
    assert len(takes) <= 9


def test_exposure_that_nothing_can_fit_says_so():
    with pytest.raises(CameraError, match="saturate even at the shortest exposure"):
        find_exposure(lambda s: (s, np.ones(100)), 0.01, (0.001, 1.0))
