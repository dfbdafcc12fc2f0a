"""Brackets: merging, and the response that they give away."""

import builtins
from dataclasses import replace

import numpy as np
import pytest
import torch

from reflectsep.calibrate.bracket import estimate_response, fit_gamma, merge
from reflectsep.calibrate.stack import calibrate_stack
from reflectsep.data import Picture
from reflectsep.errors import CaptureError, MissingExtraError
from reflectsep.flags import Flag
from reflectsep.io.pictures import write_picture

from .conftest import ANGLES, direction, radiance


def test_merge_weighs_by_exposure_and_leaves_clipped_values_out():
    pictures = [torch.full((1, 1, 3), v) for v in (1.0, 2.0)]
    clipped = [torch.tensor([[[False, False, True]]]), torch.tensor([[[False, True, True]]])]
    merged, every = merge(pictures, clipped, [0.01, 0.03])
    assert merged[0, 0].tolist() == pytest.approx([1.75, 1.0, 1.0])
    assert every[0, 0].tolist() == [False, False, True]


def test_merge_bears_values_that_are_not_finite():
    pictures = [torch.tensor([[[float("nan")]]]), torch.tensor([[[2.0]]])]
    merged, _ = merge(pictures, [torch.zeros(1, 1, 1, dtype=torch.bool)] * 2, [1.0, 1.0])
    assert float(merged) == 2.0


def test_merged_noise_is_that_of_the_best_weights():
    generator = torch.Generator().manual_seed(0)
    exposures = [1.0, 4.0, 16.0]
    truth = 0.05
    pictures = [truth + (truth / 100 / t) ** 0.5 * torch.randn(1, 100, 100, generator=generator) for t in exposures]
    merged, _ = merge(pictures, [torch.zeros(1, 100, 100, dtype=torch.bool)] * 3, exposures)
    assert float(merged.std()) == pytest.approx((truth / 100 / sum(exposures)) ** 0.5, rel=0.03)


def bracket(gamma=2.2, exposures=(1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0), size=64):
    """8-bit pictures of a scene with all brightnesses, through a gamma."""
    y, x = torch.meshgrid(torch.linspace(0, 1, size), torch.linspace(0, 1, size), indexing="ij")
    scene = (0.003 * torch.exp(5.5 * x) * (0.6 + 0.4 * y)).numpy()
    rng = np.random.default_rng(0)
    codes = []
    for exposure in exposures:
        value = np.clip(scene * exposure * 4, 0, 1) ** (1 / gamma) + 0.002 * rng.standard_normal(scene.shape)
        codes.append(np.rint(np.clip(value, 0, 1) * 255).astype(np.uint8)[..., None])
    return codes, list(exposures)


@pytest.mark.parametrize(("method", "limit"), [("debevec", 0.01), ("robertson", 0.02)])
def test_response_of_a_gamma_camera_is_found(method, limit):
    pytest.importorskip("cv2")
    codes, exposures = bracket()
    values, radiances = estimate_response(codes, exposures, method)
    assert bool((radiances.diff() > 0).all())
    assert float(radiances[-1]) == 1.0
    assert float((radiances - values**2.2)[:250].abs().max()) < limit
    gamma, error = fit_gamma(values, radiances)
    assert gamma == pytest.approx(2.2, rel=0.01)
    assert error < limit


def test_too_little_of_a_bracket_is_refused():
    pytest.importorskip("cv2")
    codes, exposures = bracket()
    with pytest.raises(CaptureError, match="2 exposures over a factor of 2; expected at least 3 over a factor of 4"):
        estimate_response(codes[:2], exposures[:2])


def test_without_opencv_the_extra_is_named(monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "cv2":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtraError, match=r"reflectsep\[response\]"):
        estimate_response(*bracket())


def test_bracketed_light_becomes_one_unclipped_picture(folder):
    folder.standard()
    true = radiance(direction(*ANGLES["L4"]))
    folder.images = [p for p in folder.images if p.light != "L4"]
    folder.images = [replace(p, exposure_s=0.01) for p in folder.images]
    for factor, name in ((4.0, "long"), (1.0, "short")):
        codes = (true * factor).clamp(max=1.0)
        write_picture(folder.path / f"{name}.png", codes, bits=16)
        folder.images.append(Picture(kind="full", file=f"{name}.png", light="L4", exposure_s=0.01 * factor))
    capture = folder.load()
    assert capture.bracketed("L4")
    assert capture.names == tuple(dict.fromkeys(capture.names))
    stack, _ = calibrate_stack(capture)
    at = stack.names.index("L4")
    torch.testing.assert_close(stack.images[at], true, rtol=0, atol=3e-5)
    assert not stack.saturated[at].any()
    assert not bool((stack.flags & int(Flag.SATURATED)).any())


def test_two_pictures_of_one_light_need_different_exposures(folder):
    folder.standard()
    folder.picture("L4", radiance(direction(*ANGLES["L4"])))
    with pytest.raises(CaptureError, match="'L4' has 2 full pictures, expected one, or a bracket of different"):
        folder.load()
