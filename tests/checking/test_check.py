"""The check and calibrate jobs on small captures."""

import dataclasses
import json
import shutil

import pytest
import torch

from reflectsep import jobs
from reflectsep.calibrate.chrome import Circle, disc, sphere_normals
from reflectsep.calibrate.exposure import response_of
from reflectsep.checking.check import check_capture
from reflectsep.checking.display import table
from reflectsep.checking.findings import graded
from reflectsep.cli import main
from reflectsep.config import CalibrateJob, CheckJob, ObjectSettings, RigSettings, SimulateJob
from reflectsep.errors import CaptureError, ResultError, SettingsError
from reflectsep.io.calibration import read_calibration
from reflectsep.io.capture import load_capture
from reflectsep.io.pictures import write_picture
from reflectsep.pipeline import with_calibration

RIG = {"slab_width_px": 8.0, "slab_step_px": 4.0, "heldout": 0, "bits": 12, "read_noise": 0.0005}


def simulated(folder, name="wax", size=40, **rig):
    item = ObjectSettings(name=name, preset=name, size_px=size)
    jobs.run_simulate(SimulateJob(object=item, rig=RigSettings(**{**RIG, **rig}), out=str(folder)))
    return folder


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("check") / "good")


def findings(folder):
    return {finding.subject: finding for finding in check_capture(load_capture(folder)).findings}


def test_a_good_capture_is_good(good):
    result = check_capture(load_capture(good))
    assert result.verdict == "good"
    subjects = [finding.subject for finding in result.findings]
    assert {"pictures", "saturation", "noise", "light geometry", "frames", "linearity", "alignment"} <= set(subjects)
    assert {f"sweep of L{k} along x" for k in (1, 2, 3)} <= set(subjects)


def test_clipped_pictures_are_said(tmp_path):
    found = findings(simulated(tmp_path / "c", headroom=0.5))["saturation"]
    assert found.verdict == "bad"
    assert "clipped at most" in found.value
    assert "bracket" in found.advice


def test_lost_frames_uneven_speed_and_missing_darks(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "c")
    document = json.loads((folder / "capture.json").read_text())
    sweep = document["sweeps"][0]
    sweep["sha256"][4] = None
    (folder / document["sweeps"][1]["frames"].format(3)).unlink()
    with pytest.raises(CaptureError, match="0003"):
        load_capture(folder) and document
    shutil.copy(good / document["sweeps"][1]["frames"].format(3), folder / document["sweeps"][1]["frames"].format(3))
    (folder / "capture.json").write_text(json.dumps(document))
    found = findings(folder)["frames"]
    assert found.verdict == "doubtful"
    assert found.numbers == {"L1 x": 1}


def test_frames_that_stood_still_are_no_constant_speed(good, tmp_path):
    folder = shutil.copytree(good, tmp_path / "c")
    document = json.loads((folder / "capture.json").read_text())
    sweep = document["sweeps"][0]
    frames = sweep["frames"]
    # The slab waits at every third frame of the middle: those are taken twice as long.
    order = [i for i in range(sweep["count"]) for _ in range(1 + (i % 3 == 0))]
    copies = [(folder / frames.format(i)).read_bytes() for i in order]
    for index, data in enumerate(copies):
        (folder / frames.format(index)).write_bytes(data)
    sweep["count"] = len(order)
    del sweep["sha256"]
    (folder / "capture.json").write_text(json.dumps(document))
    found = findings(folder)
    assert found["sweep of L1 along x"].verdict != "good"
    assert found["sweep of L2 along x"].verdict == "good"


def test_gamma_that_the_manifest_does_not_know(tmp_path):
    folder = simulated(tmp_path / "c", gamma=2.2, bits=None, read_noise=0.0)
    assert findings(folder)["linearity"].verdict == "good"
    document = json.loads((folder / "capture.json").read_text())
    (folder / "capture.json").write_text(json.dumps({**document, "encoding": "linear"}))
    found = findings(folder)["linearity"]
    assert found.verdict == "bad"
    assert 1 / found.numbers["n_d"] == pytest.approx(2.2, rel=0.02)
    assert "encoded with gamma 2.2" in found.advice


def test_drift_is_doubtful_and_named(tmp_path):
    found = findings(simulated(tmp_path / "c", name="pudding", size=64, drift_px=2.0))["alignment"]
    assert found.verdict == "doubtful"
    assert found.numbers == {f"sweep L{k} x": pytest.approx(2.0, abs=0.1) for k in (1, 2, 3)}


def test_frames_exposed_too_long(tmp_path):
    found = findings(simulated(tmp_path / "c", sweep_exposure_s=0.16))
    assert any(subject.endswith("clipping") for subject in found)
    assert found["clipped scattering"].verdict == "bad"
    assert "expose the frames shorter, or bracket" in found["clipped scattering"].value


def test_lights_that_contradict_the_pictures(good):
    capture = load_capture(good)
    turned = dataclasses.replace(capture.lights["L5"], direction=(0.6, 0.0, 0.8))
    wrong = dataclasses.replace(capture, lights={**capture.lights, "L5": turned})
    found = {f.subject: f for f in check_capture(wrong).findings}["lights against pictures"]
    assert found.verdict == "bad"
    assert "(L5); the list is used" in found.value


def test_without_sweeps_and_directions(good):
    capture = load_capture(good)
    bare = {name: dataclasses.replace(light, direction=None) for name, light in capture.lights.items()}
    result = check_capture(dataclasses.replace(capture, sweeps=(), lights=bare))
    found = {finding.subject: finding for finding in result.findings}
    assert found["sweeps"].value == "no sweeps"
    assert found["light directions"].verdict == "doubtful"
    assert result.passages == ()


