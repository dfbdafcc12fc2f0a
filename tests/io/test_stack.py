import pytest
import torch

from reflectsep.errors import CaptureError
from reflectsep.io.capture import load_capture, write_manifest
from reflectsep.io.pictures import write_picture
from reflectsep.io.stack import read_dark, read_full, read_mask, read_sweep_dark


def test_full_pictures_in_the_order_of_names(tiny):
    raw = read_full(load_capture(tiny.folder))
    assert raw.names == ("L3", "L1", "L2", "L4")
    assert raw.exposure_s == (0.01,) * 4
    assert torch.equal(raw.values, torch.stack([tiny.picture(value) for value in (3.0, 1.0, 2.0, 4.0)]))
    assert not raw.saturated.any()


def test_colour_and_equal_channels_stay_colour(colour):
    for name in ("L1", "L2", "L3", "L4"):
        write_picture(colour.folder / f"full/{name}.exr", colour.picture(1.0)[:1].expand(3, -1, -1))
    assert read_full(load_capture(colour.folder)).values.shape == (4, 3, 4, 5)


def test_clipped_values(tiny):
    for name in ("L1", "L2", "L3", "L4"):
        picture = torch.full((1, 4, 5), 0.5)
        picture[0, 1, 2] = 1
        write_picture(tiny.folder / f"full/{name}.png", picture)
    tiny.rewrite({**tiny.document(), "images": [{**p, "file": p["file"].replace("exr", "png")} for p in full(tiny)]})
    raw = read_full(load_capture(tiny.folder))
    assert raw.saturated.sum() == 4
    assert raw.saturated[:, 0, 1, 2].all()


def full(tiny):
    return [picture for picture in tiny.document()["images"] if picture["kind"] == "full"]


def test_wrong_size(tiny):
    write_picture(tiny.folder / "full/L3.exr", torch.ones(1, 3, 7))
    with pytest.raises(CaptureError, match=r"full/L3\.exr: 7x3, but the manifest says 5x4"):
        read_full(load_capture(tiny.folder))


def test_wrong_size_without_a_size_in_the_manifest(tiny):
    tiny.change(lambda document: document.pop("size"))
    read_full(load_capture(tiny.folder))
    write_picture(tiny.folder / "full/L4.exr", torch.ones(1, 3, 7))
    with pytest.raises(CaptureError, match=r"full/L4\.exr: 7x3, but the first picture is 5x4"):
        read_full(load_capture(tiny.folder))


def test_mixed_channels(tiny):
    write_picture(tiny.folder / "full/L2.exr", torch.ones(3, 4, 5))
    with pytest.raises(CaptureError, match=r"full/L2\.exr: 3 channels, but the full pictures have 1 channel"):
        read_full(load_capture(tiny.folder))


def test_all_zero(tiny):
    picture = torch.zeros(1, 4, 5)
    picture[0, 0, 0] = torch.nan
    write_picture(tiny.folder / "full/L2.exr", picture)
    with pytest.raises(CaptureError, match=r"full/L2\.exr: every pixel is zero"):
        read_full(load_capture(tiny.folder))


def test_some_values_that_are_no_numbers_are_passed_on(tiny):
    picture = tiny.picture(1.0)
    picture[0, 0, 0] = torch.inf
    write_picture(tiny.folder / "full/L1.exr", picture)
    assert read_full(load_capture(tiny.folder)).values.isnan().nonzero().tolist() == [[1, 0, 0, 0]]


