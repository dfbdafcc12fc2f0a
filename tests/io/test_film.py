"""Films: what is read back, by another decoder where there is one, is what was written."""

import importlib.util
import sys

import numpy as np
import pytest
from PIL import Image

from reflectsep.errors import MissingExtraError, ResultError
from reflectsep.io.film import SUFFIX, require_film, write_film

needs_av = pytest.mark.skipif(importlib.util.find_spec("av") is None, reason="PyAV is an extra")


def smooth_frames(count=5, height=33, width=47, dtype=np.uint8, grey=False):
    """A gradient that moves."""
    most = np.iinfo(dtype).max
    y, x = np.mgrid[:height, :width]
    for k in range(count):
        planes = [(0.5 + 0.5 * np.sin(0.1 * x + 0.07 * y + 0.6 * k + c * (not grey))) * most for c in range(3)]
        yield np.stack(planes, -1).astype(dtype)


def decoded(path, form):
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        return [frame.to_ndarray(format=form) for frame in container.decode(stream)], float(stream.average_rate)


def test_a_grey_gif_is_exact_and_loops(tmp_path):
    path = tmp_path / "film.gif"
    frames = list(smooth_frames(grey=True))
    assert write_film(path, iter(frames), kind="gif", fps=20) == 5
    with Image.open(path) as film:
        assert film.n_frames == 5
        assert film.info["loop"] == 0
        for k, frame in enumerate(frames):
            film.seek(k)
            assert film.info["duration"] == 50
            assert np.array_equal(np.asarray(film.convert("RGB")), frame)


def test_a_coloured_gif_is_near(tmp_path):
    path = tmp_path / "film.gif"
    frames = list(smooth_frames())
    write_film(path, iter(frames), kind="gif", fps=10)
    with Image.open(path) as film:
        for k, frame in enumerate(frames):
            film.seek(k)
            assert np.abs(np.asarray(film.convert("RGB")).astype(int) - frame).mean() < 8


@needs_av
def test_ffv1_is_exact_at_16_bits(tmp_path):
    path = tmp_path / f"film{SUFFIX['ffv1']}"
    frames = list(smooth_frames(dtype=np.uint16))
    write_film(path, iter(frames), kind="ffv1", fps=24)
    found, fps = decoded(path, "gbrp16le")
    assert fps == 24
    assert len(found) == 5
    for frame, back in zip(frames, found, strict=True):
        assert np.array_equal(back, frame)


@needs_av
def test_mp4_is_near_and_its_sizes_even(tmp_path):
    path = tmp_path / "film.mp4"
    frames = list(smooth_frames())
    write_film(path, iter(frames), kind="mp4", fps=25)
    found, fps = decoded(path, "rgb24")
    assert fps == 25
    assert [frame.shape for frame in found] == [(34, 48, 3)] * 5
    for frame, back in zip(frames, found, strict=True):
        # colour is stored at half the resolution
        assert np.abs(back[:33, :47].astype(int) - frame).mean() < 6


def test_no_frames_are_refused(tmp_path):
    with pytest.raises(ResultError, match="no picture to make a film of"):
        write_film(tmp_path / "film.gif", iter(()), kind="gif", fps=10)


def test_without_pyav_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'reflectsep\[video\]'"):
        require_film(tmp_path / "film.mp4", "mp4")
    require_film(tmp_path / "film.gif", "gif")
