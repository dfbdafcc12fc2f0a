"""Motion between pictures under different lights: found where it is proven, and nowhere else."""

import math

import pytest
import torch

from reflectsep.calibrate import between_lights
from reflectsep.calibrate.align_options import AlignOptions
from reflectsep.calibrate.between_lights import anchored, between
from reflectsep.calibrate.motion import displacement, shifted
from reflectsep.calibrate.tiles import chessboard
from reflectsep.synth.drift import moved

from .conftest import direction

SIZE = 96
LIGHTS = [direction(30, 120 * i) for i in range(3)] + [direction(20, 47 + 72 * i) for i in range(5)]
MIDDLE = ((SIZE - 1) / 2, (SIZE - 1) / 2)


def noise(sigma, seed, size=SIZE):
    return sigma * torch.randn(size, size, generator=torch.Generator().manual_seed(seed)).double()


def print_(seed=5, size=SIZE):
    """Blots of a few pixels, factors from 0.4 to 1."""
    fine = torch.nn.functional.avg_pool2d(noise(1.0, seed, size)[None, None], 5, 1, 2)[0, 0]
    return 0.7 + 0.3 * torch.tanh(6 * fine)


def dome(albedo=1.0, size=SIZE):
    """A dome with a highlight that goes with the light, before black, under every light; and its mask."""
    y, x = torch.meshgrid(*[torch.linspace(-1.1, 1.1, size, dtype=torch.float64)] * 2, indexing="ij")
    inside = x.square() + y.square() < 1
    normal = torch.stack([x, -y, (1 - x.square() - y.square()).clamp_min(0).sqrt()])
    lights = torch.tensor(LIGHTS, dtype=torch.float64)
    cosine = torch.einsum("lc,chw->lhw", lights, normal).clamp_min(0)
    half = lights + torch.tensor([0.0, 0.0, 1.0])
    half = half / half.norm(dim=1, keepdim=True)
    highlight = 0.4 * torch.einsum("lc,chw->lhw", half, normal).clamp_min(0) ** 40
    return inside * (albedo * cosine + highlight), inside


def seen(pictures, mask, k, *motion, options=None):
    """What is found for picture k of a camera that moved."""
    picture = moved(pictures[k][None], shifted(*motion))[0] if motion else pictures[k]
    return between(anchored(pictures[0] + noise(0.003, 0), mask), picture + noise(0.003, k), options)


@pytest.mark.parametrize("albedo", [print_(), 1.0], ids=["printed", "smooth"])
@pytest.mark.parametrize("masked", [True, False])
def test_still_pictures_stay_where_they_are(albedo, masked):
    pictures, inside = dome(albedo)
    mask = inside if masked else torch.ones_like(inside)
    for k in range(1, len(LIGHTS)):
        motion = seen(pictures, mask, k)
        assert not motion.applied
        assert motion.reason.startswith("no motion proven: ")
        assert torch.equal(motion.matrix, torch.eye(3, dtype=torch.float64))


def test_shading_alone_looks_like_motion_and_is_refused():
    """Without the proof the smooth dome's pictures would be moved by pixels."""
    pictures, mask = dome()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(between_lights, "_doubt", lambda *_: ("", "believed"))
        looked = [seen(pictures, mask, k).displacement_px for k in range(1, len(LIGHTS))]
    assert max(looked) > 1.0


@pytest.mark.parametrize("k", range(1, len(LIGHTS)))
def test_a_printed_object_that_moved_is_put_back(k):
    pictures, mask = dome(print_())
    angle = 50.0 * k
    true = (1.5 * math.cos(angle), 1.5 * math.sin(angle))
    motion = seen(pictures, mask, k, *true)
    assert motion.applied
    assert motion.model == "translation"
    assert displacement(shifted(*true) @ torch.linalg.inv(motion.matrix), mask) < 0.1
    assert motion.displacement_px == pytest.approx(1.5, abs=0.1)
    assert motion.sd_px < 0.15
    assert "unseen parts correlate" in motion.reason


def test_a_rotation_is_found_unless_only_a_shift_is_allowed():
    pictures, mask = dome(print_())
    true = (0.8, -0.6, 1.2, MIDDLE)
    motion = seen(pictures, mask, 4, *true)
    assert motion.model == "rigid"
    assert motion.rotation_deg == pytest.approx(1.2, abs=0.1)
    assert displacement(shifted(*true) @ torch.linalg.inv(motion.matrix), mask) < 0.1
    assert seen(pictures, mask, 4, *true, options=AlignOptions(richest="translation")).rotation_deg == 0.0


