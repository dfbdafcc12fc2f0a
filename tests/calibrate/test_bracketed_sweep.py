"""A sweep at several exposures becomes one linear sweep."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from reflectsep.calibrate.exposure import developed_stream, missing_darks
from reflectsep.data import Sweep
from reflectsep.errors import CaptureError
from reflectsep.io.capture import load_capture
from reflectsep.io.frames import open_sweep
from reflectsep.io.pictures import read_picture, write_picture

from .conftest import SIZE, Folder

COUNT = 6
SHORT_S, LONG_S = 0.01, 0.08


def scene(index):
    """A stripe of light over a faint glow, in units of the short exposure."""
    picture = 0.02 + 0.001 * torch.arange(SIZE, dtype=torch.float64).expand(1, SIZE, SIZE)
    picture = picture.clone()
    picture[..., 6 * index : 6 * index + 6] = 0.6
    return picture


def stored(radiance, exposure_s):
    """What a 12-bit camera keeps in a 16-bit file."""
    codes = (radiance * exposure_s / SHORT_S * 4095).round().clamp(0, 4095) * (65535 / 4095)
    return torch.from_numpy(codes.round().numpy().astype(np.uint16))


def written(folder: Folder, *, long_place=lambda i: i, lost=(), **changes):
    """A capture with a sweep of L1 at two exposures."""
    folder.standard()
    folder.images = [replace(p, exposure_s=SHORT_S) for p in folder.images]
    for name, exposure_s, place in (("short", SHORT_S, lambda i: i), ("long", LONG_S, long_place)):
        for i in range(COUNT):
            if (name, i) not in lost:
                write_picture(folder.path / f"sweep/{name}/{i:04d}.png", stored(scene(place(i)), exposure_s))
        gone = frozenset(i for n, i in lost if n == name)
        position = tuple(None if i in gone else 0.5 * i for i in range(COUNT))
        sweep = Sweep(
            light="L1",
            exposure_s=exposure_s,
            frames=f"sweep/{name}/{{:04d}}.png",
            count=COUNT,
            lost=gone,
            position_mm=position,
        )
        folder.sweeps.append(replace(sweep, **(changes if name == "long" else {})))
    return folder.load()


def test_entries_of_one_sweep_at_other_exposures_are_one(folder):
    capture = written(folder)
    (sweep,) = capture.sweeps
    assert [one.exposure_s for one in sweep.exposures] == [SHORT_S, LONG_S]
    assert [one.frames for one in sweep.exposures] == ["sweep/short/{:04d}.png", "sweep/long/{:04d}.png"]
    document = json.loads((folder.path / "capture.json").read_text())
    assert len(document["sweeps"]) == 2
    assert all(len(entry["sha256"]) == COUNT for entry in document["sweeps"])


@pytest.mark.parametrize(
    "changes",
    [
        {"exposure_s": SHORT_S},
        {"direction": "y"},
        {"light": "L2"},
        {"position_mm": tuple(0.5 * i + 0.2 for i in range(COUNT))},
        {"exposure_s": None},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_other_sweeps_stay_apart(folder, changes):
    assert len(written(folder, **changes).sweeps) == 2


def test_merged_frames_are_linear_where_one_clips_and_exact_where_both_see(folder):
    capture = written(folder)
    stream = developed_stream(capture, open_sweep(capture, capture.sweeps[0]))
    assert len(stream) == COUNT
    short, long_ = (developed_stream(capture, open_sweep(capture, one)) for one in capture.sweeps[0].exposures)
    for index, (frame, a, b) in enumerate(zip(stream, short, long_, strict=True)):
        assert frame.index == index
        assert frame.saturated is not None
        assert not bool(frame.saturated.any())
        lit = scene(index) == 0.6
        torch.testing.assert_close(frame.values[lit], a.values[lit])  # the long one is clipped there
        weighed = (SHORT_S * a.values + LONG_S * b.values) / (SHORT_S + LONG_S)
        torch.testing.assert_close(frame.values[~lit], weighed[~lit])
        assert float((frame.values - scene(index)).abs().max()) < 1.0 / 4095


def test_a_stream_can_be_read_again_and_holds_no_sweep(folder):
    capture = written(folder)
    stream = developed_stream(capture, open_sweep(capture, capture.sweeps[0]))
    first = next(iter(stream))
    assert torch.equal(first.values, next(iter(stream)).values)
    shutil.rmtree(folder.path / "sweep")  # nothing was read ahead
    with pytest.raises(CaptureError, match="0000"):
        next(iter(stream))


def test_a_frame_that_one_exposure_lost_is_the_others(folder):
    capture = written(folder, lost={("short", 1), ("long", 3), ("short", 5), ("long", 5)})
    stream = developed_stream(capture, open_sweep(capture, capture.sweeps[0]))
    frames = {frame.index: frame for frame in stream}
    assert sorted(frames) == [0, 1, 2, 3, 4]
    assert stream.sweep.lost == frozenset({5})
    clipped = frames[1].saturated
    assert clipped is not None
    assert torch.equal(clipped, scene(1) == 0.6)  # the long exposure alone
    short = developed_stream(capture, open_sweep(capture, replace(capture.sweeps[0], bracket=())))
    alone = next(frame for frame in short if frame.index == 3)
    torch.testing.assert_close(frames[3].values, alone.values)


def test_exposures_that_show_the_slab_elsewhere_are_refused(folder):
    capture = written(folder, long_place=lambda i: (i + 2) % COUNT, position_mm=None, sha256=None)
    with pytest.raises(CaptureError, match=r"0\.01 and 0\.08 s differ by \d+%"):
        list(developed_stream(capture, open_sweep(capture, capture.sweeps[0])))


def test_every_exposure_needs_its_dark_picture(folder):
    folder.dark(torch.zeros(1, SIZE, SIZE), exposure_s=SHORT_S)
    (line,) = missing_darks(written(folder))
    assert "0.08 s" in line


def test_a_bracket_survives_writing_and_reading(folder):
    capture = written(folder)
    again = load_capture(folder.path)
    assert again.sweeps == capture.sweeps
    values, _ = read_picture(folder.path / "sweep/long/0000.png")
    assert float(values.max()) == 1.0
