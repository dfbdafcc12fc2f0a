import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.data import Light
from reflectsep.errors import CaptureError, LightError
from reflectsep.io.lights import read_lights, read_lp, write_lp

numbers = st.floats(-10, 10).filter(lambda x: x == 0 or abs(x) > 1e-3)
vectors = st.tuples(numbers, numbers, numbers).filter(any)
light_names = st.from_regex(r"[A-Za-z0-9_é][A-Za-z0-9_. é-]{0,8}[A-Za-z0-9_]", fullmatch=True)


def unit(vector):
    length = math.sqrt(sum(x * x for x in vector))
    return tuple(x / length for x in vector)


def lp(tmp_path, text, name="x.lp"):
    (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path / name


@given(given_vectors=st.dictionaries(light_names, vectors, min_size=1, max_size=5))
def test_lp_round_trip(tmp_path_factory, given_vectors):
    path = tmp_path_factory.mktemp("lp") / "x.lp"
    lights = {name: Light(name=name, direction=unit(vector)) for name, vector in given_vectors.items()}
    write_lp(path, lights)
    back = read_lights(path)
    assert list(back) == list(lights)
    for name, light in lights.items():
        assert back[name].direction == light.direction


def test_lp_lines_as_rigs_write_them(tmp_path):
    text = "\ufeff3 \r\nmy object 01.jpg 0,6 0,0 0,8\r\nC:\\rti\\b.jpg 0 0 2e0\r\n\r\n  d/e.f.tif\t-3 4 0\r\n\r\n"
    entries = read_lp(lp(tmp_path, text))
    assert [file for file, _ in entries] == ["my object 01.jpg", "C:\\rti\\b.jpg", "d/e.f.tif"]
    assert [light.name for _, light in entries] == ["my object 01", "b", "e.f"]
    expected = [(0.6, 0, 0.8), (0, 0, 1), (-0.6, 0.8, 0)]
    for (_, light), direction in zip(entries, expected, strict=True):
        assert light.direction == pytest.approx(direction)
        assert light.intensity == (1.0,)


def test_lp_names_are_longer_where_stems_repeat(tmp_path):
    assert list(read_lights(lp(tmp_path, "2\na.jpg 1 0 0\na.png 0 1 0\n"))) == ["a.jpg", "a.png"]
    assert list(read_lights(lp(tmp_path, "2\nx/a.jpg 1 0 0\ny/a.jpg 0 1 0\n"))) == ["x/a.jpg", "y/a.jpg"]
    with pytest.raises(CaptureError, match=r"'a\.jpg' appears twice"):
        read_lights(lp(tmp_path, "2\na.jpg 1 0 0\na.jpg 0 1 0\n"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "begins with 'nothing'"),
        ("a.jpg 0 0 1\n", "begins with 'a.jpg 0 0 1', expected the number of lights"),
        ("0\n", "0 lights, but its first line says 0"),
        ("2\na.jpg 0 0 1\n", "1 lights, but its first line says 2"),
        ("1\na.jpg 0 0 1\nb.jpg 0 1 0\n", "2 lights, but its first line says 1"),
        ("1\na.jpg 0 0\n", "line 2: found 'a.jpg 0 0', expected: filename x y z"),
        ("1\na.jpg 0 z 1\n", "line 2: found '0 z 1', expected three numbers"),
        ("1\na.jpg 0 0 1e-9\n", "line 2: .* has no direction"),
        ("1\na.jpg 0 nan 1\n", "line 2: .* has no direction"),
        ("1\na.jpg inf 0 1\n", "line 2: .* has no direction"),
    ],
)
def test_lp_errors(tmp_path, text, message):
    with pytest.raises(CaptureError, match=rf"x\.lp: {message}"):
        read_lights(lp(tmp_path, text))


def test_write_lp_refuses(tmp_path):
    with pytest.raises(LightError, match="light L1 has no direction"):
        write_lp(tmp_path / "x.lp", {"L1": Light(name="L1")})
    with pytest.raises(ValueError, match="cannot be a file name"):
        write_lp(tmp_path / "x.lp", {"L1": Light(name="L1", direction=(0, 0, 1))}, {"L1": "a\nb"})
    assert list(tmp_path.iterdir()) == []


def test_write_lp_with_files(tmp_path):
    write_lp(tmp_path / "x.lp", {"L1": Light(name="L1", direction=(0, 0, 1))}, {"L1": "a b.jpg"})
    assert (tmp_path / "x.lp").read_text() == "1\na b.jpg 0.0 0.0 1.0\n"


@pytest.mark.parametrize("text", ["2\n3 0 4\n 0 0 5 \n", "3 0 4\n0 0 5\n"])
def test_uw(tmp_path, text):
    lights = read_lights(lp(tmp_path, text, "lights.txt"))
    assert list(lights) == ["0", "1"]
    assert lights["0"].direction == pytest.approx((0.6, 0, 0.8))