@pytest.mark.parametrize("corner", [(0, 0), (17, 9)])
def test_a_picture_of_any_size_is_compared_at_few_pixels(monkeypatch, corner):
    pictures, mask = dome(torch.nn.functional.interpolate(print_()[None, None], scale_factor=2)[0, 0], 2 * SIZE)
    beside = (corner[1], 0, corner[0], 0)
    pictures, mask = torch.nn.functional.pad(pictures, beside), torch.nn.functional.pad(mask, beside)
    monkeypatch.setattr(between_lights, "MOST_PIXELS", SIZE * SIZE)
    anchor = anchored(pictures[0], mask)
    assert anchor.factor == 2
    true = shifted(2.4, -1.8, 0.9, (20.0, 30.0))
    motion = between(anchor, moved(pictures[4][None], true)[0])
    assert motion.model == "rigid"
    assert displacement(true @ torch.linalg.inv(motion.matrix), mask) < 0.2
    assert motion.displacement_px == pytest.approx(displacement(motion.matrix, mask), rel=0.02)


REFUSED = {
    "nothing beyond its error": (0.2, 0.1),
    "what looks like one is implausibly far": (3.6, 3.6),
    "unseen parts do not agree better": (0.45, 0.0),
}


@pytest.mark.parametrize("reason", REFUSED)
def test_motions_that_are_no_camera_or_not_worth_it_are_refused(reason):
    pictures, mask = dome(print_())
    motion = seen(pictures, mask, 4, *REFUSED[reason])
    assert motion.reason == f"no motion proven: {reason}"
    assert not motion.applied


def test_a_camera_that_turned_by_degrees_was_set_up_anew():
    pictures, mask = dome(print_())
    assert seen(pictures, mask, 4, 0.0, 0.0, 1.7, MIDDLE).applied
    assert not seen(pictures, mask, 4, 0.0, 0.0, 2.4, MIDDLE).applied


def test_one_mark_is_no_proof():
    """A mark that wanders over a plain surface: a highlight, not a print."""
    _, mask = dome()
    y, x = torch.meshgrid(*[torch.arange(SIZE, dtype=torch.float64)] * 2, indexing="ij")

    def marked(cx):
        spot = 1 - 0.6 * torch.exp(-((x - cx).square() + (y - 40).square()) / 6)
        return torch.full_like(x, 0.5) * mask * spot

    motion = between(anchored(marked(40), mask), marked(41.5))
    assert motion.reason == "no motion proven: what looks like one rests on too few places"


def test_an_object_that_lies_in_one_half_of_the_tiles_proves_nothing(monkeypatch):
    pictures, mask = dome(print_())
    assert seen(pictures, mask, 4, 1.2, 0.7).applied
    monkeypatch.setattr(between_lights, "chessboard", lambda weight, _: (weight, 0.0 * weight))
    assert seen(pictures, mask, 4, 1.2, 0.7).reason == "no motion proven: what looks like one rests on too few places"


def test_a_surface_that_differs_more_than_it_agrees_shows_no_texture():
    pictures, mask = dome(print_())
    veiled = anchored(pictures[0] * (1 + noise(0.5, 3)).clamp_min(0.1), mask)
    motion = between(veiled, moved(pictures[0][None], shifted(1.2, 0.7))[0] * (1 + noise(0.5, 4)).clamp_min(0.1))
    assert motion.reason == "no motion proven: the surface shows no texture"


def patchwork(anchor, picture, where, by):
    """The picture by the one shift where `where` has ones in the anchor's box, and by the other elsewhere."""
    top, left = anchor.corner
    rows, columns = where.shape
    chosen = torch.zeros_like(picture)
    chosen[top : top + rows, left : left + columns] = where
    there, here = (moved(picture[None], shifted(x, 0.0))[0] for x in by)
    return torch.where(chosen > 0, there, here)


