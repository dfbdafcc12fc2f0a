"""The whole chain on a tiny object: capture, fit, save, load, relight, compare; and the public Python interface.

Starts of the fit are thinned out: what is tested here is that the stages fit together, not how well each does.
"""

import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
import torch

import reflectsep
from reflectsep import jobs, pipeline, recorded, room
from reflectsep.comparison import bounded
from reflectsep.config import (
    CompareJob,
    DemoJob,
    FitJob,
    FitSettings,
    InfoJob,
    ObjectSettings,
    RelightJob,
    RigSettings,
    SimulateJob,
)
from reflectsep.errors import LightError, ResultError, SettingsError
from reflectsep.estimate import TimeLeft
from reflectsep.fit import reflectance
from reflectsep.io.exr import read_channels
from reflectsep.io.pictures import read_picture
from reflectsep.separation import LAYERS
from reflectsep.summary import summary

QUICK = FitSettings(tolerance=1e-2, max_iterations=2)
RIG = RigSettings(slab_width_px=8.0, slab_step_px=4.0, lights=7, sweeps=3, heldout=2)


@pytest.fixture(scope="module", autouse=True)
def hasty():
    """One start and one round: a fraction of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reflectance, "START_N_S", (20.0, 20.0))
        patch.setattr(reflectance, "ROUNDS", 1)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where everything of this module is."""
    return tmp_path_factory.mktemp("pipeline")


@pytest.fixture(scope="module")
def captured(folder):
    """A capture of seven pictures and three sweeps."""
    out = folder / "capture"
    jobs.run_simulate(SimulateJob(object=ObjectSettings(name="wax", size_px=28), rig=RIG, out=str(out)))
    return out


@pytest.fixture(scope="module")
def seen():
    """Steps of every stage of the fit, as (done, total)."""
    return {}


@pytest.fixture(scope="module")
def unforeseen():
    """Stages of the fit that no announcement had named."""
    return []


@pytest.fixture(scope="module")
def said(folder, captured, seen, unforeseen):
    """What the fit says; its result, without light L7, is beside the capture."""
    job = FitJob(capture=str(captured), out=str(folder / "result"), fit=QUICK, heldout=["L7"])

    class Watch:
        left = TimeLeft()

        def expect(self, parts):
            self.left.expect(parts)

        def __call__(self, stage, done, total):
            seen.setdefault(stage, []).append((done, total))
            if not self.left(stage, done, total).expected_s:
                unforeseen.append(stage)

    return jobs.run_fit(job, Watch())


@pytest.fixture(scope="module")
def result(folder, said):
    """The result folder."""
    return folder / "result"


def test_fit_says_what_it_found(result, said):
    assert said.startswith(f"{result}: Wu & Tang")
    assert {"specular.exr", "scattering.exr", "parameters.exr", "separation.json", "previews"} <= {
        path.name for path in result.iterdir()
    }
    assert not list(result.parent.glob(".*"))


def test_a_fit_leaves_a_report_unless_told_not_to(result, said):
    text = (result / "report.html").read_text()
    assert f"report    {result / 'report.html'}" in said
    for part in ("capture", "scattering", "components", "globals", "maps", "heldout", "reproduce"):
        assert f'<section id="{part}">' in text
    assert "relit" in text
    assert "<td>L7</td>" in text  # held out, and its figures
    assert "fit.max_iterations=2" in text
    assert "Of the capture not all" not in text
    log = (result / "log.txt").read_text().splitlines()
    assert "fit of" in log[0]
    assert {"pictures", "globals", "pixels", "report"} <= {line.split(":")[0] for line in log[1:]}
    assert not re.search(r"https?://|<script|<link|@import|url\(", text)


def test_the_report_has_lin_and_lee_beside_where_that_is_quick_or_asked_for(result, captured, monkeypatch):
    job = FitJob(capture=str(captured), out=str(result) + "_again")
    capture = reflectsep.load_capture(captured)
    assert jobs.wants_baseline(job, capture)
    assert "Lin &amp; Lee" in (result / "report.html").read_text()
    assert not jobs.wants_baseline(dataclasses.replace(job, report=False), capture)
    assert not jobs.wants_baseline(dataclasses.replace(job, baseline=False), capture)
    lin_lee = dataclasses.replace(job, fit=FitSettings(scattering="none"))
    assert not jobs.wants_baseline(lin_lee, capture)
    monkeypatch.setattr(jobs, "QUICK_S", 0.0)
    assert not jobs.wants_baseline(job, capture)
    assert jobs.wants_baseline(dataclasses.replace(job, baseline=True), capture)


