"""Bad input through the command itself: one line that names what is wrong, an exit code, nothing half-written."""

import json
import shutil

import numpy as np
import pytest

from reflectsep.cli import main
from reflectsep.io.exr import read_channels, write_channels
from reflectsep.io.pictures import read_picture, write_picture

RIG = "rig=clean rig.slab_width_px=8 rig.slab_step_px=4 rig.heldout=0"


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    """A tiny simulated capture of float EXR files."""
    folder = tmp_path_factory.mktemp("pristine") / "wax"
    assert main(["simulate", "object.size_px=32", *RIG.split(), f"out={folder}"]) == 0
    edit(folder, forget_checksums)
    return folder


@pytest.fixture
def capture(pristine, tmp_path, monkeypatch):
    """A copy to damage, in the working folder."""
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(pristine, tmp_path / "wax")


def edit(capture, change):
    """Change the manifest in place."""
    path = capture / "capture.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


def forget_checksums(manifest):
    """As of someone who writes none: damage must be noticed all the same."""
    manifest.pop("checksums")
    for entry in (*manifest["images"], *manifest["sweeps"]):
        entry.pop("sha256")


def repaint(path, change):
    """Change the values of an EXR in place."""
    values = {name: change(plane.copy()) for name, plane in read_channels(path).items()}
    write_channels(path, {name: np.ascontiguousarray(plane) for name, plane in values.items()})


def missing_frame(capture):
    (capture / "sweep/L2/0003.exr").unlink()


def small_frame(capture):
    repaint(capture / "sweep/L2/0003.exr", lambda plane: plane[:20, :30])


def truncated_frame(capture):
    path = capture / "sweep/L1/0002.exr"
    path.write_bytes(path.read_bytes()[:-100])


def truncated_picture(capture):
    path = capture / "full/L3.exr"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def nan_picture(capture):
    repaint(capture / "full/L4.exr", lambda plane: plane * np.nan)


def black_picture(capture):
    repaint(capture / "full/L4.exr", lambda plane: 0 * plane)


def coplanar_lights(capture):
    def change(manifest):
        for index, name in enumerate(manifest["lights"]):
            manifest["lights"][name]["direction"] = [0.1 * index - 0.2, 0.0, 1.0]

    edit(capture, change)


def five_pictures(capture):
    edit(capture, lambda manifest: manifest["images"].pop())


def short_sweep(capture):
    def change(manifest):
        for sweep in manifest["sweeps"]:
            sweep["count"] //= 2

    edit(capture, change)


def empty_mask(capture):
    mask, _ = read_picture(capture / "mask.png")
    write_picture(capture / "mask.png", 0 * mask)


def unknown_key(capture):
    edit(capture, lambda manifest: manifest.update(basys=["L1", "L2", "L3"]))


def no_manifest(capture):
    for path in (capture / "capture.json", capture / "heldout.json"):
        path.unlink()


def broken_manifest(capture):
    path = capture / "capture.json"
    path.write_text(path.read_text()[:-20])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (missing_frame, ["wax/sweep/L2/0003.exr: no such file", "capture.json names it"]),
        (small_frame, ["wax/sweep/L2/0003.exr: 30x20", "the manifest says 32x32"]),
        (truncated_frame, ["wax/sweep/L1/0002.exr: truncated"]),
        (truncated_picture, ["wax/full/L3.exr: truncated"]),
        (nan_picture, ["wax/full/L4.exr: not one finite value"]),
        (black_picture, ["wax/full/L4.exr: every pixel is zero"]),
        (coplanar_lights, ["wax: basis lights L1, L2, L3 are coplanar", "condition number", "expected at most"]),
        (five_pictures, ["wax: 5 full pictures", "expected at least 6"]),
        (
            short_sweep,
            ["wax: sweep of L1 along x", "the slab reached", "expected at least 90%", "shorter than the object"],
        ),
        (empty_mask, ["wax/mask.png: ", "empty"]),
        (unknown_key, ["wax/capture.json: ", "unknown key 'basys'; did you mean 'basis'?"]),
        (no_manifest, ["wax: no capture: neither capture.json nor"]),
        (broken_manifest, ["wax/capture.json: not JSON: "]),
    ],
)
def test_a_damaged_capture_is_one_line_and_writes_nothing(capture, tmp_path, capsys, damage, words):
    damage(capture)
    code = main(["fit", "capture=wax", "out=results/wax"])
    printed = capsys.readouterr()
    assert (code, printed.out) == (1, "")
    error = last_line(printed.err)
    assert all(word in error for word in words), error
    assert [path.name for path in tmp_path.iterdir()] == ["wax"]


