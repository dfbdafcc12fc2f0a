import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from reflectsep.errors import CaptureError
from reflectsep.io.exr import read_channels, write_channels

sizes = st.tuples(st.integers(1, 40), st.integers(1, 9))
types = st.sampled_from([np.float16, np.float32, np.uint32])
channel_names = st.lists(
    st.from_regex(r"[A-Za-z][A-Za-z0-9_.]{0,9}", fullmatch=True), min_size=1, max_size=9, unique=True
)


@st.composite
def channel_sets(draw):
    shape = draw(sizes)
    return {name: draw(hnp.arrays(draw(types), shape)) for name in draw(channel_names)}


@given(channels=channel_sets())
def test_round_trip_is_bit_for_bit(tmp_path_factory, channels):
    path = tmp_path_factory.mktemp("exr") / "x.exr"
    write_channels(path, channels)
    back = read_channels(path)
    assert set(back) == set(channels)
    for name, array in channels.items():
        wide = array if array.dtype == np.uint32 else array.astype(np.float32)
        assert back[name].dtype == wide.dtype
        assert back[name].flags.c_contiguous
        assert back[name].flags.owndata
        np.testing.assert_array_equal(back[name], wide)


def test_layouts_that_the_binding_writes_wrong(tmp_path):
    base = np.arange(7 * 12, dtype=np.float32).reshape(7, 12)
    layouts = {
        "flipped": base[::-1],
        "mirrored": base[:, ::-1],
        "fortran": np.asfortranarray(base),
        "strided": np.repeat(base, 2, axis=1)[:, ::2],
        "transposed": np.ascontiguousarray(base.T).T,
        "read_only": np.broadcast_to(base[:1], base.shape),
    }
    before = {name: array.copy() for name, array in layouts.items()}
    write_channels(tmp_path / "x.exr", layouts)
    back = read_channels(tmp_path / "x.exr")
    assert list(layouts) == list(before)
    for name, array in before.items():
        np.testing.assert_array_equal(back[name], array)
        assert layouts[name] is not back[name]


def test_types_in_the_file_are_kept(tmp_path):
    kinds = {"h": np.float16, "f": np.float32, "u": np.uint32}
    write_channels(tmp_path / "x.exr", {name: np.ones((3, 4), kind) for name, kind in kinds.items()})
    with OpenEXR.File(str(tmp_path / "x.exr"), separate_channels=True) as file:
        assert {name: channel.pixels.dtype.type for name, channel in file.channels().items()} == kinds
        assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION


def test_attributes_may_be_numpy_scalars(tmp_path):
    attributes = {"n": np.int64(3), "x": np.float64(0.5), "t": "text"}
    write_channels(tmp_path / "x.exr", {"Y": np.zeros((2, 2), np.float32)}, attributes)
    with OpenEXR.File(str(tmp_path / "x.exr")) as file:
        assert [file.header()[key] for key in ("n", "x", "t")] == [3, 0.5, "text"]
    assert list(attributes) == ["n", "x", "t"]


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({}, "no channels"),
        ({"Y": np.zeros((2, 2))}, "float64"),
        ({"Y": np.zeros((2, 2), np.uint8)}, "uint8"),
        ({"Y": np.zeros((2, 2, 1), np.float32)}, "shape"),
        ({"Y": np.zeros((0, 2), np.float32)}, "shape"),
        ({"Y": np.zeros((2, 2), np.float32), "Z": np.zeros((2, 3), np.float32)}, "channel Z has shape"),
        ({"": np.zeros((2, 2), np.float32)}, "no channel name"),
        ({"ß": np.zeros((2, 2), np.float32)}, "no channel name"),
    ],
)
def test_refuses_what_it_would_write_wrong(tmp_path, channels, message):
    with pytest.raises(ValueError, match=message):
        write_channels(tmp_path / "x.exr", channels)
    assert list(tmp_path.iterdir()) == []


def noisy(path):
    pixels = np.random.default_rng(0).random((50, 30)).astype(np.float32)
    write_channels(path, {"Y": pixels, "Z": pixels})
    return path.read_bytes()


def test_every_truncation_is_an_error_without_a_word_from_the_library(tmp_path, capfd):
    data = noisy(tmp_path / "whole.exr")
    path = tmp_path / "cut.exr"
    for length in [*range(0, 400, 7), *range(400, len(data), 997), len(data) - 1]:
        path.write_bytes(data[:length])
        with pytest.raises(CaptureError, match=r"cut\.exr: "):
            read_channels(path)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def test_damage_inside_is_an_error(tmp_path):
    data = bytearray(noisy(tmp_path / "x.exr"))
    middle = len(data) // 2
    data[middle : middle + 40] = bytes(40)
    (tmp_path / "x.exr").write_bytes(data)
    with pytest.raises(CaptureError, match=r"x\.exr: damaged pixel data"):
        read_channels(tmp_path / "x.exr")


@pytest.mark.parametrize("data", [b"", b"not a picture at all", b"\x76\x2f\x31\x01" + b"\xff" * 500])
def test_garbage(tmp_path, data):
    (tmp_path / "x.exr").write_bytes(data)
    with pytest.raises(CaptureError, match=r"x\.exr: "):
        read_channels(tmp_path / "x.exr")


def test_missing(tmp_path):
    with pytest.raises(CaptureError, match=r"none\.exr: no such file"):
        read_channels(tmp_path / "none.exr")


def test_several_parts_are_refused(tmp_path):
    def part(name):
        return OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"Y": np.ones((4, 4), np.float32)}, name)

    with OpenEXR.File([part("a"), part("b")]) as file:
        file.write(str(tmp_path / "x.exr"))
    with pytest.raises(CaptureError, match="2 parts"):
        read_channels(tmp_path / "x.exr")


@pytest.mark.parametrize("name", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "DWAA", "DWAB"])
def test_every_compression_is_read(tmp_path, name):
    pixels = np.linspace(0, 1, 300 * 5, dtype=np.float32).reshape(300, 5)
    header = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Y": pixels.copy()}) as file:
        file.write(str(tmp_path / "x.exr"))
    np.testing.assert_allclose(read_channels(tmp_path / "x.exr")["Y"], pixels, atol=0.02)
