import importlib.util
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from reflectsep.errors import CaptureError, MissingExtraError
from reflectsep.io.ahead import NO_LEAD, Lead
from reflectsep.io.capture import load_capture, write_manifest
from reflectsep.io.frames import open_sweep
from reflectsep.io.pictures import write_picture
from reflectsep.io.stack import read_full, read_mask

needs_av = pytest.mark.skipif(importlib.util.find_spec("av") is None, reason="PyAV is an extra")


def opened(tiny):
    capture = load_capture(tiny.folder)
    return open_sweep(capture, capture.sweeps[0])


def test_frames_as_often_as_wanted(tiny):
    stream = opened(tiny)
    assert len(stream) == 3
    assert stream.sweep.light == "L1"
    for _ in range(2):
        frames = list(stream)
        assert [frame.index for frame in frames] == [0, 1, 2]
        for frame in frames:
            assert torch.equal(frame.values, tiny.picture(frame.index / 8))
            assert not frame.saturated.any()


@pytest.mark.parametrize(("lead", "most"), [(NO_LEAD, 1), (Lead(threads=1, held=1), 2)])
def test_no_more_frames_than_asked_for(tiny, monkeypatch, lead, most):
    read = []
    from reflectsep.io import frames

    real = frames.read_picture
    monkeypatch.setattr(frames, "read_picture", lambda path, *rest: read.append(path.name) or real(path, *rest))
    iterator = iter(replace(opened(tiny), lead=lead))
    read.clear()
    next(iterator)
    assert 1 <= len(read) <= most
    assert read == ["0000.exr", "0001.exr"][: len(read)]


def test_lost_frames_are_left_out(tiny):
    (tiny.folder / "sweep/L1/0001.exr").unlink()
    tiny.change(lambda document: document["sweeps"][0].update(time_s=[0, None, 2]))
    stream = opened(tiny)
    assert len(stream) == 3
    assert [frame.index for frame in stream] == [0, 2]


def test_clipped_frames_of_16_bit_png(tiny):
    for index in range(3):
        picture = torch.full((1, 4, 5), 0.5)
        picture[0, 0, index] = 1
        write_picture(tiny.folder / f"sweep/L1/{index}.png", picture, bits=16)
    tiny.change(lambda document: document["sweeps"][0].update(frames="sweep/L1/{}.png"))
    for frame in opened(tiny):
        assert frame.saturated.nonzero().tolist() == [[0, 0, frame.index]]
        assert frame.values[0, 3, 4].item() == pytest.approx(32768 / 65535)


def broken(kind, path):
    data = path.read_bytes()
    if kind == "missing":
        path.unlink()
    elif kind == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif kind == "size":
        write_picture(path, torch.ones(1, 5, 5))
    elif kind == "channels":
        write_picture(path, torch.ones(3, 4, 5))
    else:
        write_picture(path, torch.full((1, 4, 5), torch.nan))


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "no such file"),
        ("truncated", "truncated|cut off"),
        ("size", "5x5, but the manifest says 5x4"),
        ("channels", "3 channels, but the full pictures have 1 channel"),
        ("nan", "not one finite value"),
    ],
)
def test_errors_name_the_frame(tiny, kind, message):
    stream = opened(tiny)
    broken(kind, tiny.folder / "sweep/L1/0001.exr")
    iterator = iter(stream)
    next(iterator)
    with pytest.raises(CaptureError, match=rf"sweep/L1/0001\.exr: .*({message})|sweep/L1/0001\.exr: ({message})"):
        next(iterator)


def test_recorded_checksums_are_asked(tiny):
    write_manifest(tiny.folder, load_capture(tiny.folder))
    assert len(list(opened(tiny))) == 3
    write_picture(tiny.folder / "sweep/L1/0002.exr", tiny.picture(7.0))
    with pytest.raises(CaptureError, match=r"0002\.exr: its SHA-256"):
        list(opened(tiny))


def film(path, pictures, pixel_format, codec="ffv1"):
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options={"level": "3", "slicecrc": "1"})
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pixel_format
        for picture in pictures:
            deep = picture.dtype == np.uint16
            form = {2: "gray16le" if deep else "gray", 3: "rgb48le" if deep else "rgb24"}[picture.ndim]
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format=form)):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def with_video(tiny, pictures, pixel_format="gray16le", **entries):
    path = tiny.folder / "sweep" / "L1.mkv"
    film(path, pictures, pixel_format)
    sweep = {"light": "L1", "video": "sweep/L1.mkv", "fps": 25, "count": len(pictures), **entries}
    tiny.change(lambda document: document.update(sweeps=[sweep]))
    return path


def noise(count, kind=np.uint16, shape=(4, 5)):
    generator = np.random.default_rng(3)
    return [generator.integers(0, np.iinfo(kind).max, shape, dtype=kind, endpoint=True) for _ in range(count)]


