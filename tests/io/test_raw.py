"""Camera raw, on a DNG written tag by tag."""

import builtins

import numpy as np
import pytest
import tifffile

from reflectsep.errors import CaptureError, MissingExtraError
from reflectsep.io.pictures import read_picture

WHITE = 4095


def write_dng(path, mosaic, black=0):
    """The least that a DNG of a red-green-blue-green sensor needs."""
    unit = (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1)
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True),  # DNGVersion
        (50708, "s", 0, "Handmade", True),  # UniqueCameraModel
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, (0, 1, 1, 2), True),  # CFAPattern: R G / G B
        (50714, "H", 1, black, True),  # BlackLevel
        (50717, "H", 1, WHITE, True),  # WhiteLevel
        (50721, "2i", 9, unit, True),  # ColorMatrix1
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),  # AsShotNeutral
    ]
    tifffile.imwrite(path, mosaic.astype(np.uint16), photometric=32803, extratags=tags, metadata=None)


def flat(red, green, blue, size=48):
    mosaic = np.full((size, size), green)
    mosaic[0::2, 0::2] = red
    mosaic[1::2, 1::2] = blue
    return mosaic


@pytest.mark.parametrize("level", [400, 1000, 3000])
def test_values_are_linear_and_of_the_camera_s_own_colours(tmp_path, level):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "x.dng", flat(level, level // 2, level // 4))
    values, clipped = read_picture(tmp_path / "x.dng")
    assert tuple(values.shape) == (3, 48, 48)
    expected = [level / WHITE, level // 2 / WHITE, level // 4 / WHITE]
    assert values[:, 20, 20].tolist() == pytest.approx(expected, abs=2e-4)
    assert not clipped.any()


def test_black_level_is_subtracted(tmp_path):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "x.dng", flat(1200, 1200, 1200), black=200)
    values, _ = read_picture(tmp_path / "x.dng")
    assert values[:, 20, 20].tolist() == pytest.approx([1000 / (WHITE - 200)] * 3, abs=3e-4)


def test_values_that_touch_a_clipped_site_are_marked(tmp_path):
    pytest.importorskip("rawpy")
    mosaic = flat(500, 500, 500)
    mosaic[20, 20] = WHITE
    write_dng(tmp_path / "x.dng", mosaic)
    _, clipped = read_picture(tmp_path / "x.dng")
    assert clipped[1].nonzero().tolist() == [[r, c] for r in (19, 20, 21) for c in (19, 20, 21)]


def test_broken_file_is_named(tmp_path):
    pytest.importorskip("rawpy")
    (tmp_path / "x.nef").write_bytes(b"no camera ever wrote this")
    with pytest.raises(CaptureError, match=r"x\.nef: not a readable camera raw file"):
        read_picture(tmp_path / "x.nef")


def test_without_rawpy_the_extra_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "rawpy":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    (tmp_path / "x.dng").write_bytes(b"")
    with pytest.raises(MissingExtraError, match=r"x\.dng: camera raw needs rawpy: pip install 'reflectsep\[raw\]'"):
        read_picture(tmp_path / "x.dng")