def test_the_two_halves_of_the_tiles_must_agree(monkeypatch):
    pictures, mask = dome(print_())
    anchor = anchored(pictures[0], mask)
    dark, _ = chessboard(anchor.structure.weight, between_lights.TILES)
    picture = patchwork(anchor, pictures[0], dark, (1.9, 1.2))
    assert between(anchor, picture).reason == "no motion proven: parts of the object do not agree"
    monkeypatch.setattr(between_lights, "AGREE_PX", math.inf)
    assert between(anchor, picture).applied


@pytest.mark.parametrize("vertical", [False, True])
def test_the_sides_of_the_object_must_agree(monkeypatch, vertical):
    pictures, mask = dome(print_())
    anchor = anchored(pictures[0], mask)
    half = torch.zeros_like(anchor.structure.weight)
    half[: half.shape[0] // 2 if vertical else None, : None if vertical else half.shape[1] // 2] = 1.0
    picture = patchwork(anchor, pictures[0], half, (1.9, 0.8))
    only = AlignOptions(richest="translation")
    monkeypatch.setattr(between_lights, "SURE_PX", math.inf)
    assert between(anchor, picture, only).reason == "no motion proven: sides of the object do not agree"
    monkeypatch.setattr(between_lights, "SIDES_PX", math.inf)
    assert between(anchor, picture, only).applied
    monkeypatch.setattr(between_lights, "SURE_PX", 0.09)
    assert between(anchor, picture, only).reason == "no motion proven: places pull apart"


def test_tiles_that_pull_apart_are_no_camera():
    pictures, mask = dome(print_())
    anchor = anchored(pictures[0], mask)
    left = torch.zeros_like(anchor.structure.weight)
    left[:, : left.shape[1] // 2] = 1.0
    picture = patchwork(anchor, pictures[0], left, (2.0, 0.4))
    found = between(anchor, picture, AlignOptions(richest="translation"))
    assert found.reason == "no motion proven: places pull apart"


@pytest.mark.parametrize("side", [36, 0])
def test_every_tile_has_a_vote(side):
    """What moves in the middle does not speak for the faint marks around it, which stay."""
    _, mask = dome()
    middle = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    near = slice((SIZE - side) // 2, (SIZE + side) // 2)
    middle[near, near] = True
    strong, faint = 0.5 * print_(), 0.35 + 0.07 * (print_(8) - 0.7)
    still = torch.where(middle, strong, faint) * mask
    around = faint if side else moved(faint[None], shifted(1.0, 0.6))[0]
    picture = torch.where(middle, moved(strong[None], shifted(1.0, 0.6))[0], around) * mask
    motion = between(anchored(still + noise(0.001, 1), mask), picture + noise(0.001, 2))
    assert motion.applied == (side == 0)
    if side:
        assert motion.reason == "no motion proven: unseen parts do not agree better"


def test_the_correlation_must_have_its_peak_where_least_squares_have_put_it(monkeypatch):
    pictures, mask = dome(print_())
    peaks = iter([(1.0, 0.5), (0.2, 0.2)])
    monkeypatch.setattr(between_lights, "_peak", lambda *_: next(peaks))
    assert seen(pictures, mask, 4, 1.2, 0.5).reason == "no motion proven: two estimates do not agree"


@pytest.mark.parametrize("lit", [0.0, 0.04])
def test_what_is_dark_says_nothing(lit):
    pictures, mask = dome(print_())
    motion = between(anchored(pictures[0], mask), lit * pictures[4])
    assert not motion.applied
    nothing = between(anchored(torch.zeros_like(pictures[0]), mask), pictures[4])
    assert nothing.reason == "no motion proven: too little of the object is lit in both pictures"


def test_the_edge_of_a_shadow_is_no_texture():
    """A shadow's edge crosses a plain sheet and lies 2 px further in the other picture."""
    y, x = torch.meshgrid(*[torch.arange(SIZE, dtype=torch.float64)] * 2, indexing="ij")
    edge = 40 + 4 * torch.sin(y / 8)
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool)

    def sheet(shift):
        return 0.5 * torch.sigmoid(x - edge - shift) + noise(0.002, round(shift))

    anchor = anchored(sheet(0.0), mask)
    assert not bool((anchor.structure.weight[(x - edge).abs() < 2] > 0).any())
    assert bool((anchor.structure.weight[10:-10][(x - edge)[10:-10] > 12] > 0).any())
    assert not between(anchor, sheet(2.0)).applied