@pytest.mark.parametrize("text", ["3\n0 0 1\n", "1\n0 0\n", "1\n0 0 0\n", "", "1\n0 0 1 2\n"])
def test_uw_errors(tmp_path, text):
    with pytest.raises(CaptureError, match=r"lights\.txt: "):
        read_lights(lp(tmp_path, text, "lights.txt"))


def diligent(folder):
    (folder / "filenames.txt").write_text("001.png\n002.png\n")
    (folder / "light_directions.txt").write_text("0 3 4\n0 0 1\n")
    (folder / "light_intensities.txt").write_text("1 2 3\n4 5 6\n")


def test_diligent(tmp_path):
    diligent(tmp_path)
    lights = read_lights(tmp_path)
    assert list(lights) == ["001", "002"]
    assert lights["001"].direction == pytest.approx((0, 0.6, 0.8))
    assert lights["002"].intensity == (4, 5, 6)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("filenames.txt", "001.png\n", "light_directions.txt: 2 lines, but filenames.txt has 1"),
        ("light_intensities.txt", "1 1 1\n", "light_intensities.txt: 1 lines"),
        (
            "light_intensities.txt",
            "1 1 1\n0 1 1\n",
            r"light_intensities.txt: light 002: intensity: found \[0.0, 1.0, 1.0\], expected three positive numbers$",
        ),
        ("light_directions.txt", "0 0 0\n0 0 1\n", "light_directions.txt: light 001: .* no direction"),
        ("filenames.txt", None, "filenames.txt: no such file"),
    ],
)
def test_diligent_errors(tmp_path, file, text, message):
    diligent(tmp_path)
    if text is None:
        (tmp_path / file).unlink()
    else:
        (tmp_path / file).write_text(text)
    with pytest.raises(CaptureError, match=message):
        read_lights(tmp_path)


def test_own_json(tmp_path):
    entries = {"A": {"direction": [0, 0, 2]}, "B": {"direction": [0, 3, 4], "intensity": 2}}
    entries["C"] = {"direction": [1, 0, 0], "intensity": [1, 2, 3]}
    lights = read_lights(lp(tmp_path, json.dumps({"lights": entries}), "x.json"))
    assert lights["A"] == Light(name="A", direction=(0, 0, 1))
    assert lights["B"].direction == pytest.approx((0, 0.6, 0.8))
    assert lights["B"].intensity == (2,)
    assert lights["C"].intensity == (1, 2, 3)


def test_alicevision_looks_down_and_into_the_scene(tmp_path):
    # Above the object (y up there is negative) and on the camera's side (z negative), numbers in quotes as it writes.
    entry = {"viewId": "77", "type": "directional", "direction": ["0", "-0.6", "-0.8"], "intensity": ["1", "2", "3"]}
    lights = read_lights(lp(tmp_path, json.dumps({"lights": [entry]}), "x.json"))
    assert lights == {"77": Light(name="77", direction=(0, 0.6, 0.8), intensity=(1, 2, 3))}


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([], "no lights in it"),
        ({"lights": 3}, "no lights in it"),
        ({"lights": {"A": {}}}, "light A: found {}"),
        ({"lights": {"A": {"direction": [0, 0, 1], "intensty": 2}}}, "light A: found"),
        ({"lights": {"A": {"direction": [0, 0]}}}, "light A: direction: .*3 numbers"),
        ({"lights": {"A": {"direction": ["0", "0", "1"]}}}, "light A: direction: .*3 numbers"),
        ({"lights": {"A": {"direction": [0, 0, True]}}}, "light A: direction: .*3 numbers"),
        ({"lights": {"A": {"direction": [0, 0, 0]}}}, "light A: direction: .* no direction"),
        (
            {"lights": {"A": {"direction": [0, 0, 1], "intensity": 0}}},
            "light A: intensity: found 0.0, expected a positive number$",
        ),
        (
            {"lights": [{"viewId": 7, "direction": [0, 0, 1], "intensity": ["0"]}]},
            r"lights\[0\]: intensity: found 0.0, expected a positive number$",
        ),
        ({"lights": [{"direction": [0, 0, 1], "type": "SH", "intensity": [1, 1, 1]}]}, "only directional"),
        ({"lights": [{"viewId": 1}]}, r"lights\[0\]: found"),
        ({"lights": [{"viewId": 1, "direction": ["a", 0, 1], "intensity": [1]}]}, "3 numbers"),
        ({"lights": [{"viewId": 1, "direction": [0, 0, 1], "intensity": [1]}] * 2}, "view 1 appears twice"),
    ],
)
def test_json_errors(tmp_path, document, message):
    with pytest.raises(CaptureError, match=rf"x\.json: .*{message}|x\.json: {message}"):
        read_lights(lp(tmp_path, json.dumps(document), "x.json"))


def test_unknown_and_missing(tmp_path):
    with pytest.raises(CaptureError, match=r"x\.xml: no list of lights"):
        read_lights(tmp_path / "x.xml")
    for name in ("x.lp", "x.txt", "x.json"):
        with pytest.raises(CaptureError, match="no such file"):
            read_lights(tmp_path / name)
