"""Pictures and films for a screen are the relit pictures through the tone curve."""

import importlib.util

import imagecodecs
import numpy as np
import pytest
import torch

from reflectsep.config import RelightJob
from reflectsep.errors import ResultError
from reflectsep.jobs import mixes, run_relight
from reflectsep.report.tone import tone, tone_16, white_point
from reflectsep.separation import load


@pytest.fixture(scope="module")
def saved(tmp_path_factory, result):
    folder = tmp_path_factory.mktemp("screen") / "result"
    result(size=20).save(folder)
    return folder


def orbit_job(saved, out, **options):
    return RelightJob(result=str(saved), orbit=4, elevation_deg=70, out=str(out), **options)


def expected(saved, job, curve):
    separation = load(saved)
    white = white_point(separation.highlight_free + separation.specular, separation.mask) / 2.0**job.exposure_ev
    lights = mixes(job, separation)
    return {
        name: curve(separation.relight(torch.tensor(mix.alpha, dtype=torch.float32)), white=white)
        for name, mix in lights.items()
    }


def steps_off(found, pixels):
    """Most steps of the codes between two pictures: a power's last bit may turn a rounding."""
    assert found.dtype == pixels.dtype
    return int(np.abs(found.astype(int) - pixels).max())


def test_a_png_sequence_is_the_relit_pictures(saved, tmp_path):
    job = orbit_job(saved, tmp_path / "orbit", format="png", exposure_ev=-1.0)
    steps = []
    said = run_relight(job, lambda stage, done, total: steps.append((stage, done, total)))
    assert "4 pictures" in said
    assert steps == [("relight", k, 4) for k in (1, 2, 3, 4)]
    for name, pixels in expected(saved, job, tone).items():
        found = imagecodecs.png_decode((tmp_path / "orbit" / f"{name}.png").read_bytes())
        assert steps_off(found, pixels) <= 1
    assert (tmp_path / "orbit" / "relit.json").is_file()
    with pytest.raises(ResultError, match="exists"):
        run_relight(job)


@pytest.mark.skipif(importlib.util.find_spec("av") is None, reason="PyAV is an extra")
def test_the_frames_of_a_film_are_the_relit_pictures(saved, tmp_path):
    import av

    job = orbit_job(saved, tmp_path / "orbit", format="ffv1", fps=12)
    assert "film.mkv: 4 frames, 0.3 s" in run_relight(job)
    with av.open(str(tmp_path / "orbit" / "film.mkv")) as container:
        found = [frame.to_ndarray(format="gbrp16le") for frame in container.decode(video=0)]
    for pixels, back in zip(expected(saved, job, tone_16).values(), found, strict=True):
        assert steps_off(back, pixels) <= 1
    run_relight(orbit_job(saved, tmp_path / "orbit", format="mp4", overwrite=True))
    assert {path.name for path in (tmp_path / "orbit").iterdir()} == {"film.mp4", "relit.json"}


def test_sixteen_bits_and_eight_are_one_curve():
    picture = torch.linspace(-0.1, 1.2, 3000).reshape(1, 30, 100)
    fine, coarse = tone_16(picture), tone(picture)
    assert np.abs(fine / 257.0 - coarse).max() <= 0.51
    picture[0, 0, 0] = torch.nan
    assert tone_16(picture)[0, 0].tolist() == [65535, 0, 65535]
