"""A page of 24 megapixels: it is made, it opens, and it is exact where it is looked at."""

from __future__ import annotations

import dataclasses
import os
import resource
import time

import pytest
import torch
from torch.nn.functional import interpolate

from reflectsep.report.tone import tone
from reflectsep.viewer.page import Shown, write_page

from .test_browser import WINDOW, mix_of, share_within_one

pytestmark = [pytest.mark.slow, pytest.mark.browser]
WIDTH, HEIGHT = 6000, 4000
NEEDED_GB = 8


@pytest.fixture(scope="module")
def large(result):
    """A small result, enlarged; only what a page is made of is there at full size."""
    if os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") < NEEDED_GB * 1e9:
        pytest.skip(f"needs {NEEDED_GB} GB of memory")
    small = result(size=256, channels=1, n_d=1.0, f=1.0, ggx=False)
    row, column = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    mask = row.square() + column.square() < 0.92

    def enlarged(values):
        flat = values.reshape(-1, 1, 256, 256)
        grown = torch.cat([interpolate(plane[None], size=(HEIGHT, WIDTH), mode="bilinear")[0] for plane in flat])
        return grown.reshape(*values.shape[:-2], HEIGHT, WIDTH) * mask

    return dataclasses.replace(
        small,
        mask=mask,
        flags=torch.where(mask, 0, 1).to(torch.int32),
        d=enlarged(small.d),
        s=enlarged(small.s),
        B=enlarged(small.B),
        material=torch.zeros(HEIGHT, WIDTH, dtype=torch.int32),
    )


@pytest.mark.parametrize(("max_pixels", "factor"), [(24_000_000, 1), (4_000_000, 4)])
def test_24_megapixels(page, large, tmp_path, max_pixels, factor):
    shown, began_s = Shown(name="large", separation=large, white=1.0), time.monotonic()
    (accuracy,) = write_page(tmp_path / "a.html", [shown], max_pixels=max_pixels, measured=False)
    took_s, size_mb = time.monotonic() - began_s, (tmp_path / "a.html").stat().st_size / 1e6
    assert accuracy.within_one > 0.999
    page.size(*WINDOW)
    page.open(tmp_path / "a.html")
    load_s = page.run("reflectsep.loaded_ms()") / 1000
    direction = torch.tensor([0.1, -0.05, 0.99])
    direction = direction / direction.norm()
    state = {"x": float(direction[0]), "y": float(direction[1]), "cx": 0.4, "cy": 0.55, "smooth": 0}
    page.settle(zoom=1.0 if factor == 1 else 0.25, **state)
    frame_ms = page.run("reflectsep.frame_ms(3)")
    pixels = page.pixels()
    memory_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"{max_pixels / 1e6:.0f} MP: {size_mb:.1f} MB, made in {took_s:.0f} s with {memory_gb:.1f} GB at most, "
        f"loaded in {load_s:.1f} s, {1000 / frame_ms:.1f} frames a second"
    )
    if factor > 1:
        assert page.run("document.getElementById('about').textContent").count("here 1500 x 1000") == 1
        return
    # The canvas at 1 : 1 about (cx, cy), against the same rectangle of the result.
    mean = float(large.light_vectors[:3].norm(dim=1).mean())
    picture = large.relight(mix_of(large, direction, mean))
    left, top = round(0.4 * WIDTH - pixels.shape[1] / 2), round(0.55 * HEIGHT - pixels.shape[0] / 2)
    part = picture[:, top : top + pixels.shape[0], left : left + pixels.shape[1]]
    share, largest = share_within_one(pixels, tone(part, white=1.0))
    print(f"canvas: {100 * share:.2f} % within one of 255 steps, at most {largest}")
    assert share > 0.999