@needs_av
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_grey_video_is_exact(tiny, kind):
    pictures = noise(4, kind)
    pictures[2][1, 3] = np.iinfo(kind).max
    with_video(tiny, pictures, "gray" if kind == np.uint8 else "gray16le")
    stream = opened(tiny)
    for _ in range(2):
        frames = list(stream)
        assert [frame.index for frame in frames] == [0, 1, 2, 3]
        for frame, picture in zip(frames, pictures, strict=True):
            stored = np.rint(frame.values[0].double().numpy() * np.iinfo(kind).max)
            np.testing.assert_array_equal(stored, picture)
            np.testing.assert_array_equal(frame.saturated[0].numpy(), picture == np.iinfo(kind).max)


@needs_av
def test_video_of_ten_bits_is_over_its_own_largest_value(tiny):
    with_video(tiny, [np.full((4, 5), 65535, np.uint16)] * 2, "gray10le")
    for frame in opened(tiny):
        assert (frame.values == 1).all()
        assert frame.saturated.all()


@needs_av
@pytest.mark.parametrize(("kind", "pixel_format"), [(np.uint8, "bgr0"), (np.uint16, "gbrp16le")])
def test_colour_video_is_exact(colour, kind, pixel_format):
    pictures = noise(2, kind, (4, 5, 3))
    with_video(colour, pictures, pixel_format)
    for frame, picture in zip(opened(colour), pictures, strict=True):
        stored = np.rint(frame.values.double().numpy() * np.iinfo(kind).max)
        np.testing.assert_array_equal(stored, picture.transpose(2, 0, 1))


@needs_av
def test_video_start_and_lost_frames(tiny):
    pictures = noise(6)
    with_video(tiny, pictures, start=2, count=4, time_s=[0, None, 2, 3])
    frames = list(opened(tiny))
    assert [frame.index for frame in frames] == [0, 2, 3]
    for frame, picture in zip(frames, pictures[2:5], strict=True):
        np.testing.assert_array_equal(np.rint(frame.values[0].double().numpy() * 65535), picture)


@needs_av
def test_short_video(tiny):
    with_video(tiny, noise(3), count=4, start=1)
    with pytest.raises(CaptureError, match=r"L1\.mkv: 3 frames, but the manifest needs 5"):
        list(opened(tiny))


@needs_av
def test_video_of_another_size_or_colour(tiny):
    with_video(tiny, noise(2, shape=(4, 6)))
    with pytest.raises(CaptureError, match=r"L1\.mkv, frame 0: 6x4, but the manifest says 5x4"):
        list(opened(tiny))
    with_video(tiny, noise(2, np.uint8, (4, 5, 3)), "bgr0")
    with pytest.raises(CaptureError, match=r"L1\.mkv, frame 0: 3 channels"):
        list(opened(tiny))


@needs_av
def test_video_cut_off_damaged_or_no_video(tiny):
    path = with_video(tiny, noise(8))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(CaptureError, match=r"L1\.mkv: "):
        list(opened(tiny))
    path.write_bytes(b"nothing like a film")
    with pytest.raises(CaptureError, match=r"L1\.mkv: cannot be decoded"):
        list(opened(tiny))
    path.unlink()
    with pytest.raises(CaptureError, match=r"L1\.mkv: no such file"):
        load_capture(tiny.folder)


@needs_av
def test_damaged_slice_is_not_patched_up(tiny):
    path = with_video(tiny, noise(8, shape=(4, 5)))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(CaptureError, match=r"L1\.mkv: cannot be decoded at frame \d of the video: .*CRC"):
        list(opened(tiny))


@needs_av
def test_white_of_deep_yuv_is_clipped(colour):
    with_video(colour, [np.full((4, 5, 3), 65535, np.uint16), np.zeros((4, 5, 3), np.uint16)], "yuv444p10le")
    white, black = opened(colour)
    assert (white.values == 1).all()
    assert white.saturated.all()
    assert (black.values < 0.001).all()
    assert not black.saturated.any()


@needs_av
def test_video_checksum(tiny):
    path = with_video(tiny, noise(2))
    written = write_manifest(tiny.folder, load_capture(tiny.folder))
    assert len(list(open_sweep(written, written.sweeps[0]))) == 2
    film(path, noise(3), "gray16le")
    with pytest.raises(CaptureError, match=r"L1\.mkv: its SHA-256"):
        list(open_sweep(written, written.sweeps[0]))


def test_video_without_pyav(tiny, monkeypatch):
    (tiny.folder / "v.mkv").write_bytes(b"")
    tiny.change(lambda document: document.update(sweeps=[{"light": "L1", "video": "v.mkv", "count": 2}]))
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"v\.mkv: .*reflectsep\[video\]"):
        opened(tiny)


def test_only_the_window_of_a_frame_is_kept(tiny):
    capture = load_capture(tiny.folder, region=[1, 0, 3, 2])
    for frame in open_sweep(capture, capture.sweeps[0]):
        assert torch.equal(frame.values, tiny.picture(frame.index / 8)[:, 0:2, 1:4])
        assert frame.saturated is not None
        assert frame.saturated.shape == (1, 2, 3)
        assert frame.values.untyped_storage().nbytes() == 4 * 6  # the rest is let go
    raw = read_full(capture)
    assert torch.equal(raw.values, read_full(load_capture(tiny.folder)).values[..., 0:2, 1:4])
    assert read_mask(capture).shape == (2, 3)