@pytest.mark.slow
def test_maps_in_files_give_the_same_result_bit_for_bit(folder, captured, monkeypatch):
    made = []
    for name in ("in_memory", "in_files"):
        job = FitJob(capture=str(captured), out=str(folder / name / "result"), fit=QUICK, report=False)
        (folder / name).mkdir()
        jobs.run_fit(job)
        # From here on whatever has more than two values a pixel goes into a file.
        monkeypatch.setattr(room, "LEAST_BYTES", 28 * 28 * 8 * 2)
        monkeypatch.setattr(room.mmap, "mmap", lambda *given, m=room.mmap.mmap: made.append(given) or m(*given))
    assert len(made) > 20
    assert sorted(path.name for path in (folder / "in_files").iterdir()) == ["result"]
    for name in LAYERS:
        assert (folder / "in_files/result" / name).read_bytes() == (folder / "in_memory/result" / name).read_bytes()


def test_document_says_how_it_came_about(result, captured):
    document = json.loads((result / "separation.json").read_text())
    assert document["capture"] == str(captured.resolve())
    assert document["heldout"] == ["L7"]
    assert document["settings"]["fit"] == dataclasses.asdict(QUICK)
    assert set(document["timings_s"]) == {"alignment", "pictures", "scattering", "fit"}
    assert document["alignment"]["reference"] == "L1"
    assert not any(motion["applied"] for motion in document["alignment"]["pictures"].values())
    assert [sweep["light"] for sweep in document["sweeps"]] == ["L1", "L2", "L3"]
    assert document["versions"]["reflectsep"] == reflectsep.__version__
    assert list(document["lights"]) == ["L1", "L2", "L3", "L4", "L5", "L6"]


def test_components_add_up_to_the_picture(result, captured):
    separation = reflectsep.load(result)
    for i, name in enumerate(separation.basis):
        picture, _ = read_picture(captured / "full" / f"{name}.exr")
        whole = separation.highlight_free[i] + separation.specular[i]
        torch.testing.assert_close(whole[:, separation.mask], picture[:, separation.mask], rtol=1e-5, atol=1e-6)
        model = separation.diffuse[i] + separation.specular[i]
        residual = separation.residual[i][:, separation.mask]
        difference = (picture - model)[:, separation.mask]
        torch.testing.assert_close(residual.abs(), difference.abs(), rtol=1e-3, atol=2e-3)
    assert not separation.specular[:, :, ~separation.mask].any()


def test_relit_pictures_of_the_command_are_those_of_python(result, captured, tmp_path):
    out = tmp_path / "relit"
    said = jobs.run_relight(RelightJob(result=str(result), alpha=[0.2, 0.3, 0.5], intensity=2.0, out=str(out)))
    assert said == f"{out}: 1 picture"
    (plane,) = read_channels(out / "relit.exr").values()
    expected = reflectsep.load(result).relight(torch.tensor([0.4, 0.6, 1.0]))
    np.testing.assert_allclose(plane, expected[0].numpy(), rtol=1e-5, atol=1e-7)


def test_a_basis_light_by_direction_is_its_alpha(result, captured, tmp_path):
    light = reflectsep.load_capture(captured).lights["L2"]
    job = RelightJob(result=str(result), direction=list(light.direction), out=str(tmp_path / "relit"))
    separation = reflectsep.load(result)
    (mix,) = jobs.mixes(job, separation).values()
    torch.testing.assert_close(torch.tensor(mix.alpha), torch.tensor([0.0, 1.0, 0.0]), rtol=0, atol=1e-5)


def test_lights_of_a_file_and_of_an_orbit_are_written_by_name(result, captured, tmp_path):
    lights = RelightJob(result=str(result), lights=str(captured / "heldout.json"), out=str(tmp_path / "a"))
    jobs.run_relight(lights)
    names = set(json.loads((captured / "heldout.json").read_text())["lights"])
    assert {path.stem for path in (tmp_path / "a").glob("*.exr")} == names
    jobs.run_relight(RelightJob(result=str(result), orbit=3, out=str(tmp_path / "b")))
    assert len(list((tmp_path / "b").glob("*.exr"))) == 3


