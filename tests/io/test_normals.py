"""Known normals from MATLAB files."""

import builtins

import numpy as np
import pytest

from reflectsep.errors import CaptureError, MissingExtraError
from reflectsep.io.normals import read_normals

scipy_io = pytest.importorskip("scipy.io")


@pytest.fixture
def normals():
    array = np.zeros((4, 5, 3))
    array[1:3, 1:4] = [0.6, 0.0, 0.8]
    return array


def test_normals_and_where_they_are(tmp_path, normals):
    normals[2, 2] *= 1.001  # as stored in single precision elsewhere
    scipy_io.savemat(tmp_path / "Normal_gt.mat", {"Normal_gt": normals})
    found, there = read_normals(tmp_path / "Normal_gt.mat")
    assert tuple(found.shape) == (3, 4, 5)
    assert there.sum() == 6
    assert found[:, 2, 2].tolist() == pytest.approx([0.6, 0.0, 0.8], abs=1e-6)
    assert not found[:, ~there].any()


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"other": np.zeros((2, 2, 3))}, "no array Normal_gt in it"),
        ({"Normal_gt": np.zeros((2, 2))}, r"float64 of shape \(2, 2\), expected \(height, width, 3\)"),
        ({"Normal_gt": np.zeros((2, 2, 3))}, "not one normal"),
    ],
)
def test_broken_ones_say_what_is_wrong(tmp_path, variables, message):
    scipy_io.savemat(tmp_path / "n.mat", variables)
    with pytest.raises(CaptureError, match=rf"n\.mat: .*{message}"):
        read_normals(tmp_path / "n.mat")


def test_no_matlab_file_at_all(tmp_path):
    (tmp_path / "n.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    with pytest.raises(CaptureError, match=r"n\.mat: not a readable MATLAB file"):
        read_normals(tmp_path / "n.mat")
    with pytest.raises(CaptureError, match=r"gone\.mat: no such file"):
        read_normals(tmp_path / "gone.mat")


def test_without_scipy_the_extra_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("scipy"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"reflectsep\[matlab\]"):
        read_normals(tmp_path / "n.mat")
