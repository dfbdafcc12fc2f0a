"""A film of an orbit plays in a browser, and what is seen are the relit pictures."""

from __future__ import annotations

import base64
import math

import numpy as np
import pytest
import torch

from reflectsep.config import RelightJob
from reflectsep.jobs import mixes, run_relight
from reflectsep.report.tone import tone, white_point

from .conftest import decoded

pytestmark = [pytest.mark.slow, pytest.mark.browser]
FRAMES, FPS = 8, 10
SHOW = """
new Promise((done, failed) => {
  const film = document.createElement("video");
  document.body.append(film);
  film.muted = true;
  film.onerror = () => failed(new Error("cannot play: " + film.error.message));
  const take = () => {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [film.videoWidth, film.videoHeight];
    canvas.getContext("2d").drawImage(film, 0, 0);
    done([film.duration, canvas.toDataURL()]);
  };
  // The picture that was sought is there when it is presented; a tab in the background presents none.
  const wait = (_, shown) => Math.abs(shown.mediaTime - AT) < 0.06 ? take() : film.requestVideoFrameCallback(wait);
  film.onseeked = () => setTimeout(take, 2000);
  film.onloadeddata = () => { film.requestVideoFrameCallback(wait); film.currentTime = AT; };
  film.src = "data:video/mp4;base64,FILM";
})
"""
SHOW_GIF = """
new Promise((done, failed) => {
  const film = new Image();
  film.onerror = () => failed(new Error("no picture"));
  film.onload = () => {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [film.naturalWidth, film.naturalHeight];
    canvas.getContext("2d").drawImage(film, 0, 0);
    done([0, canvas.toDataURL()]);
  };
  film.src = "data:image/gif;base64,FILM";
})
"""


@pytest.mark.parametrize(("kind", "channels", "least_db"), [("mp4", 1, 40.0), ("mp4", 3, 34.0), ("gif", 1, 90.0)])
def test_a_film_plays_and_shows_the_relit_pictures(page, result, tmp_path, kind, channels, least_db):
    if kind != "gif":
        pytest.importorskip("av")
    separation = result(size=96, channels=channels)
    separation.save(tmp_path / "result")
    job = RelightJob(
        result=str(tmp_path / "result"),
        orbit=FRAMES,
        elevation_deg=70,
        fps=FPS,
        format=kind,
        out=str(tmp_path / "orbit"),
    )
    run_relight(job)
    film = base64.b64encode((tmp_path / "orbit" / f"film.{kind}").read_bytes()).decode()
    page.call("Page.navigate", url="about:blank")
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    worst = math.inf
    for k, mix in enumerate(mixes(job, separation).values()):
        if kind == "gif" and k:
            break  # a canvas takes a GIF's first picture
        script = SHOW_GIF if kind == "gif" else SHOW.replace("AT", str((k + 0.5) / FPS))
        duration, picture = page.run(script.replace("FILM", film))
        assert kind == "gif" or duration == pytest.approx(FRAMES / FPS, abs=0.01)
        expected = tone(separation.relight(torch.tensor(mix.alpha)), white=white).astype(float)
        error = np.mean((decoded(picture.split(",", 1)[1]) - expected) ** 2)
        worst = min(worst, math.inf if error == 0 else 10 * math.log10(255**2 / error))
    print(f"{kind}, {channels} channels: the worst frame is {worst:.1f} dB from its relit picture")
    assert worst > least_db
