"""A camera that moves between exposures."""

import json
import math
from dataclasses import replace

import pytest
import torch

from reflectsep.errors import SettingsError
from reflectsep.io.capture import load_capture
from reflectsep.io.exr import read_channels
from reflectsep.io.frames import open_sweep
from reflectsep.io.pictures import read_picture
from reflectsep.synth.drift import Drift, binned, moved, pose
from reflectsep.synth.presets import make_object
from reflectsep.synth.rig import SimulatedCamera, make_rig
from reflectsep.synth.simulate import simulate

EYE = torch.eye(3, dtype=torch.float64)


def test_moved_picture_is_the_function_elsewhere():
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(50.0), indexing="ij")
    x, y = x.double(), y.double()

    def scene(u, v):
        return torch.sin(u / 7) * torch.cos(v / 9) + 0.01 * u

    at = pose(Drift(across_px=1.3, across_deg=2.0), "full/L2", seed=4, size=(50, 40)).matrix
    found = moved(scene(x, y)[None], at)[0]
    back = torch.linalg.inv(at)
    u = back[0, 0] * x + back[0, 1] * y + back[0, 2]
    v = back[1, 0] * x + back[1, 1] * y + back[1, 2]
    inner = (slice(8, -8), slice(8, -8))
    assert float((found - scene(u, v))[inner].abs().max()) < 1e-5


def test_still_camera_leaves_the_picture_alone():
    picture = torch.rand(1, 9, 9)
    assert moved(picture, EYE) is picture


def test_beyond_the_edge_it_is_black():
    shift = EYE.clone()
    shift[0, 2] = 12.0
    assert not moved(torch.ones(1, 20, 20), shift)[0, :, :9].any()


@pytest.mark.parametrize("name", ["full/L2", "full/L5"])
def test_shift_and_rotation_are_as_asked(name):
    at = pose(Drift(across_px=2.0, across_deg=0.7), name, seed=1, size=(65, 65)).matrix
    middle = torch.tensor([32.0, 32.0, 1.0], dtype=torch.float64)
    assert float((at @ middle - middle).norm()) == pytest.approx(2.0)
    assert abs(math.degrees(math.atan2(float(at[1, 0]), float(at[0, 0])))) == pytest.approx(0.7)


def test_sweep_moves_with_its_full_picture_and_then_on_its_own():
    drift = Drift(between_px=1.0, across_px=2.0, within_px=3.0)
    still = pose(drift, "full/L2", seed=1, size=(9, 9))
    sweep = pose(drift, "sweep/L2", seed=1, size=(9, 9), still=still)
    own = sweep.matrix @ torch.linalg.inv(still.matrix)
    assert float(own[:2, 2].norm()) == pytest.approx(1.0)
    assert math.hypot(*sweep.velocity) == pytest.approx(1.5)
    torch.testing.assert_close(sweep.at(1.0)[:2, 2] - sweep.at(-1.0)[:2, 2], 2 * torch.tensor(sweep.velocity).double())


def test_negative_drift_is_refused():
    with pytest.raises(SettingsError, match="none below 0"):
        Drift(within_px=-1.0)


def test_capture_holds_moved_pictures_and_their_truth(tmp_path):
    obj = make_object("wax", size=24)
    rig = make_rig("r", slab_px=(12.0, 6.0), heldout=(0, 0), sweeps=(1, 0))
    simulate(obj, rig, tmp_path / "still", seed=0)
    drifting = replace(rig, drift=Drift(between_px=1.5, across_px=1.0, within_px=2.0))
    simulate(obj, drifting, tmp_path / "moved", seed=0)
    assert not (tmp_path / "still" / "truth" / "drift.json").exists()
    truth = json.loads((tmp_path / "moved" / "truth" / "drift.json").read_text())
    assert torch.equal(torch.tensor(truth["full/L1"]["matrix"]).double(), EYE)
    for name in ("full/L2", "full/L6"):
        still, _ = read_picture(tmp_path / "still" / f"{name}.exr")
        found, _ = read_picture(tmp_path / "moved" / f"{name}.exr")
        matrix = torch.tensor(truth[name]["matrix"], dtype=torch.float64)
        torch.testing.assert_close(found, moved(still, matrix), rtol=0, atol=1e-5)
    captures = [load_capture(tmp_path / which) for which in ("still", "moved")]
    still, found = (list(open_sweep(capture, capture.sweeps[0])) for capture in captures)
    at = torch.tensor(truth["sweep/L1"]["matrix"], dtype=torch.float64)
    at[:2, 2] += torch.tensor(truth["sweep/L1"]["velocity_px"], dtype=torch.float64)  # the last frame
    torch.testing.assert_close(found[-1].values, moved(still[-1].values, at), rtol=0, atol=1e-5)


def test_a_pixel_adds_up_its_patches_after_the_camera_moved():
    """A step of light half a pixel on: half its light in one pixel, and no ringing beside it."""
    fine = torch.zeros(1, 32, 32)
    fine[..., 16:] = 1.0
    shift = EYE.clone()
    shift[0, 2] = 0.5
    row = moved(fine, shift, 2)[0, 8]
    torch.testing.assert_close(row, torch.tensor([0.0] * 8 + [0.5] + [1.0] * 7))
    alone = moved(binned(fine, 2), shift)[0, 8]
    assert float(alone[:8].abs().max()) > 0.01


def test_a_finer_rendering_is_the_same_capture_in_the_cameras_pixels(tmp_path):
    """Two patches a pixel: size, slab, distances and depth stay in pixels, and the sweep still sums to the picture."""
    for fine in (1, 2):
        camera = SimulatedCamera(oversample=fine)
        rig = make_rig("r", sweeps=(3, 0), slab_px=(4.0, 2.0), camera=camera)
        simulate(make_object("wax", size=32 * fine), rig, tmp_path / str(fine), seed=0)
    coarse, found = (load_capture(tmp_path / str(fine)) for fine in (1, 2))
    assert found.size == coarse.size == (32, 32)
    full = read_picture(found.folder / found.full("L1").file)[0]
    frames = [frame.values for frame in open_sweep(found, found.sweeps[0])]
    torch.testing.assert_close(sum(frames), 2.0 * full, rtol=1e-4, atol=1e-5)
    assert abs(len(frames) - coarse.sweeps[0].count) <= 1
    for file, names in (
        ("truth/L1.exr", ("scattering_beyond_1px.Y", "scattering_beyond_2px.Y", "specular.Y")),
        ("truth/geometry.exr", ("depth", "normal.Z")),
    ):
        a, b = (read_channels(capture.folder / file) for capture in (coarse, found))
        for name in names:
            # The coarse rendering's own error; light beyond half the distance would be twice as much.
            assert abs(a[name] - b[name]).mean() < 0.12 * abs(a[name]).mean()
