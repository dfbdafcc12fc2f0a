import imagecodecs
import numpy as np
import pytest
import tifffile
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from reflectsep.errors import CaptureError
from reflectsep.io.exr import read_channels, write_channels
from reflectsep.io.files import sha256
from reflectsep.io.pictures import read_picture, write_picture

shapes = st.tuples(st.sampled_from([1, 3]), st.integers(1, 7), st.integers(1, 5))
codes = st.sampled_from([np.uint8, np.uint16]).flatmap(lambda kind: hnp.arrays(kind, shapes))


def noise(kind=np.uint8, shape=(40, 30, 3)):
    return np.random.default_rng(1).integers(0, np.iinfo(kind).max, shape, dtype=kind)


@given(picture=codes)
def test_png_round_trip_of_codes(tmp_path_factory, picture):
    path = tmp_path_factory.mktemp("png") / "x.png"
    write_picture(path, torch.from_numpy(picture))
    values, saturated = read_picture(path)
    largest = np.iinfo(picture.dtype).max
    assert values.dtype == torch.float32
    assert values.shape == picture.shape
    np.testing.assert_array_equal(np.rint(values.double().numpy() * largest), picture)
    np.testing.assert_array_equal(saturated.numpy(), picture == largest)


@given(picture=hnp.arrays(np.float32, shapes, elements=st.floats(-(2.0**99), 2.0**99, width=32)))
def test_exr_round_trip(tmp_path_factory, picture):
    path = tmp_path_factory.mktemp("exr") / "x.exr"
    write_picture(path, torch.from_numpy(picture))
    values, saturated = read_picture(path)
    np.testing.assert_array_equal(values.numpy(), picture)
    assert not saturated.any()


@pytest.mark.parametrize(("kind", "stored"), [(torch.float16, np.float16), (torch.float32, np.float32)])
def test_exr_depth_is_that_of_the_tensor(tmp_path, kind, stored):
    write_picture(tmp_path / "x.exr", torch.full((3, 2, 4), 0.1, dtype=kind))
    assert list(read_channels(tmp_path / "x.exr")) == ["B", "G", "R"]
    assert read_picture(tmp_path / "x.exr")[0][0, 0, 0].item() == np.float32(stored(0.1))


@pytest.mark.parametrize("bits", [8, 16])
def test_png_of_floats(tmp_path, bits):
    write_picture(tmp_path / "x.png", torch.tensor([[[-0.5, 0.0, 0.25, 1.0, 7.0]]]), bits=bits)
    values, saturated = read_picture(tmp_path / "x.png")
    quarter = round(0.25 * (2**bits - 1)) / (2**bits - 1)
    assert values[0, 0].tolist() == pytest.approx([0, 0, quarter, 1, 1], abs=1e-7)
    assert saturated[0, 0].tolist() == [False, False, False, True, True]


def test_rows_and_channels_stay_in_place(tmp_path):
    picture = torch.zeros(3, 4, 5)
    picture[0, 0, 1] = 1  # red, top row
    for name in ("x.png", "x.exr"):
        write_picture(tmp_path / name, picture)
        assert torch.equal(read_picture(tmp_path / name)[0], picture)


def save(path, pixels):
    if path.suffix == ".png":
        path.write_bytes(imagecodecs.png_encode(pixels))
    elif path.suffix == ".jpg":
        path.write_bytes(imagecodecs.jpeg8_encode(pixels))
    else:
        tifffile.imwrite(path, pixels, photometric="rgb", compression="zlib" if path.name.startswith("z") else None)


@pytest.mark.parametrize("channels", [2, 4])
def test_alpha_is_dropped(tmp_path, channels):
    pixels = noise(shape=(6, 5, channels))
    save(tmp_path / "x.png", pixels)
    values, _ = read_picture(tmp_path / "x.png")
    np.testing.assert_array_equal(np.rint(values.numpy() * 255), pixels[..., : channels - 1].transpose(2, 0, 1))


def test_exr_alpha_and_lone_channels(tmp_path):
    plane = np.arange(6, dtype=np.float32).reshape(2, 3)
    write_channels(tmp_path / "a.exr", {"Y": plane, "A": plane * 0})
    write_channels(tmp_path / "z.exr", {"radiance.mono": plane})
    write_channels(tmp_path / "b.exr", {"R": plane, "G": plane})
    for name in ("a.exr", "z.exr"):
        np.testing.assert_array_equal(read_picture(tmp_path / name)[0].numpy(), plane[None])
    with pytest.raises(CaptureError, match=r"b\.exr: channels G R; R G B or a single one"):
        read_picture(tmp_path / "b.exr")


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("name", ["x.tif", "z.tiff"])
def test_tiff(tmp_path, kind, name):
    pixels = noise(np.uint16, (6, 5, 3)).astype(kind)
    save(tmp_path / name, pixels)
    values, saturated = read_picture(tmp_path / name)
    largest = 1 if kind == np.float32 else np.iinfo(kind).max
    np.testing.assert_allclose(values.numpy() * largest, pixels.transpose(2, 0, 1), rtol=1e-6)
    np.testing.assert_array_equal(saturated.numpy(), (pixels.transpose(2, 0, 1) == largest) & (kind != np.float32))


