"""Planes of the page: a pyramid of the parameters, halves that hold them, tiles that come back."""

from __future__ import annotations

import dataclasses
import zlib

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.flags import Flag
from reflectsep.viewer.measured import coded, measured_pictures
from reflectsep.viewer.planes import (
    FLAG_BITS,
    TILE,
    as_drawn,
    full_level,
    halved,
    packed,
    pyramid,
    relit,
    root_scale,
    stored,
    tile,
    tiles_of,
)


def unpacked(data, dtype, shape):
    """The way back, written from the format's description."""
    raw = np.frombuffer(zlib.decompress(data), np.uint8)
    size = np.dtype(dtype).itemsize
    steps = sum(raw.reshape(size, -1)[k].astype(np.uint32) << (8 * k) for k in range(size)).reshape(shape)
    codes = np.cumsum(steps, axis=-1, dtype=np.uint32) & (2 ** (8 * size) - 1)
    return codes.astype(np.uint16 if size == 2 else np.uint8).view(dtype)


@given(st.integers(1, 4), st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**31))
def test_packed_planes_come_back_bit_for_bit(count, height, width, seed):
    random = np.random.default_rng(seed)
    halves = random.normal(0, 100, (count, height, width)).astype(np.float16)
    assert np.array_equal(unpacked(packed(halves), np.float16, halves.shape), halves)
    codes = random.integers(0, 256, (count, height, width)).astype(np.uint8)
    assert np.array_equal(unpacked(packed(codes), np.uint8, codes.shape), codes)


@pytest.mark.parametrize("channels", [1, 3])
def test_the_finest_level_relights_as_the_result_does(result, channels):
    separation = result(size=32, channels=channels)
    level = full_level(separation)
    for alpha in (torch.tensor([0.3, 0.4, 0.5]), torch.tensor([1.2, -0.3, 0.2])):
        true = separation.relight(alpha)
        assert torch.allclose(relit(separation, level, alpha), true, rtol=1e-4, atol=1e-6)
        rounded = relit(separation, as_drawn(level, root_scale(separation)), alpha)
        # a half has 11 bits; n_s = 14 multiplies the relative error of the lobe's root
        assert float((rounded - true).abs().max()) < 14 * 3 * 2**-11 * float(true.max())


def test_flags_and_mask_are_whole_numbers_in_the_planes(result):
    separation = result(size=32)
    planes = stored(full_level(separation), (1.0, 1.0)).astype(np.int64).reshape(-1, 4, 32, 32)
    low, high = planes[3, 3], planes[6, 3]
    assert np.array_equal(high >> FLAG_BITS, separation.mask.numpy())
    assert np.array_equal(low + ((high & (1 << FLAG_BITS) - 1) << FLAG_BITS), separation.flags.numpy())


def test_a_coarser_level_is_the_mean_over_the_object(result):
    level = full_level(result(size=33))
    small = halved(level)
    assert small.size == (17, 17)
    assert small.factor == 2
    for y, x in ((8, 8), (3, 12), (1, 8)):
        block = (slice(2 * y, 2 * y + 2), slice(2 * x, 2 * x + 2))
        mask = level.mask[block]
        if int(mask.sum()) >= 2:
            assert small.mask[y, x]
            assert torch.allclose(small.d[:, :, y, x], level.d[:, :, *block][..., mask].mean(-1), atol=1e-6)
            expected = 0
            for flag in level.flags[block][mask].tolist():
                expected |= flag
            assert int(small.flags[y, x]) == expected
    assert set(small.flags[~small.mask].tolist()) == {int(Flag.OUTSIDE_MASK)}
    assert not small.d[..., ~small.mask].any()


def test_the_pyramid_starts_below_the_limit_and_ends_small(result):
    small = full_level(result(size=28, channels=1))
    large = {
        name: getattr(small, name).repeat(*[1] * (getattr(small, name).ndim - 2), 25, 25)
        for name in ("d", "s", "w", "B", "flags", "mask", "material")
    }
    levels = pyramid(dataclasses.replace(small, **large), 400_000)
    assert [level.size for level in levels] == [(350, 350), (175, 175)]
    assert [level.factor for level in levels] == [2, 4]


def test_tiles_cover_the_picture_and_share_their_apron():
    planes = np.arange(2 * 600 * 1030).reshape(2, 600, 1030)
    seen = np.zeros((600, 1030), int)
    for i, j in tiles_of(1030, 600):
        piece = tile(planes, (i, j))
        assert piece.shape[1:] == (min(513, 600 - 512 * j), min(513, 1030 - 512 * i))
        assert np.array_equal(piece, planes[:, 512 * j : 512 * j + 513, 512 * i : 512 * i + 513])
        seen[TILE * j : TILE * j + TILE, TILE * i : TILE * i + TILE] += 1
    assert seen.min() == seen.max() == 1


def test_measured_pictures_are_model_plus_residual(result):
    separation = result(size=24)
    pictures = measured_pictures(separation)
    assert list(pictures) == list(separation.names)
    for i, picture in enumerate(pictures.values()):
        true = (separation.relight(separation.alpha[i]) + separation.residual[i]) * separation.mask
        assert torch.allclose(picture, true, atol=1e-5)


def test_a_light_with_a_sweep_of_its_own_outside_the_basis_is_left_out(result):
    separation = result(size=24)
    document = {"sweeps": [{"light": separation.names[0]}, {"light": separation.names[4]}]}
    pictures = measured_pictures(dataclasses.replace(separation, document=document))
    assert list(pictures) == [name for i, name in enumerate(separation.names) if i != 4]


def test_codes_follow_the_srgb_curve():
    # IEC 61966-2-1: 0.0031308 is 0.04045 encoded, 0.5 encoded is 0.21404 linear
    picture = torch.tensor([-1.0, 0.0, 0.0031308, 0.2145, 1.0, 9.0]).reshape(1, 1, -1) * 4
    assert coded(picture, 4.0).tolist() == [[[0, 0, 10, 128, 255, 255]]]
