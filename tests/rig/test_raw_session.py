"""A camera that gives raw files: they are kept as they are, and the capture is one that can be fitted."""

import numpy as np
import pytest

from reflectsep.bench import SIMULATED, SynthScene, plan_of
from reflectsep.config import CaptureJob, ObjectSettings, RigSettings, SweepSettings
from reflectsep.io.capture import load_capture, verify
from reflectsep.io.pictures import read_picture
from reflectsep.pipeline import fit
from reflectsep.rig.backends import build_devices
from reflectsep.rig.board import Board
from reflectsep.rig.clock import VirtualClock
from reflectsep.rig.devices import CameraLimits, Devices, RawFrame
from reflectsep.rig.finish import finish
from reflectsep.rig.runner import Runner, RunOptions
from reflectsep.rig.session import Session
from reflectsep.rig.simulated import Bench, SimulatedCamera
from reflectsep.rig.still import StillCamera

from ..io.test_raw import WHITE, write_dng  # noqa: TID252


class RawCamera(StillCamera):
    """What a simulated colour camera sees, as the mosaic of a sensor of twice its size in a raw file."""

    def __init__(self, eye, folder):
        self._eye, self._folder, self._count = eye, folder, 0
        self.connect, self.close, self.identity = eye.connect, eye.close, eye.identity
        self.set_exposure, self.read_exposure = eye.set_exposure, eye.read_exposure
        self.limits = CameraLimits(exposure_s=(1e-5, 10.0), streams=False)

    def snap(self, name):
        frame = self._eye.snap(name)
        pixels = np.rint(frame.pixels * (WHITE / frame.largest)).astype(np.uint16)
        mosaic = np.repeat(np.repeat(pixels[..., 1], 2, 0), 2, 1)
        mosaic[0::2, 0::2], mosaic[1::2, 1::2] = pixels[..., 0], pixels[..., 2]
        self._count += 1
        path = self._folder / f"DSC_{self._count:04d}.dng"
        write_dng(path, mosaic)
        return RawFrame(pixels=None, file=path)


@pytest.mark.slow
def test_capture_of_raw_files_is_fitted_as_it_is(tmp_path):
    pytest.importorskip("rawpy")
    sweep = SweepSettings(motion="stepped", rate_hz=10.0, speed_mm_s=10.0)
    rig = RigSettings(name="simulated", bits=12, dark_level=0.01, sweep=sweep)
    job = CaptureJob(object=ObjectSettings(name="wax", size_px=20, channels=3), rig=rig, out=str(tmp_path / "capture"))
    scene, clock = SynthScene(job), VirtualClock()
    bench = Bench(scene=scene, clock=clock, board=Board({22: 1.0}), park_mm=sweep.park_mm)
    built = build_devices(SIMULATED, clock=clock, bench=bench)
    (tmp_path / "card").mkdir()
    camera = RawCamera(SimulatedCamera(bench=bench), tmp_path / "card")
    plan, session = plan_of(job, scene), Session(job.out)
    session.open(resume=False)
    devices = Devices(stage=built.stage, camera=camera, lights=built.lights)
    Runner(plan, devices, session, RunOptions(), clock=clock).run()
    finish(session, plan)
    session.close()

    capture = load_capture(job.out)
    assert verify(capture) == []
    assert {picture.file.rsplit(".")[-1] for picture in capture.images} == {"dng", "exr"}  # the dark ones are means
    values, _ = read_picture(capture.folder / "full/L1.dng")
    assert tuple(values.shape) == (3, 40, 40)
    separation = fit(capture)
    assert np.isfinite(separation.scattering[..., separation.mask].numpy()).all()
    assert separation.specular.shape == (3, 3, 40, 40)