def test_planar_tiff(tmp_path):
    planes = noise(np.uint16, (3, 6, 5))
    tifffile.imwrite(tmp_path / "x.tif", planes, photometric="rgb", planarconfig="separate")
    assert torch.equal(read_picture(tmp_path / "x.tif")[0], torch.from_numpy((planes / 65535.0).astype(np.float32)))


@pytest.mark.parametrize("pixels", [np.full((9, 8), 255, np.uint8), np.full((9, 8, 3), 255, np.uint8)])
def test_jpeg(tmp_path, pixels):
    save(tmp_path / "x.jpg", pixels)
    values, saturated = read_picture(tmp_path / "x.jpg")
    assert values.shape == (1 if pixels.ndim == 2 else 3, 9, 8)
    assert (values == 1).all()
    assert saturated.all()


@pytest.mark.parametrize("name", ["x.png", "x.jpg", "x.tif", "z.tif"])
def test_every_truncation_is_an_error(tmp_path, name):
    path = tmp_path / name
    save(path, noise())
    data = path.read_bytes()
    read_picture(path)
    for length in [0, 1, 5, 20, 100, len(data) // 2, len(data) * 9 // 10, len(data) - 2, len(data) - 1]:
        path.write_bytes(data[:length])
        with pytest.raises(CaptureError, match=name):
            read_picture(path)


def test_end_mark_of_a_thumbnail_does_not_end_a_jpeg(tmp_path):
    path = tmp_path / "x.jpg"
    save(path, noise())
    data = path.read_bytes()
    thumbnail = b"\xff\xd8\xff\xd9"
    app = b"\xff\xe1" + (2 + len(thumbnail)).to_bytes(2, "big") + thumbnail
    path.write_bytes(data[:2] + app + data[2:])
    read_picture(path)
    path.write_bytes((data[:2] + app + data[2:])[: len(data) // 2])
    with pytest.raises(CaptureError, match="truncated"):
        read_picture(path)


def test_values_that_are_no_numbers(tmp_path):
    plane = np.array([[np.nan, np.inf, -np.inf, 0.5]], np.float32)
    write_channels(tmp_path / "x.exr", {"Y": plane})
    values, _ = read_picture(tmp_path / "x.exr")
    assert values[0, 0].isnan().tolist() == [True, True, True, False]
    write_channels(tmp_path / "y.exr", {"Y": plane[:, :3]})
    with pytest.raises(CaptureError, match=r"y\.exr: not one finite value"):
        read_picture(tmp_path / "y.exr")
    with pytest.raises(ValueError, match="3 values are not numbers"):
        write_picture(tmp_path / "x.png", values)
    assert not (tmp_path / "x.png").exists()


def test_unknown_missing_and_foreign_files(tmp_path):
    (tmp_path / "x.psd").write_bytes(b"raw")
    (tmp_path / "x.png").write_bytes(b"GIF89a")
    tifffile.imwrite(tmp_path / "x.tif", np.zeros((4, 4), np.int32))
    tifffile.imwrite(tmp_path / "w.tif", np.zeros((4, 4), np.uint8), photometric="miniswhite")
    for name, message in {
        "x.psd": "suffix '.psd'",
        "none.png": "no such file",
        "x.png": "not a readable PNG",
        "x.tif": "int32",
        "w.tif": "photometric",
    }.items():
        with pytest.raises(CaptureError, match=rf"{name}: .*{message}"):
            read_picture(tmp_path / name)


def test_checksum_is_asked(tmp_path):
    write_picture(tmp_path / "x.png", torch.ones(1, 2, 2))
    read_picture(tmp_path / "x.png", sha256(tmp_path / "x.png").upper())
    with pytest.raises(CaptureError, match=r"x\.png: its SHA-256 is"):
        read_picture(tmp_path / "x.png", "0" * 64)


@pytest.mark.parametrize("shape", [(2, 3, 3), (1, 0, 2)])
def test_writes_pictures_only(tmp_path, shape):
    for name in ("x.png", "x.exr"):
        with pytest.raises(ValueError, match="shape"):
            write_picture(tmp_path / name, torch.zeros(shape))
    with pytest.raises(ValueError, match="bits"):
        write_picture(tmp_path / "x.png", torch.zeros(1, 2, 2), bits=12)
    with pytest.raises(ValueError, match=r"\.exr or \.png"):
        write_picture(tmp_path / "x.bmp", torch.zeros(1, 2, 2))