def test_verdicts_have_two_limits_that_may_fall():
    assert [graded(v, (0.1, 0.5)) for v in (0.1, 0.2, 0.5)] == ["good", "doubtful", "bad"]
    assert [graded(v, (0.9, 0.5)) for v in (0.9, 0.8, 0.5)] == ["good", "doubtful", "bad"]


def test_table_has_a_row_a_finding_and_no_colour_in_a_file(good):
    result = check_capture(load_capture(good))
    text = table(result, colour=False)
    assert "\x1b" not in text
    assert text.splitlines()[-1] == "verdict: good"
    assert all(finding.subject in text for finding in result.findings[:3])
    assert "\x1b[" in table(result, colour=True)


def test_command_writes_a_sheet_and_json_and_an_exit_code(good, tmp_path, capsys):
    sheet = tmp_path / "sheet.png"
    assert main(["check", f"capture={good}", f"sheet={sheet}", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "good"
    assert document["alignment"]["reference"] == "L1"
    assert sheet.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ResultError, match=r"sheet\.png"):
        jobs.run_check(CheckJob(capture=str(good), sheet=str(sheet)))


def test_command_ends_with_1_where_something_is_bad(tmp_path, capsys):
    folder = simulated(tmp_path / "c", headroom=0.4, sweeps=0)
    assert main(["check", f"capture={folder}"]) == 1
    assert "verdict: bad" in capsys.readouterr().out


def test_json_is_of_check_alone(capsys):
    assert main(["info", "--json", "x"]) == 2
    assert "--json: info has none, only check has" in capsys.readouterr().err


def test_calibrate_writes_what_a_fit_reads(good, tmp_path):
    capture = load_capture(good)
    folder = shutil.copytree(good, tmp_path / "c")
    ball = Circle(x=50.2, y=49.6, radius=36.4)
    normals, seen = sphere_normals(ball, 100, 104)
    view = torch.tensor([0.0, 0.0, 1.0]).double()
    mirrored = 2 * (normals @ view)[..., None] * normals - view
    for name in capture.names:
        towards = torch.tensor(capture.lights[name].direction).double()
        chrome = torch.where(seen, 0.05 + 0.9 * torch.exp((mirrored @ towards - 1) / 0.002), 0.0)
        write_picture(tmp_path / "chrome" / f"ball.{name}.png", chrome[None], bits=16)
        matte = torch.where(seen, 0.6 * (normals @ towards).clamp_min(0), 0.0)
        write_picture(tmp_path / "matte" / f"{name}.png", matte[None], bits=16)
    write_picture(tmp_path / "chrome" / "ball.mask.png", disc(ball, 100, 104)[None].float())
    job = CalibrateJob(
        capture=str(folder), chrome=str(tmp_path / "chrome"), intensity="sphere", matte=str(tmp_path / "matte")
    )
    said = jobs.run_calibrate(job)
    assert "ball and list" in said
    assert "intensity against the list's" in said
    found = read_calibration(folder / "calibration.json")
    for name in capture.names:
        torch.testing.assert_close(
            torch.tensor(found.lights[name].direction), torch.tensor(capture.lights[name].direction), rtol=0, atol=6e-3
        )
        assert found.lights[name].intensity[0] == pytest.approx(1.0, rel=0.02)
    used, file = with_calibration(load_capture(folder), None)
    assert file == str(folder / "calibration.json")
    assert used.lights["L2"] == found.lights["L2"]
    assert with_calibration(capture, None) == (capture, None)
    with pytest.raises(ResultError, match=r"calibration\.json"):
        jobs.run_calibrate(job)


def test_strengths_jointly_from_pictures(good, tmp_path):
    out = tmp_path / "calibration.json"
    said = jobs.run_calibrate(CalibrateJob(capture=str(good), intensity="pictures", out=str(out)))
    assert "strengths jointly from the pictures" in said
    strengths = [light.intensity[0] for light in read_calibration(out).lights.values()]
    assert strengths == pytest.approx([1.0] * len(strengths), rel=0.05)


def test_response_from_a_bracket_is_used(good, tmp_path):
    pytest.importorskip("cv2")
    folder = shutil.copytree(good, tmp_path / "c")
    document = json.loads((folder / "capture.json").read_text())
    y, x = torch.meshgrid(torch.linspace(0, 1, 40), torch.linspace(0, 1, 40), indexing="ij")
    scene = 0.004 * torch.exp(5.5 * x) * (0.6 + 0.4 * y)
    document["images"] = [entry for entry in document["images"] if entry.get("light") != "L6"]
    for power in range(7):
        file = f"bracket{power}.png"
        write_picture(folder / file, ((scene * 0.05 * 2**power).clamp(max=1) ** (1 / 2.2))[None], bits=8)
        document["images"].append({"kind": "full", "light": "L6", "file": file, "exposure_s": 0.01 * 2**power})
    (folder / "capture.json").write_text(json.dumps(document))
    said = jobs.run_calibrate(CalibrateJob(capture=str(folder), response="debevec"))
    assert "7 exposures of L6" in said
    used, _ = with_calibration(load_capture(folder), None)
    linear = response_of(used)(torch.tensor([0.3, 0.6, 0.9]))
    torch.testing.assert_close(linear, torch.tensor([0.3, 0.6, 0.9]) ** 2.2, rtol=0, atol=0.01)


def test_calibrate_refuses_to_do_nothing(good):
    with pytest.raises(SettingsError, match="nothing to do; give chrome=FOLDER"):
        jobs.run_calibrate(CalibrateJob(capture=str(good), out="never.json"))
    with pytest.raises(CaptureError, match="no light has several exposures"):
        jobs.run_calibrate(CalibrateJob(capture=str(good), response="debevec", out="never.json"))