def test_comparison_has_the_held_out_lights_and_the_truth(result, tmp_path):
    out = tmp_path / "figure.png"
    said = jobs.run_compare(CompareJob(result=str(result), out=str(out)))
    assert out.read_bytes().startswith(b"\x89PNG")
    lines = said.splitlines()
    assert [line.split()[0] for line in lines[1:5]] == ["L7", "L8", "L9", "L10"]
    assert all(f"{name} " in line for name in ("ours", "Lin & Lee", "PTM", "Lambert") for line in lines[1:5])
    assert sum("of the truth" in line for line in lines) == 5
    assert not list(tmp_path.glob(".*"))


def test_result_without_scattering_is_compared_as_lin_lees_own(result, captured, tmp_path, monkeypatch):
    bare = dataclasses.replace(reflectsep.load(result), s=torch.zeros_like(reflectsep.load(result).s))
    bare.save(tmp_path / "bare")
    monkeypatch.setattr(recorded, "fit", None)  # it takes no other fit
    out = tmp_path / "figure.png"
    said = jobs.run_compare(CompareJob(result=str(tmp_path / "bare"), capture=str(captured), out=str(out)))
    (line,) = [line for line in said.splitlines() if line.strip().startswith("L7 ")]
    assert "Lin & Lee" in line
    assert "ours" not in line


def test_overflowing_picture_is_bounded_and_others_are_left_as_they_are():
    real = torch.tensor([[[0.5, 2.0]]])
    good = torch.tensor([[[0.1, 3.0]]])
    assert torch.equal(bounded(good, real), good)
    wild = torch.tensor([[[float("inf"), float("nan")]]])
    assert torch.equal(bounded(wild, real), torch.full_like(wild, 200.0))


def test_comparison_needs_the_capture(result, tmp_path):
    separation = dataclasses.replace(reflectsep.load(result), document={"capture": str(tmp_path / "gone")})
    with pytest.raises(ResultError, match=r"its capture '.*gone' is not there; give capture=FOLDER"):
        recorded.recorded_capture(separation, "result")
    with pytest.raises(ResultError, match=r"result: separation.json has no usable settings.fit"):
        recorded.recorded_settings(separation, "result")


def test_lin_and_lee_beside_is_moved_as_the_result_was(result, captured, monkeypatch):
    separation = reflectsep.load(result)
    document = json.loads(json.dumps(separation.document["alignment"]))
    moved = next(iter(set(document["pictures"]) - {separation.basis[0]}))
    document["pictures"][moved] |= {"applied": True, "reason": "told", "matrix": [[1, 0, 12], [0, 1, 0], [0, 0, 1]]}
    told = dataclasses.replace(separation, document={**separation.document, "alignment": document})
    monkeypatch.setattr(pipeline, "align", None)  # it does not look again
    beside = recorded.lin_lee_beside(told, reflectsep.load_capture(captured), QUICK, lambda *_: None)
    assert {**beside.document["alignment"], "told": document["told"]} == document
    assert beside.document["alignment"]["told"] == f"moved between lights: {moved} by 0.00 px; no sweep moved"
    assert 0 < beside.mask.sum() < separation.mask.sum()  # what came from outside is none of it


@pytest.mark.parametrize(
    "broken",
    [
        {"size": None},
        {"size": [28, 28], "pictures": [], "sweeps": [{}]},
        {"size": [28, 28], "pictures": {"L1": {"matrix": [[1, 0], [0, 1]]}}, "sweeps": []},
        {"size": [28, 28], "pictures": 3, "sweeps": []},
        [1],
    ],
)
def test_alignment_that_a_result_cannot_have(result, broken):
    separation = dataclasses.replace(reflectsep.load(result), document={"capture": "there", "alignment": broken})
    with pytest.raises(ResultError, match=r"there: its result has no usable alignment"):
        recorded.recorded_alignment(separation)


def test_damaged_result_is_refused_in_one_line(result, tmp_path):
    copy = shutil.copytree(result, tmp_path / "copy")
    (copy / "specular.exr").write_bytes((copy / "specular.exr").read_bytes()[:-50])
    for job, run in (
        (RelightJob(result=str(copy), orbit=3, out=str(tmp_path / "relit")), jobs.run_relight),
        (CompareJob(result=str(copy), out=str(tmp_path / "figure.png")), jobs.run_compare),
        (InfoJob(path=str(copy)), jobs.run_info),
    ):
        with pytest.raises(ResultError, match=r"copy/specular\.exr") as caught:
            run(job)
        assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_info_tells_of_both(result, captured):
    of_capture = jobs.run_info(InfoJob(path=str(captured)))
    assert "28 x 28" in of_capture
    assert "7 (7 with a known light direction)" in of_capture
    assert of_capture.count("frames, slab") == 3
    of_result = jobs.run_info(InfoJob(path=str(result)))
    assert "lights    L1, L2, L3, L4, L5, L6; basis L1, L2, L3" in of_result
    assert "C 2.0" in of_result


