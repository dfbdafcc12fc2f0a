"""The capture job, whole: the same driver code on simulated devices, and what becomes of it in a fit."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from reflectsep.bench import SynthScene, capture
from reflectsep.config import CaptureJob, ObjectSettings, RigSettings, SimulateJob, SweepSettings
from reflectsep.errors import ReflectsepError, SettingsError
from reflectsep.io.capture import load_capture, verify
from reflectsep.io.pictures import read_picture
from reflectsep.pipeline import fit
from reflectsep.progress import silent
from reflectsep.rig.simulated import View
from reflectsep.simulation import write


def job(out, *, size=24, **changes):
    rig = RigSettings(**{"name": "simulated", "bits": 12, "dark_level": 0.01, **changes})
    return CaptureJob(object=ObjectSettings(name="wax", size_px=size), rig=rig, out=str(out))


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    out = tmp_path_factory.mktemp("bench") / "wax"
    capture(job(out), silent)
    return out


def test_capture_is_one_that_can_be_fitted_and_its_files_are_as_recorded(taken):
    read = load_capture(taken)
    assert verify(read) == []
    assert [len(read.images), len(read.sweeps)] == [8, 3]
    assert (taken / "preview.png").is_file()


def test_frames_sum_to_the_full_picture_times_the_frames_in_which_a_point_is_lit(taken):
    read = load_capture(taken)
    dark = read_picture(taken / "dark.exr")[0].double()
    for sweep in read.sweeps:
        frames = [read_picture(taken / sweep.frames.format(i))[0].double() for i in range(sweep.count)]
        total = sum(frame - dark for frame in frames)
        full = read_picture(taken / f"full/{sweep.light}.png")[0].double() - dark
        # A slit of 4 px in steps of 2 px lights every point twice; 12 bits round each frame.
        assert (total - 2 * full).abs().max() < sweep.count / 4095


def test_slab_of_a_scene_moves_with_the_stage(tmp_path):
    scene = SynthScene(job(tmp_path))
    low, high = scene.extent_mm("L1", "x")
    places = []
    for at in np.linspace(low, high, 12)[3:9]:
        direct = scene.render(View(light="L1", exposure_s=0.01, slit=("x", float(at)))).astype(float)
        places.append((direct.sum(0) * np.arange(24)).sum() / direct.sum())
    assert (np.diff(places) > 0.4).all()


def test_dry_run_says_what_it_takes_and_touches_nothing(tmp_path):
    text = capture(dataclasses.replace(job(tmp_path / "x"), dry_run=True), silent)
    for words in ("full-L6", "sweep-L3-x", "dark-slab", "0.124 to 50 mm/s", "about", "pictures, at most", "GB free"):
        assert words in text
    assert list(tmp_path.iterdir()) == []


def test_finished_session_has_nothing_to_do(taken):
    before = {path: path.stat().st_mtime_ns for path in taken.rglob("*")}
    assert "nothing to do" in capture(dataclasses.replace(job(taken), resume=True), silent)
    assert {path: path.stat().st_mtime_ns for path in taken.rglob("*")} == before


def test_orthogonal_sweeps_go_along_y(tmp_path):
    capture(job(tmp_path / "c", orthogonal=True, sweeps=1, lights=3), silent)
    assert [(s.light, s.direction) for s in load_capture(tmp_path / "c").sweeps] == [("L1", "x"), ("L1", "y")]


def test_stepped_sweep_has_the_positions_that_the_stage_reported(tmp_path):
    settings = SweepSettings(motion="stepped", rate_hz=10.0, speed_mm_s=10.0)
    capture(job(tmp_path / "c", sweeps=1, lights=3, sweep=settings), silent)
    (sweep,) = load_capture(tmp_path / "c").sweeps
    # One millimetre each, in whole steps of 4 um as the board has them.
    assert np.diff(sweep.position_mm) == pytest.approx(1.0, abs=0.0041)
    assert np.array(sweep.position_mm) * 250 == pytest.approx(np.rint(np.array(sweep.position_mm) * 250), abs=1e-6)


def test_names_of_lights_cannot_lead_out_of_the_session(tmp_path):
    lights = {name: {"direction": [0.1 * k, 0.2, 1.0]} for k, name in enumerate(("../../x", "b", "c"))}
    (tmp_path / "lights.json").write_text(json.dumps({"lights": lights}))
    with pytest.raises(ReflectsepError, match=r"light '\.\./\.\./x'"):
        capture(job(tmp_path / "s" / "c", lights_file=str(tmp_path / "lights.json")), silent)
    assert not (tmp_path / "x").exists()


def test_bench_without_an_extent_says_what_it_needs(tmp_path):
    made = job(tmp_path / "c")
    made.rig.devices.stage = {"_target_": "grbl", "port": "p", "axes": {}}
    with pytest.raises(SettingsError, match=r"stage.axes: none; expected x"):
        capture(made, silent)


def relative(found, wanted, mask):
    return float(((found - wanted)[..., mask] ** 2).mean().sqrt() / (wanted[..., mask] ** 2).mean().sqrt())


@pytest.mark.slow
def test_components_of_a_captured_wax_are_those_of_the_ideal_capture(tmp_path):
    made = job(tmp_path / "taken", size=96, read_noise=0.0005, shot_noise=0.002)
    capture(made, silent)
    write(SimulateJob(object=made.object, rig=made.rig, out=str(tmp_path / "ideal")), silent)
    found, wanted = (fit(load_capture(tmp_path / name)) for name in ("taken", "ideal"))
    assert torch.equal(found.mask, wanted.mask)
    scattering = relative(found.scattering, wanted.scattering, wanted.mask)
    specular = relative(found.specular, wanted.specular, wanted.mask)
    print(f"scattering {100 * scattering:.1f} %, specular {100 * specular:.1f} %")
    assert scattering < 0.05
    assert specular < 0.05


def test_backend_settings_on_the_command_line_may_be_new_and_are_checked_by_the_backend(tmp_path, capsys):
    from reflectsep.cli import main

    words = ["capture", "object=wax", "object.size_px=32", f"out={tmp_path / 'c'}", "dry_run=true"]
    assert main([*words, "rig.devices.camera.sequence_first=7"]) == 0
    assert main([*words, "rig.devices.camera.redout_s=0.1"]) == 2
    said = capsys.readouterr().err
    assert "rig.devices.camera.redout_s: no such setting of simulated; did you mean readout_s?" in said


def test_backend_given_whole_on_the_command_line_takes_the_place_of_the_one_in_the_file(tmp_path, capsys):
    from reflectsep.cli import main

    words = ["capture", "object=wax", "rig=bench", f"out={tmp_path / 'c'}", "dry_run=true"]
    assert main([*words, "rig.devices.lights={_target_: command, on: [switch, '{light}'], off: [switch, none]}"]) == 0
    assert main([*words, "rig.devices.lights={_target_: command, on: switch, off: [switch, none]}"]) == 2
    said = capsys.readouterr().err
    assert "rig.devices.lights.on='switch': expected a list of arguments" in said
