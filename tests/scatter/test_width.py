"""The slab's width from the frames alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from reflectsep.scatter.frames import Step
from reflectsep.scatter.width import PIXELS, Keeper, Kept, lit_frames

FRAMES = torch.arange(25)
STEP_PX = 2.0


def profiles(width, *, pixels=400, scattering=0.15, uneven=0.1, seed=0):
    """Frames of pixels that are half a frame wide, passed at any phase; lit frames differ, and scattering is beside."""
    g = torch.Generator().manual_seed(seed)
    centre = 12.0 + torch.rand(pixels, generator=g) - 0.5
    offset = FRAMES[:, None] - centre
    share = ((width / 2 + 0.25 - offset.abs()) / 0.5).clamp(0.0, 1.0)
    tilt = 1.0 + uneven * (torch.rand(pixels, generator=g) - 0.5) * offset
    value = share * tilt + scattering * torch.exp(-(offset.abs() - width / 2).clamp_min(0.0) / 1.5)
    kept = Kept(at=torch.arange(pixels), index=FRAMES, value=value, spoilt=torch.zeros_like(value, dtype=torch.bool))
    return kept, centre[None]


def counted(kept, centre, guess, narrow=None):
    narrow = torch.ones_like(centre, dtype=torch.bool) if narrow is None else narrow
    return lit_frames(kept, centre, narrow, guess=guess, step_px=STEP_PX)


@pytest.mark.parametrize("width", [2.0, 2.5, 5.2])
@pytest.mark.parametrize("off", [0.92, 1.0, 1.08])
def test_width_is_found_from_a_guess_some_per_cent_off(width, off):
    assert counted(*profiles(width), guess=off * width) == pytest.approx(width, rel=0.03)


def test_a_camera_of_another_exposure_sees_the_same_width():
    kept, centre = profiles(2.0)
    assert counted(replace(kept, value=40.0 * kept.value), centre, 2.1) == pytest.approx(counted(kept, centre, 2.1))


def test_clipped_lost_and_unlit_pixels_have_no_say():
    kept, centre = profiles(2.0)
    half = torch.arange(400) < 200
    good = profiles(2.0)[0]
    alone = counted(
        replace(good, at=good.at[half], value=good.value[:, half], spoilt=good.spoilt[:, half]), centre, 2.1
    )
    wrong = replace(kept, value=torch.where(half, kept.value, kept.value.clamp(max=0.3)))
    spoilt = replace(wrong, spoilt=(~half).expand(25, -1) & (FRAMES == 12)[:, None])
    assert counted(spoilt, centre, 2.1) == pytest.approx(alone)
    assert counted(wrong, centre, 2.1, narrow=half[None]) == pytest.approx(alone)


def test_nothing_is_said_where_too_few_show_it():
    kept, centre = profiles(2.0)
    assert counted(replace(kept, spoilt=torch.ones_like(kept.spoilt)), centre, 2.0) is None
    assert counted(*profiles(2.0, scattering=20.0), guess=2.0) is None
    assert counted(*profiles(2.0, pixels=40), guess=2.0) is None
    assert counted(kept, centre, 4.0) is None  # too far off to be a guess of it


def test_some_pixels_of_every_frame_are_kept():
    mask = torch.zeros(100, 100, dtype=torch.bool)
    mask[10:90, 10:90] = True
    keeper = Keeper(mask, 5)  # two of them never come
    for index in range(3):
        values = torch.full((2, 100, 100), float(index))
        values[1] += 2.0
        saturated = torch.zeros((2, 100, 100), dtype=torch.bool)
        saturated[1] = index == 1
        keeper.add(Step(index=index, values=values, saturated=saturated, lost=index == 2))
    kept = keeper.kept()
    assert 0.4 * PIXELS < len(kept.at) <= PIXELS
    assert bool(mask.flatten()[kept.at].all())
    torch.testing.assert_close(kept.value, torch.tensor([1.0, 2.0, 3.0])[:, None].expand(3, len(kept.at)))
    assert kept.spoilt.all(1).tolist() == [False, True, True]
