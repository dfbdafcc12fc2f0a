"""Globals taken over from another result, and fits of a part of a capture."""

import dataclasses
import json
import shutil

import pytest
import torch

import reflectsep
from reflectsep import jobs
from reflectsep.config import (
    CompareJob,
    FitJob,
    FitSettings,
    InfoJob,
    ObjectSettings,
    RelightJob,
    RigSettings,
    ScatterSettings,
    SimulateJob,
    ViewJob,
)
from reflectsep.errors import CaptureError, ReflectsepError, ResultError
from reflectsep.fit import reflectance
from reflectsep.handed import read_handed
from reflectsep.io.exr import read_channels
from reflectsep.io.stack import read_mask

QUICK = FitSettings(tolerance=1e-2, max_iterations=2)
RIG = RigSettings(slab_width_px=8.0, slab_step_px=4.0, lights=6, sweeps=3, heldout=1)
REGION = [9, 4, 15, 18]


@pytest.fixture(scope="module", autouse=True)
def hasty():
    """One start and one round: a fraction of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reflectance, "START_N_S", (20.0, 20.0))
        patch.setattr(reflectance, "ROUNDS", 1)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("handed")


@pytest.fixture(scope="module")
def captured(folder):
    out = folder / "capture"
    jobs.run_simulate(SimulateJob(object=ObjectSettings(name="wax", size_px=28), rig=RIG, out=str(out)))
    return out


@pytest.fixture(scope="module")
def whole(folder, captured):
    """A result of all of the capture."""
    jobs.run_fit(FitJob(capture=str(captured), out=str(folder / "whole"), fit=QUICK, report=False))
    return folder / "whole"


def taking(whole, **changes):
    return dataclasses.replace(QUICK, globals_from=str(whole), **changes)


@pytest.fixture(scope="module")
def part(folder, captured, whole):
    """A region under the globals of all; nothing of the globals may be fitted."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("fit_globals", "start_globals", "best_smoothness", "noise_of", "solve_joint"):
            patch.setattr(reflectance, name, None)
        out = folder / "part"
        jobs.run_fit(FitJob(capture=str(captured), region=REGION, out=str(out), fit=taking(whole), baseline=False))
    return out


def test_held_globals_are_those_of_the_result_bit_for_bit(whole, part):
    theirs, own = reflectsep.load(whole), reflectsep.load(part)
    for name in ("a", "n_s", "n_d", "f", "softness", "fresnel"):
        assert torch.equal(getattr(theirs, name), getattr(own, name)), name
    for key in ("learnt", "covariance", "n_d_source", "n_d_sd"):
        assert own.document[key] == theirs.document[key], key
    for first, second in zip(theirs.document["sweeps"], own.document["sweeps"], strict=True):
        for key in ("light", "direction", "gain", "gain_sd", "lit_frames", "step_px"):
            assert first[key] == second[key], key


def test_held_globals_are_said_wherever_globals_are_shown(whole, part):
    document = json.loads((part / "separation.json").read_text())
    created = json.loads((whole / "separation.json").read_text())["created"]
    assert document["globals_from"] == {"result": str(whole.resolve()), "use": "held", "created": created}
    assert f"globals   held as they are in {whole.resolve()}" in jobs.run_info(InfoJob(path=str(part)))
    text = (part / "report.html").read_text()
    assert "held as they are, and their uncertainty with them" in text
    assert f"of the result {whole.resolve()}" in text
    assert "±" in text.split("<td>a_1</td>")[1].split("</tr>")[0]
    assert "globals" not in {line.split(":")[0] for line in (part / "log.txt").read_text().splitlines()}


@pytest.mark.slow
def test_the_same_pixels_under_held_globals_end_where_they_were(folder, captured, whole):
    out = folder / "again"
    jobs.run_fit(FitJob(capture=str(captured), out=str(out), fit=taking(whole), report=False))
    theirs, own = reflectsep.load(whole), reflectsep.load(out)
    assert float((theirs.diffuse - own.diffuse).norm() / theirs.diffuse.norm()) < 0.02
    assert torch.equal(theirs.scattering, own.scattering)


