import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.data import Light
from reflectsep.errors import CaptureError, LightError
from reflectsep.io.capture import load_capture
from reflectsep.io.pictures import write_picture
from reflectsep.io.plain import best_basis
from reflectsep.io.stack import read_full, read_mask

VECTORS = ["0 0 1", "0.6 0 0.8", "0 0.6 0.8", "-0.6 0 0.8"]


def pictures(folder, names):
    for number, name in enumerate(names):
        write_picture(folder / name, torch.full((3, 2, 3), (number + 1) / 10))


def lp_folder(folder):
    names = [f"shot {number}.png" for number in range(4)]
    pictures(folder, names)
    lines = [f"{name} {vector}" for name, vector in zip(names, VECTORS, strict=True)]
    (folder / "list.lp").write_text("\n".join(["4", *lines]))
    return folder


def test_lp_folder(tmp_path):
    capture = load_capture(lp_folder(tmp_path / "coin"))
    assert capture.object == "coin"
    assert capture.size == (3, 2)
    assert capture.mask is None
    assert capture.sweeps == ()
    assert capture.full("shot 2").file == "shot 2.png"
    assert capture.basis == ("shot 1", "shot 2", "shot 3")
    assert read_mask(capture).all()
    raw = read_full(capture)
    assert raw.values[:, 0, 0, 0].tolist() == pytest.approx([51 / 255, 77 / 255, 102 / 255, 26 / 255], abs=1e-6)


def test_basis_by_name(tmp_path):
    folder = lp_folder(tmp_path)
    assert load_capture(folder, basis=("shot 3", "shot 0", "shot 2")).names == ("shot 3", "shot 0", "shot 2", "shot 1")
    for basis in (("shot 3", "shot 0"), ("shot 3", "shot 3", "shot 0"), ("shot 3", "shot 9", "shot 0")):
        with pytest.raises(LightError, match="basis"):
            load_capture(folder, basis=basis)


def test_lp_finds_files_that_moved_or_were_converted(tmp_path):
    pictures(tmp_path, ["a.png", "b.exr", "sub/c.png"])
    (tmp_path / "x.lp").write_text("3\nC:\\rti\\a.png 1 0 0\n/home/me/b.jpg 0 1 0\nsub/c.png 0 0 1\n")
    capture = load_capture(tmp_path)
    assert [picture.file for picture in capture.images] == ["a.png", "b.exr", "sub/c.png"]


def test_lp_may_not_lead_out_of_the_folder(tmp_path):
    pictures(tmp_path, ["a.png", "in/b.png"])
    (tmp_path / "in" / "x.lp").write_text("2\n../a.png 1 0 0\nb.png 0 1 0\n")
    with pytest.raises(CaptureError, match="leads out of the folder"):
        load_capture(tmp_path / "in")


def test_lp_errors(tmp_path):
    folder = lp_folder(tmp_path)
    (folder / "shot 2.png").rename(folder / "shot 2.tif")
    (folder / "shot 2.exr").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"names 'shot 2\.png'; several pictures for it: shot 2\.exr, shot 2\.tif"):
        load_capture(folder)
    for suffix in ("tif", "exr"):
        (folder / f"shot 2.{suffix}").unlink()
    with pytest.raises(CaptureError, match=r"names 'shot 2\.png'; no such picture"):
        load_capture(folder)
    (folder / "again.lp").write_text("")
    with pytest.raises(CaptureError, match=r"several lists of lights \(again\.lp, list\.lp\)"):
        load_capture(folder)


def test_no_list(tmp_path):
    pictures(tmp_path / "cat", ["a.png"])
    with pytest.raises(CaptureError, match="cat: no capture: neither"):
        load_capture(tmp_path / "cat")


def uw_folder(folder, where="parent"):
    pictures(folder, [f"cat.{number}.png" for number in range(4)])
    write_picture(folder / "cat.mask.png", torch.tensor([[[0, 1, 1], [0, 0, 1.0]]]).expand(3, 2, 3))
    place = folder.parent if where == "parent" else folder
    (place / "lights.txt").write_text("\n".join(["4", *VECTORS]))
    return folder


@pytest.mark.parametrize("where", ["parent", "here"])
def test_uw_folder(tmp_path, where):
    capture = load_capture(uw_folder(tmp_path / "cat", where))
    assert list(capture.lights) == ["0", "1", "2", "3"]
    assert capture.full("3").file == "cat.3.png"
    assert capture.basis == ("1", "2", "3")
    assert capture.mask == "cat.mask.png"
    assert read_mask(capture).tolist() == [[False, True, True], [False, False, True]]


