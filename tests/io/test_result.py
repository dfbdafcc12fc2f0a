import hashlib
import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from reflectsep.errors import ResultError
from reflectsep.io.pictures import read_picture
from reflectsep.io.result import read_document, read_result, write_result

arrays = st.sampled_from([np.float32, np.uint32]).flatmap(lambda kind: hnp.arrays(kind, (3, 4)))
channels = st.dictionaries(st.sampled_from(["L1.R", "L1.G", "L2.Y", "flags", "B"]), arrays, min_size=1)


def example(out, overwrite=False, value=1.0):
    layers = {"specular.exr": {"L1.Y": np.full((2, 3), value, np.float32)}}
    write_result(out, layers, {"n_d": 1.0}, overwrite, {"specular": torch.full((1, 2, 3), 0.5)})


@given(layers=st.dictionaries(st.sampled_from(["a.exr", "b.exr"]), channels, min_size=1))
def test_round_trip_bit_for_bit(tmp_path_factory, layers):
    out = tmp_path_factory.mktemp("result") / "out"
    document = {"n_s": 14.25, "covariance": [[1e-300, 0.1]], "name": "wächsern"}
    write_result(out, layers, document, False)
    back, read = read_result(out, list(layers))
    assert {key: read[key] for key in document} == document
    assert read["format"] == "reflectsep-result/2"
    assert set(read["checksums"]) == set(layers)
    for name, planes in layers.items():
        assert set(back[name]) == set(planes)
        for channel, plane in planes.items():
            assert back[name][channel].dtype == plane.dtype
            assert back[name][channel].tobytes() == plane.tobytes()


def test_previews_and_names(tmp_path):
    example(tmp_path / "out")
    names = sorted(str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*") if path.is_file())
    assert names == ["previews/specular.png", "separation.json", "specular.exr"]
    values, _ = read_picture(tmp_path / "out" / "previews" / "specular.png")
    assert values.shape == (1, 2, 3)
    assert values[0, 0, 0].item() == pytest.approx(128 / 255)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_refuses_to_replace_unless_asked(tmp_path):
    example(tmp_path / "out")
    with pytest.raises(ResultError, match="overwrite=true"):
        example(tmp_path / "out", value=2.0)
    assert read_result(tmp_path / "out", ["specular.exr"])[0]["specular.exr"]["L1.Y"][0, 0] == 1
    example(tmp_path / "out", overwrite=True, value=2.0)
    assert read_result(tmp_path / "out", ["specular.exr"])[0]["specular.exr"]["L1.Y"][0, 0] == 2


@pytest.mark.parametrize(
    ("layers", "document", "previews", "error"),
    [
        ({"a.exr": {"Y": np.zeros((2, 2))}}, {}, {}, ValueError),
        ({"../a.exr": {"Y": np.zeros((2, 2), np.float32)}}, {}, {}, ResultError),
        ({"a.exr": {"Y": np.zeros((2, 2), np.float32)}}, {"x": float("nan")}, {}, ValueError),
        ({"a.exr": {"Y": np.zeros((2, 2), np.float32)}}, {"x": np.float32(1)}, {}, TypeError),
        ({"a.exr": {"Y": np.zeros((2, 2), np.float32)}}, {"format": "mine"}, {}, ValueError),
        ({"a.exr": {"Y": np.zeros((2, 2), np.float32)}}, {}, {"p": torch.full((1, 1, 1), torch.nan)}, ValueError),
        ({"a.exr": {"Y": np.zeros((2, 2), np.float32)}}, {}, {"../../p": torch.zeros(1, 1, 1)}, ResultError),
    ],
)
def test_nothing_half_written(tmp_path, layers, document, previews, error):
    example(tmp_path / "out")
    with pytest.raises(error):
        write_result(tmp_path / "out", layers, document, True, previews)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    read_result(tmp_path / "out", ["specular.exr"])


def test_damage_is_found(tmp_path):
    out = tmp_path / "out"
    example(out)
    data = (out / "specular.exr").read_bytes()
    (out / "specular.exr").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(ResultError, match=r"specular\.exr: damaged"):
        read_result(out, ["specular.exr"])
    (out / "specular.exr").unlink()
    with pytest.raises(ResultError, match=r"specular\.exr: missing"):
        read_result(out, ["specular.exr"])


def test_a_layer_that_is_not_of_the_result(tmp_path):
    example(tmp_path / "out")
    (tmp_path / "out" / "alien.exr").write_bytes((tmp_path / "out" / "specular.exr").read_bytes())
    with pytest.raises(ResultError, match=r"alien\.exr: missing; the result has specular\.exr"):
        read_result(tmp_path / "out", ["alien.exr"])
    with pytest.raises(ResultError, match="leads out of the folder"):
        read_result(tmp_path / "out", ["../x.exr"])


def test_recorded_garbage_is_a_result_error(tmp_path):
    out = tmp_path / "out"
    example(out)
    (out / "specular.exr").write_bytes(b"junk")
    document = json.loads((out / "separation.json").read_text())
    document["checksums"]["specular.exr"] = hashlib.sha256(b"junk").hexdigest()
    (out / "separation.json").write_text(json.dumps(document))
    with pytest.raises(ResultError, match="not an EXR file"):
        read_result(out, ["specular.exr"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"format": "reflectsep-result/1", "checksums": {}}', "format is 'reflectsep-result/1', expected"),
        ('{"format": "reflectsep-result/2"}', "no checksums"),
        ("[]", "format is None"),
        ("{", "not JSON"),
    ],
)
def test_foreign_documents(tmp_path, text, message):
    (tmp_path / "separation.json").write_text(text)
    with pytest.raises(ResultError, match=rf"separation\.json: {message}"):
        read_document(tmp_path)


def test_no_result(tmp_path):
    with pytest.raises(ResultError, match="not a result"):
        read_result(tmp_path / "none", [])