def test_without_sweeps_the_fit_is_lin_and_lee_and_says_so(captured):
    capture = dataclasses.replace(reflectsep.load_capture(captured), sweeps=())
    separation = reflectsep.fit(capture, settings=QUICK, max_iterations=1, method="two_step")
    assert separation.document["model"].startswith("Lin & Lee")
    assert any("no sweeps" in warning for warning in separation.document["warnings"])
    assert separation.document["settings"]["fit"]["method"] == "two_step"
    assert not separation.scattering.any()
    assert "no sweeps" in summary(separation)
    assert "motion    no motion between lights proven" in summary(separation)


def test_settings_by_keyword_are_checked(captured):
    capture = reflectsep.load_capture(captured)
    with pytest.raises(SettingsError, match=r"fit\.n_ss: no such setting; did you mean n_s\?"):
        reflectsep.fit(capture, n_ss=3)
    with pytest.raises(SettingsError, match=r"fit\.n_s=-3: must be above 0"):
        reflectsep.fit(capture, n_s=-3)


def test_lights_that_may_not_be_left_out(captured):
    capture = reflectsep.load_capture(captured)
    with pytest.raises(LightError, match="L99"):
        reflectsep.fit(capture, heldout=["L99"])


def test_plain_folder_of_pictures_fits(captured, tmp_path):
    capture = reflectsep.load_capture(captured)
    plain = tmp_path / "plain"
    plain.mkdir()
    rows = [str(len(capture.names))]
    for name in capture.names:
        shutil.copy(captured / "full" / f"{name}.exr", plain / f"{name}.exr")
        rows.append(f"{name}.exr " + " ".join(f"{x:.6f}" for x in capture.lights[name].direction))
    (plain / "lights.lp").write_text("\n".join(rows) + "\n")
    said = jobs.run_fit(FitJob(capture=str(plain), out=str(tmp_path / "result"), fit=QUICK, report=False))
    assert "Lin & Lee" in said
    separation = reflectsep.load(tmp_path / "result")
    assert len(separation.names) == 7
    assert separation.document["residual"]["rms"] < 0.05


def test_every_stage_was_announced_with_its_time(said, unforeseen):
    assert unforeseen == []


def test_progress_of_every_stage_ends(said, seen):
    assert {"pictures", "globals", "pixels"} <= set(seen)
    assert sum(stage.startswith("sweep") for stage in seen) >= 3
    assert all(0 <= done <= total for steps in seen.values() for done, total in steps)
    assert all(steps[-1][0] == steps[-1][1] for steps in seen.values()), seen


@pytest.mark.slow
def test_colour(tmp_path):
    out = tmp_path / "colour"
    item = ObjectSettings(name="skin", preset="skin", size_px=20, channels=3)
    jobs.run_simulate(SimulateJob(object=item, rig=RIG, out=str(out)))
    jobs.run_fit(FitJob(capture=str(out), out=str(tmp_path / "result"), fit=QUICK, report=False))
    separation = reflectsep.load(tmp_path / "result")
    assert separation.scattering.shape == (3, 3, 20, 20)
    assert separation.relight(torch.eye(3)).shape == (3, 3, 20, 20)


@pytest.mark.slow
def test_demo_leaves_a_figure_and_relit_pictures(tmp_path):
    out = tmp_path / "demo"
    item = ObjectSettings(name="turtle", preset="turtle", size_px=28, channels=3)
    rig = dataclasses.replace(RIG, oversample=2)
    job = DemoJob(object=item, rig=rig, fit=QUICK, out=str(out))
    said = jobs.run_demo(job)
    assert f"look at {out / 'compare.png'}" in said
    assert {path.name for path in out.iterdir()} == {"capture", "result", "relit", "compare.png"}
    assert len(list((out / "relit").glob("*.exr"))) == 3
    assert (out / "result" / "view.html").is_file()
    assert "error of scattering" in said


def test_a_path_in_place_of_a_capture_is_told_what_to_do():
    with pytest.raises(TypeError, match=r"got 'captures/wax': reflectsep\.fit\(reflectsep\.load_capture\(FOLDER\)\)"):
        pipeline.fit("captures/wax")