def test_truncated(tiny):
    data = (tiny.folder / "full/L1.exr").read_bytes()
    (tiny.folder / "full/L1.exr").write_bytes(data[: len(data) // 2])
    with pytest.raises(CaptureError, match=r"full/L1\.exr: .*(truncated|cut off)"):
        read_full(load_capture(tiny.folder))


@pytest.mark.parametrize(
    ("file", "read"),
    [
        ("full/L1.exr", read_full),
        ("dark.exr", lambda capture: read_dark(capture, 0.01)),
        ("mask.png", read_mask),
    ],
)
def test_recorded_checksums_are_asked(tiny, file, read):
    write_manifest(tiny.folder, load_capture(tiny.folder))
    read(load_capture(tiny.folder))
    channels = tiny.picture(0.75)
    write_picture(tiny.folder / file, channels)
    with pytest.raises(CaptureError, match=r"its SHA-256 is .* was recorded"):
        read(load_capture(tiny.folder))


def test_dark_by_exposure(tiny):
    capture = load_capture(tiny.folder)
    for exposure_s in (0.01, 0.01009, 0.00995, None):
        assert torch.equal(read_dark(capture, exposure_s), tiny.picture(0.25))
    for exposure_s in (0.16, 0.0102, 0.0098):
        assert read_dark(capture, exposure_s) is None


def test_several_darks(tiny):
    write_picture(tiny.folder / "dark2.exr", tiny.picture(0.75))
    write_picture(tiny.folder / "dark3.exr", tiny.picture(5.0))
    tiny.change(
        lambda document: document["images"].extend(
            [
                {"kind": "dark", "file": "dark2.exr", "exposure_s": 0.01},
                {"kind": "dark", "file": "dark3.exr", "exposure_s": 0.16},
            ]
        )
    )
    capture = load_capture(tiny.folder)
    assert torch.allclose(read_dark(capture, 0.01), tiny.picture(0.5))
    assert torch.equal(read_sweep_dark(capture, capture.sweeps[0]), tiny.picture(5.0))
    with pytest.raises(CaptureError, match="3 dark pictures, but the exposure of the picture is not known"):
        read_dark(capture, None)


def test_darks_of_unknown_exposure(tiny):
    tiny.change(lambda document: document["images"][-1].pop("exposure_s"))
    capture = load_capture(tiny.folder)
    assert torch.equal(read_dark(capture, None), tiny.picture(0.25))
    assert torch.equal(read_dark(capture, 0.3), tiny.picture(0.25))
    tiny.change(lambda document: document["images"].append({"kind": "dark", "file": "dark.exr", "exposure_s": 0.01}))
    with pytest.raises(CaptureError, match=r"2 dark pictures, but the exposure of dark picture dark\.exr is not known"):
        read_dark(load_capture(tiny.folder), 0.01)


def test_no_dark(tiny):
    tiny.change(lambda document: document["images"].pop())
    capture = load_capture(tiny.folder)
    assert read_dark(capture, 0.01) is None
    assert read_sweep_dark(capture, capture.sweeps[0]) is None


def test_dark_that_a_sweep_names(tiny):
    write_picture(tiny.folder / "other.exr", tiny.picture(0.5))
    tiny.change(lambda document: document["sweeps"][0].update(dark="other.exr"))
    capture = load_capture(tiny.folder)
    assert torch.equal(read_sweep_dark(capture, capture.sweeps[0]), tiny.picture(0.5))


def test_dark_of_another_size(tiny):
    write_picture(tiny.folder / "dark.exr", torch.ones(1, 4, 6))
    with pytest.raises(CaptureError, match=r"dark\.exr: 6x4, but the manifest says 5x4"):
        read_dark(load_capture(tiny.folder), 0.01)


def test_mask(tiny):
    mask = read_mask(load_capture(tiny.folder))
    assert mask.dtype == torch.bool
    assert mask.tolist() == [[False] * 5] + [[True] * 5] * 3
    write_picture(tiny.folder / "mask.png", torch.full((1, 4, 5), 0.4))
    with pytest.raises(CaptureError, match=r"mask\.png: the mask is empty"):
        read_mask(load_capture(tiny.folder))
    write_picture(tiny.folder / "mask.png", torch.ones(1, 5, 5))
    with pytest.raises(CaptureError, match=r"mask\.png: 5x5, but the manifest says 5x4"):
        read_mask(load_capture(tiny.folder))


@pytest.mark.parametrize("absent", ["mask", "size"])
def test_no_mask_is_everything(tiny, absent):
    tiny.change(lambda document: (document.pop("mask"), document.pop(absent, None)))
    mask = read_mask(load_capture(tiny.folder))
    assert mask.shape == (4, 5)
    assert mask.all()