@pytest.mark.slow
def test_uncertainty_of_held_globals_is_carried_into_the_pixels(folder, captured, whole, part):
    copy = shutil.copytree(whole, folder / "unsure")
    document = json.loads((copy / "separation.json").read_text())
    values = document["covariance"]["values"]
    document["covariance"]["values"] = [[1e4 * value for value in row] for row in values]
    (copy / "separation.json").write_text(json.dumps(document))
    capture = reflectsep.load_capture(captured, region=REGION)
    unsure = reflectsep.fit(capture, settings=taking(copy))
    sure = reflectsep.load(part)
    assert torch.equal(unsure.d, sure.d)
    assert (unsure.B_sd > 1.5 * sure.B_sd)[sure.mask].double().mean() > 0.5


@pytest.mark.slow
def test_a_fit_starts_from_the_globals_of_a_result(captured, whole, monkeypatch):
    starts = []
    fitted = reflectance.fit_globals
    monkeypatch.setattr(
        reflectance, "fit_globals", lambda state, *rest: starts.append(state.shared) or fitted(state, *rest)
    )
    result = reflectsep.fit(reflectsep.load_capture(captured), settings=taking(whole, globals="start"))
    theirs = reflectsep.load(whole).document
    assert starts[0].tolist()[:4] == theirs["learnt"]["shared"][:4]
    assert result.document["learnt"]["shared"] != theirs["learnt"]["shared"]
    assert result.document["globals_from"]["use"] == "start"
    assert "started from" in reflectsep.summary.summary(result, full=True)


@pytest.mark.slow
def test_an_exponent_that_is_fixed_is_not_taken_from_a_result(captured, whole):
    capture = reflectsep.load_capture(captured)
    result = reflectsep.fit(capture, settings=taking(whole, globals="start", n_s=17.0))
    assert float(result.n_s) == pytest.approx(17.0)
    with pytest.raises(ResultError, match=r"whole: globals of a fit with n_s .*, expected fit\.n_s=17"):
        reflectsep.fit(capture, settings=taking(whole, n_s=17.0))


def refused(captured, settings, **changes):
    """What a fit says that cannot be, before it has read a frame."""
    capture = dataclasses.replace(reflectsep.load_capture(captured), **changes)
    scatter = ScatterSettings(n_d=1.5) if settings.n_s == 1.0 else None
    with pytest.raises(ReflectsepError) as caught:
        reflectsep.fit(capture, settings=dataclasses.replace(settings, n_s=None), scatter=scatter)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_does_not_belong_together_is_refused_in_one_line(captured, whole, tmp_path):
    capture = reflectsep.load_capture(captured)
    start = f"{whole}: globals of a fit with"
    said = refused(captured, taking(whole, lobe="power"))
    assert said == f"{start} fit.lobe ggx, expected power"
    said = refused(captured, taking(whole, scattering="none"))
    assert said == f"{start} fit.scattering measured, expected none"
    assert refused(captured, taking(whole, n_s=1.0)).endswith("expected scatter.n_d=1.5")
    said = refused(captured, taking(whole), sweeps=())
    assert said == f"{start} scattering measured, expected scattering taken as zero"
    said = refused(captured, taking(whole), basis=("L2", "L1", "L3"))
    assert said == f"{start} basis lights L1, L2, L3, expected L2, L1, L3"
    light = dataclasses.replace(capture.lights["L4"], name="L9")
    images = tuple(dataclasses.replace(p, light="L9") if p.light == "L4" else p for p in capture.images)
    said = refused(captured, taking(whole), images=images, lights={**capture.lights, "L9": light})
    assert said == f"{start} 6 lights (L1, L2, L3, L4, L5, L6), expected 6 (L1, L2, L3, L9, L5, L6)"
    moved = dataclasses.replace(capture.lights["L5"], direction=(0.0, 0.6, 0.8))
    said = refused(captured, taking(whole), lights={**capture.lights, "L5": moved})
    assert said.startswith(f"{start} light L5 at [")
    assert said.endswith("expected [0.0, 0.6, 0.8]")
    assert refused(captured, taking(tmp_path / "none")) == f"{tmp_path / 'none'}: no such folder; a result was expected"
    assert refused(captured, taking(captured)).startswith(f"{captured}: not a result: no separation.json in it")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("learnt"), "no learnt in it"),
        (lambda d: d["learnt"].update(noise=0.0), "a number above 0 was expected"),
        (lambda d: d["learnt"].update(shared=[0.0] * 9), "9 globals; 8 or 17 were expected"),
        (lambda d: d["learnt"].update(smooth=[1.0, -1.0]), "a number above 0 was expected"),
        (lambda d: d["learnt"].update(smooth=["much", 1.0]), "could not convert"),
        (lambda d: d["covariance"]["values"].pop(), "a covariance that is not"),
        (lambda d: d["learnt"]["alpha"].pop(), "expected (6, 3)"),
        (lambda d: d["sweeps"][0].pop("gain"), "gain"),
        (lambda d: d.pop("settings"), "settings"),
    ],
)
def test_a_result_that_says_too_little_is_refused(whole, tmp_path, change, words):
    (tmp_path / "bad").mkdir()
    document = json.loads((whole / "separation.json").read_text())
    change(document)
    (tmp_path / "bad" / "separation.json").write_text(json.dumps(document))
    with pytest.raises(ResultError) as caught:
        read_handed(taking(tmp_path / "bad"))
    assert str(caught.value).startswith(f"{tmp_path / 'bad' / 'separation.json'}: ")
    assert words in str(caught.value)