def test_uw_with_another_list(tmp_path):
    folder = uw_folder(tmp_path / "cat")
    (tmp_path / "mine.txt").write_text("\n".join(["0 0 3", *VECTORS[1:]]))
    capture = load_capture(folder, lights_file=tmp_path / "mine.txt", basis=("0", "1", "2"))
    assert capture.lights["0"].direction == (0, 0, 1)
    assert capture.basis == ("0", "1", "2")


def test_uw_errors(tmp_path):
    folder = uw_folder(tmp_path / "cat")
    (folder / "cat.2.png").unlink()
    with pytest.raises(CaptureError, match=r"3 pictures, but .*lights\.txt has 4 lights: cat\.2 is missing"):
        load_capture(folder)
    pictures(folder, ["cat.2.png", "cat.4.png"])
    with pytest.raises(CaptureError, match=r"5 pictures, .*cat\.4\.png has no light"):
        load_capture(folder)
    pictures(folder, ["dog.0.png"])
    with pytest.raises(CaptureError, match="pictures of cat, dog"):
        load_capture(folder)
    (folder / "dog.0.png").rename(folder / "cat.0.exr")
    with pytest.raises(CaptureError, match="have the same number"):
        load_capture(folder)


def test_diligent_folder(tmp_path):
    names = [f"{number:03d}.png" for number in range(1, 5)]
    pictures(tmp_path, [*names, "mask.png"])
    (tmp_path / "filenames.txt").write_text("\n".join(names))
    (tmp_path / "light_directions.txt").write_text("\n".join(VECTORS))
    (tmp_path / "light_intensities.txt").write_text("1 2 3\n" * 4)
    capture = load_capture(tmp_path)
    assert capture.mask == "mask.png"
    assert capture.lights["004"] == Light(name="004", direction=(-0.6, 0, 0.8), intensity=(1, 2, 3))
    assert capture.full("004").file == "004.png"
    assert capture.basis == ("002", "003", "004")


def test_json_list(tmp_path):
    pictures(tmp_path, ["A.png", "B.png", "C.exr"])
    (tmp_path / "l.json").write_text(
        '{"lights": {"A": {"direction": [1,0,0]}, "B": {"direction": [0,1,0]}, "C": {"direction": [0,0,1]}}}'
    )
    capture = load_capture(tmp_path, lights_file=tmp_path / "l.json")
    assert [picture.file for picture in capture.images] == ["A.png", "B.png", "C.exr"]


def named(vectors):
    units = [np.array(vector) / np.linalg.norm(vector) for vector in vectors]
    return {str(i): Light(name=str(i), direction=tuple(map(float, unit))) for i, unit in enumerate(units)}


vectors = st.tuples(*[st.floats(-1, 1, width=16)] * 3).filter(lambda v: sum(x * x for x in v) > 0.01)


@given(vectors=st.lists(vectors, min_size=3, max_size=7))
def test_best_basis_is_the_best_of_all(vectors):
    lights = named(vectors)
    matrix = np.array([light.direction for light in lights.values()])
    best = min(np.linalg.cond(matrix[list(three)]) for three in itertools.combinations(range(len(lights)), 3))
    if best > 1e3:
        return
    chosen = best_basis(lights)
    assert np.linalg.cond(matrix[[int(name) for name in chosen]]) == pytest.approx(best, rel=1e-6)
    assert list(chosen) == sorted(chosen, key=int)


def test_best_basis_of_equals_is_the_first():
    assert best_basis(named([(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 1), (-1, 0, 0)])) == ("0", "1", "2")


def test_best_basis_of_many_lights():
    generator = np.random.default_rng(0)
    lights = named([*generator.normal(size=(250, 3)), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
    assert best_basis(lights) == ("250", "251", "252")


def test_no_basis():
    with pytest.raises(LightError, match="2 lights with a direction; a basis needs 3"):
        best_basis(named([(0, 0, 1), (0, 1, 0)]))
    with pytest.raises(LightError, match=r"all 4 lights lie in one plane: .* condition number"):
        best_basis(named([(0, 0, 1), (0, 1, 0), (0, 1, 1), (0, 1, 2)]))
