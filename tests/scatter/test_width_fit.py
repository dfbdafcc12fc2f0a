"""The slab's width by profiles whose every frame is made from the model's own integral."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from reflectsep.data import Sweep
from reflectsep.scatter.gains import _fitted
from reflectsep.scatter.passage import Passage
from reflectsep.scatter.width import Kept
from reflectsep.scatter.width_fit import fitted_width

FRAMES = torch.arange(40)
STEP_PX = 2.0


def profiles(width, *, pixels=300, shift=0.0, noise=0.0, dark=0.0, seed=0):
    """Frames of pixels half a frame wide; light that enters up to `width / 2` away scatters to them."""
    g = torch.Generator().manual_seed(seed)
    centre = 20.0 + torch.rand(pixels, generator=g) - 0.5
    u = FRAMES[:, None].double() - centre
    fine = torch.linspace(-0.5, 0.5, 401).double() * width
    share = ((width / 2 + 0.25 - u.abs()) / 0.5).clamp(0.0, 1.0)
    away = (u[..., None] - fine).abs()
    spread = 0.25 * (torch.exp(-away / 0.9) / 1.8 + torch.exp(-away / 2.5) / 5.0).mean(-1) * width
    value = (0.2 + torch.rand(pixels, generator=g)) * (share + spread) + noise * torch.randn(u.shape, generator=g)
    unspoilt = torch.zeros_like(value, dtype=torch.bool)
    kept = Kept(at=torch.arange(pixels), index=FRAMES, value=value.float(), spoilt=unspoilt)
    return kept, (centre + shift)[None]


def fitted(kept, centre, guess):
    return fitted_width(kept, centre, torch.ones_like(centre, dtype=torch.bool), guess=guess, step_px=STEP_PX)


@pytest.mark.parametrize(("width", "within"), [(1.5, 0.02), (2.0, 0.01), (2.5, 0.01), (3.5, 0.01)])
@pytest.mark.parametrize("off", [0.92, 1.07])
def test_width_is_found_from_a_guess_some_per_cent_off(width, within, off):
    """Within a hundredth, or two where but one frame is lit wholly."""
    assert fitted(*profiles(width, noise=0.003), guess=off * width) == pytest.approx(width, rel=within)


def test_exposure_and_spoilt_pixels_make_no_difference():
    kept, centre = profiles(2.5)
    plain = fitted(kept, centre, 2.4)
    assert fitted(replace(kept, value=40.0 * kept.value), centre, 2.4) == pytest.approx(plain, rel=1e-4)
    clipped = torch.zeros_like(kept.spoilt)
    clipped[:, ::3] = (FRAMES == 20)[:, None]
    value = torch.where(clipped, 0.1, kept.value)
    assert fitted(replace(kept, value=value, spoilt=clipped), centre, 2.4) == pytest.approx(2.5, rel=0.005)


def test_nothing_is_said_where_nothing_tells():
    kept, centre = profiles(2.0)
    assert fitted(replace(kept, spoilt=torch.ones_like(kept.spoilt)), centre, 2.0) is None
    assert fitted(*profiles(2.0, pixels=40), guess=2.0) is None
    assert fitted(kept, centre, 3.0) is None  # no width near it fits
    blurred = replace(kept, value=kept.value.mean(0).expand_as(kept.value))
    assert fitted(blurred, centre, 2.0) is None  # no pixel outshines its surroundings


def passage_of(rows, columns):
    """A slab that passes each row of pixels at its own pace, (frames a pixel, width that the row's profiles show)."""
    pace, width = (torch.tensor(values).double()[:, None] for values in zip(*rows, strict=True))
    centre = 20.0 + 0.01 * torch.arange(len(rows))[:, None] + pace * (torch.arange(columns) - columns // 2)
    u = FRAMES[:, None].double() - centre.flatten()
    half = width.expand_as(centre).flatten() / 2
    away = (u.abs() - half).clamp_min(0.0)
    value = ((half + 0.25 - u.abs()) / 0.5).clamp(0.0, 1.0) + 0.1 * torch.exp(-away)
    kept = Kept(
        at=torch.arange(centre.numel()),
        index=FRAMES,
        value=value.float(),
        spoilt=torch.zeros(value.shape, dtype=torch.bool),
    )
    plain, no = torch.zeros(centre.shape), torch.zeros(centre.shape, dtype=torch.bool)
    return Passage(
        sweep=Sweep(light="L1", frames="{}.exr", count=len(FRAMES)), centre=centre.float(), narrow=~no, clipped=no,
        peak=plain, lit_frames=plain, total=plain[None], first=0, last=39, received=40, noise=0.0, dark=0.0, sums=plain,
        lost_away=plain + torch.inf, kept=kept,
    )  # fmt: skip


def test_pixels_that_the_slab_passes_at_another_pace_have_no_say():
    """On surfaces that turn along the light's way profiles are none that the model has."""
    passage = passage_of([(0.5, 2.5)] * 14 + [(0.12, 2.1)] * 8 + [(1.2, 3.0)] * 4, 24)
    mask = torch.ones(passage.centre.shape, dtype=torch.bool)
    even = passage_of([(0.5, 2.5)] * 26, 24)
    assert passage.step_px(mask) == pytest.approx(2.0, rel=1e-3)
    assert _fitted(passage, mask, 2.4) == pytest.approx(_fitted(even, mask, 2.4), rel=0.005)
    assert _fitted(even, mask, 2.4) == pytest.approx(2.5, rel=0.02)


def test_where_few_keep_the_pace_all_have_their_say():
    passage = passage_of([(0.2, 2.5)] * 3 + [(0.5, 2.5)] * 2 + [(1.2, 2.5)] * 3, 20)
    mask = torch.ones(passage.centre.shape, dtype=torch.bool)
    assert _fitted(passage, mask, 2.4) == pytest.approx(2.5, rel=0.02)