def test_another_number_of_channels_is_refused(captured, whole, tmp_path):
    copy = shutil.copytree(whole, tmp_path / "colour")
    document = json.loads((copy / "separation.json").read_text())
    document["learnt"]["channels"] = 3
    (copy / "separation.json").write_text(json.dumps(document))
    said = refused(captured, taking(copy))
    assert said == f"{copy}: globals of a fit with channels 3, expected 1"


def test_a_result_of_a_region_says_so_and_opens_like_any_other(part, captured, whole, tmp_path):
    own, theirs = reflectsep.load(part), reflectsep.load(whole)
    x, y, width, height = REGION
    assert own.document["region"] == REGION
    assert own.mask.shape == (height, width)
    assert torch.equal(own.mask, theirs.mask[y : y + height, x : x + width])
    assert "region    15 x 18 pixels of the capture's pictures, from column 9, row 4" in jobs.run_info(
        InfoJob(path=str(part))
    )
    jobs.run_relight(RelightJob(result=str(part), orbit=2, out=str(tmp_path / "relit")))
    (plane, *_) = read_channels(next((tmp_path / "relit").glob("*.exr"))).values()
    assert plane.shape == (height, width)
    jobs.run_view(ViewJob(result=str(part), out=str(tmp_path / "view.html")))
    said = jobs.run_compare(CompareJob(result=str(part), out=str(tmp_path / "figure.png")))
    assert "dB" in said
    assert "of the truth" in said
    assert 'id="heldout"' in (part / "report.html").read_text()


def test_a_region_must_lie_inside_of_the_pictures(captured):
    with pytest.raises(CaptureError, match=r"capture: region=\[20,0,9,28\] \(x, y, width, height\) is not inside its"):
        reflectsep.load_capture(captured, region=[20, 0, 9, 28])
    with pytest.raises(CaptureError, match=r"region=\[0,0,0,28\]"):
        reflectsep.load_capture(captured, region=[0, 0, 0, 28])
    bare = dataclasses.replace(reflectsep.load_capture(captured), size=None)
    far = dataclasses.replace(bare, region=reflectsep.data.Region(x=20, y=0, width=9, height=28))
    with pytest.raises(CaptureError, match=r"L1\.exr: 28x28, but region=\[20,0,9,28\]"):
        reflectsep.fit(far, settings=QUICK)
    corner = reflectsep.load_capture(captured, region=[0, 0, 2, 2])
    with pytest.raises(CaptureError, match=r"no pixel of its region \[0,0,2,2\]"):
        read_mask(corner)