def last_line(printed):
    """The error, which is one line and the last, after those of the stages that ended."""
    *stages, error = printed.splitlines()
    assert error.startswith("reflectsep: error: ")
    assert not any("error" in line or "Traceback" in line for line in stages)
    return error.removeprefix("reflectsep: error: ")


def test_a_picture_that_changed_since_it_was_recorded_is_noticed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "object.size_px=16", *RIG.split(), "out=wax"]) == 0
    repaint(tmp_path / "wax/full/L2.exr", lambda plane: 0.9 * plane)
    assert main(["fit", "capture=wax", "out=result"]) == 1
    assert "wax/full/L2.exr: its SHA-256 is" in last_line(capsys.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["wax"]


@pytest.mark.parametrize("words", [["fit", "capture=wax"], ["simulate"], ["demo"]])
def test_an_existing_out_is_refused_before_anything_is_done(capture, tmp_path, capsys, words):
    (tmp_path / "there").mkdir()
    (tmp_path / "there/diary.txt").write_text("mine")
    assert main([*words, "out=there"]) == 1
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert "there: exists" in last_line(printed)
    assert [path.name for path in (tmp_path / "there").iterdir()] == ["diary.txt"]


def test_what_is_not_ours_is_not_overwritten_even_when_asked(capture, tmp_path, capsys):
    (tmp_path / "there").mkdir()
    (tmp_path / "there/diary.txt").write_text("mine")
    for job in (["fit", "capture=wax"], ["simulate"]):
        assert main([*job, "out=there", "overwrite=true"]) == 1
        printed = capsys.readouterr().err
        assert printed.count("\n") == 1  # before any stage ran
        assert "there: not empty" in last_line(printed)
    assert (tmp_path / "there/diary.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("fit capture=wax fit.n_ss=3", "fit.n_ss: no such setting; did you mean fit.n_s?"),
        ("fit capture=wax fit.n_s=-1", "fit.n_s=-1.0: must be above 0"),
        ("fit capture=wax fit.lobe=dual", "fit.lobe=dual: expected ggx or power"),
        ("fit capture=wax fit.robust=cauchy", "fit.robust=cauchy: expected huber or none"),
        ("simulate object.preset=glass", "object.preset=glass: expected wax, pudding, plastic, marble, skin or turtle"),
        ("simulate rig.lights=3 rig.sweeps=4", "rig.sweeps=4: must be at most rig.lights=3"),
        ("simulate rig.slab_width_px=1", "rig six: slab of 1.0 px stepping 2.0 px, expected a step"),
    ],
)
def test_impossible_settings_write_nothing(capture, tmp_path, capsys, words, line):
    assert main([*words.split(), "out=there"]) == 2
    assert last_line(capsys.readouterr().err).startswith(line)
    assert [path.name for path in tmp_path.iterdir()] == ["wax"]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("fit capture=wux", "wux: no such folder"),
        ("fit capture=wax heldout=[L99]", "wax: no full picture of light L99"),
        ("fit capture=wax basis=[L1,L2,L99]", "wax/capture.json"),
        ("relight result=wax orbit=3", "wax: not a result: no separation.json"),
        ("compare result=wax", "wax: not a result: no separation.json"),
    ],
)
def test_what_is_not_there_is_named(capture, tmp_path, capsys, words, line):
    out = "out=there.png" if words.startswith("compare") else "out=there"
    assert main([*words.split(), out]) == 1
    assert last_line(capsys.readouterr().err).startswith(line)
    assert [path.name for path in tmp_path.iterdir()] == ["wax"]
