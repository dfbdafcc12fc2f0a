from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from reflectsep import room, separation
from reflectsep.data import Fit, PhotometricStack, Scattering
from reflectsep.errors import ResultError
from reflectsep.flags import Flag
from reflectsep.model import positive_power
from reflectsep.separation import LAYERS, Separation, load, separate

HEIGHT, WIDTH, LIGHTS = 6, 7, 6
BASIS_INTENSITY = torch.tensor([1.0, 0.7, 1.6])


def some_vectors():
    directions = torch.tensor(
        [[0.4, 0.1, 1.0], [-0.3, 0.4, 1.0], [-0.1, -0.5, 1.0], [0.2, 0.2, 1.0], [-0.2, 0.0, 1.0], [0.1, -0.3, 1.0]]
    )
    directions = directions / directions.norm(dim=1, keepdim=True)
    return directions * torch.cat([BASIS_INTENSITY, torch.tensor([1.0, 2.0, 0.5])])[:, None]


def make_separation(*, channels=1, n_d=1.0, softness=0.0, fresnel=0.0, f=1.0, ggx=False, known=True):
    """A separation by `separate` from random parameters, with the stack and the scattering it came from."""
    g = torch.Generator().manual_seed(6)
    rand = lambda *n: torch.rand(*n, generator=g)  # noqa: E731
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[0], mask[3, 3] = False, False
    vectors = some_vectors()
    shape = (LIGHTS, channels, HEIGHT, WIDTH)
    alpha = torch.linalg.solve(vectors[:3].mT, vectors.mT).mT.contiguous()
    alpha[:3] = torch.eye(3)
    images = rand(*shape)
    saturated = torch.zeros(shape, dtype=torch.bool)
    saturated[1, :, 2, 2] = True
    images[2, :, 4, 4] = torch.nan
    flags = torch.where(mask, 0, int(Flag.OUTSIDE_MASK)).to(torch.int32)
    stack = PhotometricStack(
        names=tuple("abcdef"),
        images=images,
        saturated=saturated,
        mask=mask,
        alpha=alpha,
        light_vectors=vectors if known else None,
        view=torch.tensor([0.0, 0.0, 1.0]),
        flags=flags,
    )
    root = 0.2 * rand(*shape)
    scattering = Scattering(
        root=root,
        root_sd=0.01 * rand(*shape),
        measured=(True,) * 3 + (False,) * 3,
        n_d=n_d,
        n_d_sd=0.0,
        n_d_source="fixed",
        flags=torch.zeros_like(flags),
    )
    intensity = vectors.norm(dim=1) if known else torch.ones(LIGHTS)
    fit = Fit(
        a=torch.tensor([-0.8, -0.85, -0.8]),
        n_s=torch.tensor(6.0),
        n_d=torch.tensor(n_d),
        softness=torch.tensor(softness),
        f=torch.tensor(f),
        fresnel=torch.tensor(fresnel),
        ggx=ggx,
        materials=torch.tensor([[1.0, 6.0]]),
        material=torch.zeros(HEIGHT, WIDTH, dtype=torch.int32),
        global_names=("a_1",),
        covariance=torch.eye(1),
        d=(0.6 * rand(3, channels, HEIGHT, WIDTH) - 0.1) * mask,
        s=0.2 * rand(*shape) * mask,
        B=4 * rand(HEIGHT, WIDTH) * mask,
        d_sd=rand(3, channels, HEIGHT, WIDTH) * mask,
        B_sd=rand(HEIGHT, WIDTH) * mask,
        residual=0.01 * rand(*shape) * mask,
        intensity=intensity,
        flags=flags,
        noise=0.01,
        cost=1.0,
        iterations=3,
    )
    return separate(stack, scattering, fit, {"note": "made"}), stack, scattering, fit


EVERYTHING = {"channels": 3, "n_d": 1.4, "softness": 0.2, "fresnel": 0.7, "f": 0.6, "ggx": True}


@pytest.fixture(params=[{}, EVERYTHING], ids=["grey", "colour"])
def made(request):
    return make_separation(**request.param)


def test_components_are_their_formulas(made):
    result, stack, scattering, fit = made
    n_d, n_s, f, ggx = float(fit.n_d), float(fit.n_s), float(fit.f), fit.ggx
    directions = some_vectors()[:3] / BASIS_INTENSITY[:, None]
    M = torch.linalg.inv(directions)
    w = torch.einsum(
        "xk,khw->xhw", M, fit.a[:, None, None] + fit.B * (fit.d + (1 - f) * fit.s[:3]).mean(1)
    )  # the mirror direction, as long as the highlight's height has it
    w = w * (result.ceiling / w.norm(dim=0)).clamp_max(1)
    body = torch.einsum("xk,kchw->xchw", M, fit.d + fit.s[:3])
    for k in range(3):
        t = float(BASIS_INTENSITY[k])
        u = torch.einsum("x,xhw->hw", directions[k], w)
        size = w.norm(dim=0)
        lobe = u.clamp_min(0) ** n_s
        if ggx:
            cosine = u / size
            tail = (1 + n_s * (1 - cosine) / 2) ** -2 - (1 + n_s / 2) ** -2
            lobe = torch.where(u > 0, size**n_s * tail, 0.0)
        shine = t * lobe * stack.mask
        assert float(shine.max()) > 0.05
        torch.testing.assert_close(result.specular[k], shine.expand_as(result.specular[k]), rtol=1e-4, atol=1e-6)
        local = t * fit.d[k].clamp_min(0) ** n_d * stack.mask
        torch.testing.assert_close(result.local_diffuse[k], local, rtol=1e-4, atol=1e-6)
        # What the sweep gave: the intensity is inside its root already.
        scattered = scattering.root[k] ** n_d * stack.mask
        torch.testing.assert_close(result.scattering[k], scattered, rtol=1e-4, atol=1e-6)
        q = body.norm(dim=0)
        cosine = torch.einsum("x,xchw->chw", directions[k], body) / q
        soft = 0.5 * (cosine + (cosine.square() + fit.softness.square()).sqrt())
        entered = 1 - fit.fresnel * (1 - soft.clamp_max(1)) ** 5
        whole = t * (q * soft * entered).nan_to_num().clamp_min(0) ** n_d * stack.mask
        torch.testing.assert_close(result.diffuse[k], whole, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("pixels", [1, WIDTH, 4 * WIDTH])
def test_components_by_bands_of_rows_are_those_of_the_whole_picture(monkeypatch, pixels):
    whole = make_separation(**EVERYTHING)[0]
    monkeypatch.setattr(separation, "PIXELS_AT_ONCE", pixels)
    parts = make_separation(**EVERYTHING)[0]
    for name in separation.COMPONENTS:
        # But for powers, which a processor computes otherwise for the last few of a row of numbers.
        torch.testing.assert_close(getattr(parts, name), getattr(whole, name), rtol=1e-6, atol=1e-7)


def test_rows_of_a_result_relight_to_rows_of_its_picture(made):
    result = made[0]
    mix = torch.tensor([0.3, 0.4, 0.3])
    torch.testing.assert_close(result.rows(slice(2, 5)).relight(mix), result.relight(mix)[:, 2:5])


def test_highlight_free_is_the_picture_less_its_highlight_but_the_model_where_clipped(made):
    result, stack, _, _ = made
    free = torch.ones(3, *result.d.shape[1:], dtype=torch.bool)
    free[1, :, 2, 2] = free[2, :, 4, 4] = False
    free[..., ~stack.mask] = False
    assert result.highlight_free[..., stack.mask].isfinite().all()
    torch.testing.assert_close(result.highlight_free[free], (stack.images[:3] - result.specular)[free])
    assert torch.equal(result.highlight_free[~free], result.diffuse[~free])


def test_parameters_and_components_are_zero_outside_the_mask(made):
    result, stack, _, _ = made
    for name in ("d", "s", "B", "d_sd", "s_sd", "B_sd", "specular", "local_diffuse", "scattering", "diffuse"):
        assert float(getattr(result, name)[..., ~stack.mask].abs().max()) == 0.0, name
    for name in ("highlight_free", "residual"):
        assert float(getattr(result, name)[..., ~stack.mask].abs().max()) == 0.0, name


def test_relighting_by_a_basis_light_is_diffuse_and_specular(made):
    result, *_ = made
    torch.testing.assert_close(result.relight(torch.eye(3)), result.diffuse + result.specular)


def test_twice_the_light_is_twice_the_picture(made):
    result, stack, _, _ = made
    once = result.relight(stack.alpha)
    torch.testing.assert_close(result.relight(2 * stack.alpha), 2 * once, rtol=1e-4, atol=1e-6)
    assert float(once.max()) > 0.1


def test_no_light_is_black(made):
    result, *_ = made
    assert float(result.relight(torch.zeros(3)).abs().max()) < 1e-15


def test_intensity_is_that_of_the_mixed_vector():
    result, stack, _, _ = make_separation()
    unit, intensity = result.unit_mix(stack.alpha)
    assert stack.light_vectors is not None
    torch.testing.assert_close(intensity, stack.light_vectors.norm(dim=1))
    basis = stack.light_vectors[:3] / BASIS_INTENSITY[:, None]
    torch.testing.assert_close((unit @ basis).norm(dim=1), torch.ones(LIGHTS))


def test_without_light_vectors_alpha_enters_as_it_stands():
    result, stack, scattering, fit = make_separation(known=False)
    assert result.light_vectors is None
    alpha = torch.tensor([0.3, 0.5, 0.4])
    root = torch.einsum("i,ichw->chw", alpha, fit.d + fit.s[:3]).clamp_min(0)
    u = torch.einsum("i,ihw->hw", alpha, fit.a[:, None, None] + fit.B * fit.d[:, 0]).clamp_min(0)
    expected = (root + u**6) * stack.mask
    torch.testing.assert_close(result.relight(alpha), expected, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(result.scattering, positive_power(scattering.root[:3], 1.0) * stack.mask)


@pytest.mark.parametrize("lead", [(), (1,), (4,), (2, 3), (0,)])
def test_batches_keep_their_shape_and_their_pictures(made, lead):
    result, *_ = made
    alpha = torch.rand(*lead, 3, generator=torch.Generator().manual_seed(1))
    pictures = result.relight(alpha)
    assert pictures.shape == (*lead, *result.d.shape[1:])
    alone = [result.relight(a) for a in alpha.reshape(-1, 3)]
    for picture, expected in zip(pictures.reshape(-1, *result.d.shape[1:]), alone, strict=True):
        torch.testing.assert_close(picture, expected)


def test_alpha_may_be_a_list_or_an_array(made):
    result, *_ = made
    expected = result.relight(torch.tensor([0.3, 0.5, 0.4]))
    assert torch.equal(result.relight([0.3, 0.5, 0.4]), expected)
    assert torch.equal(result.relight(np.array([0.3, 0.5, 0.4], dtype=np.float32)), expected)


@pytest.mark.parametrize("ggx", [True, False])
def test_no_highlight_is_more_than_twice_as_high_as_those_of_most_pixels(tmp_path, ggx):
    _, stack, _, fit = make_separation(ggx=ggx)
    basis = some_vectors()[:3] / BASIS_INTENSITY[:, None]
    # w = M (a + B d) points at the viewer and is 0.9 long, but for one pixel's, which is 1.2 long.
    long = torch.full((HEIGHT, WIDTH), 0.9)
    long[4, 2] = 1.2
    d = torch.einsum("k,hw->khw", basis[:, 2], long + 0.9)[:, None] * stack.mask
    flat = replace(
        fit,
        a=-0.9 * basis[:, 2],
        n_s=torch.tensor(100.0),
        materials=torch.tensor([[1.0, 100.0]]),
        B=1.0 * stack.mask,
        d=d,
    )
    separation = separate(stack, None, replace(flat, s=torch.zeros_like(fit.s)), {})
    assert float(separation.ceiling) == pytest.approx(0.9 * 2 ** (1 / 100), rel=1e-4)
    frontal = torch.linalg.solve(some_vectors()[:3].mT, torch.tensor([0.0, 0.0, 1.0]))
    body = (long + 0.9)[4, 2]  # frontal light has the cosine 1
    shine = (separation.relight(frontal) - separation.relight(frontal)[0, 4, 3] + 1.8 - body)[0, 4, 2]
    height = 0.9**100 * (1 - (1.0 + 50.0) ** -2 if ggx else 1.0)
    assert float(shine) == pytest.approx(height, rel=0.02)  # twice the height, less the one of the pixel beside it
    free = replace(separation, ceilings=torch.tensor([torch.inf]))
    assert float(free.relight(frontal)[0, 4, 2]) > 1e7
    separation.save(tmp_path / "result")
    assert torch.equal(load(tmp_path / "result").relight(frontal), separation.relight(frontal))


@pytest.mark.parametrize("known", [True, False])
def test_relighting_is_differentiable_in_alpha(known):
    result, *_ = make_separation(**EVERYTHING | {"ggx": known}, known=known)
    values = {f.name: getattr(result, f.name) for f in fields(result)}
    exact = Separation(
        **{k: v.double() if isinstance(v, torch.Tensor) and v.is_floating_point() else v for k, v in values.items()}
    )
    alpha = torch.tensor([[0.3, 0.5, 0.4], [0.9, -0.1, 0.2]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: exact.relight(x)[..., 1:3, 1:4], (alpha,))


@pytest.mark.parametrize("alpha", [torch.zeros(2), torch.zeros(3, 4), torch.tensor(1.0)])
def test_alpha_of_another_shape_is_refused(made, alpha):
    with pytest.raises(ValueError, match=r"expected \(\.\.\., 3\)"):
        made[0].relight(alpha)


def test_alpha_that_is_no_number_is_refused(made):
    with pytest.raises(ValueError, match="not finite"):
        made[0].relight(torch.tensor([0.0, torch.nan, 1.0]))


def test_without_sweeps_scattering_is_what_the_fit_found():
    _, stack, _, fit = make_separation()
    result = separate(stack, None, fit, {})
    expected = BASIS_INTENSITY[:, None, None, None] * fit.s[:3] * stack.mask
    torch.testing.assert_close(result.scattering, expected)
    assert float(result.s_sd.abs().max()) == 0.0


def assert_same(left: Separation, right: Separation):
    for field in fields(Separation):
        a, b = getattr(left, field.name), getattr(right, field.name)
        if isinstance(a, torch.Tensor):
            assert a.dtype == b.dtype, field.name
            assert a.shape == b.shape, field.name
            assert np.array_equal(a.numpy(), b.numpy(), equal_nan=a.is_floating_point()), field.name
        else:
            assert a == b, field.name


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_saved_result_comes_back_bit_for_bit(tmp_path, channels, known):
    result, *_ = make_separation(**EVERYTHING | {"channels": channels, "ggx": known}, known=known)
    result.save(tmp_path / "result")
    back = load(tmp_path / "result")
    assert_same(result, back)
    alpha = torch.tensor([0.3, 0.5, 0.4])
    assert torch.equal(back.relight(alpha), result.relight(alpha))


def test_a_large_result_is_read_into_files_beside_it(tmp_path, monkeypatch):
    result = make_separation(channels=3)[0]
    result.save(tmp_path / "out")
    monkeypatch.setattr(room, "LEAST_BYTES", 1)
    same = load(tmp_path / "out")
    maps = Path("/proc/self/maps").read_text()
    assert maps.count(str(tmp_path)) >= len(separation.COMPONENTS) + len(("d", "s", "d_sd", "s_sd", "residual"))
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert_same(same, result)


def test_an_existing_folder_is_not_replaced_unasked(tmp_path):
    result, *_ = make_separation()
    result.save(tmp_path / "result")
    other = replace(result, d=result.d + 1)
    with pytest.raises(ResultError, match="result"):
        other.save(tmp_path / "result")
    assert_same(load(tmp_path / "result"), result)
    other.save(tmp_path / "result", overwrite=True)
    assert_same(load(tmp_path / "result"), other)


def test_a_folder_that_is_no_result_is_refused(tmp_path):
    with pytest.raises(ResultError, match="not a result"):
        load(tmp_path)


@pytest.mark.parametrize("layer", LAYERS)
def test_a_missing_or_damaged_layer_is_named(tmp_path, layer):
    result, *_ = make_separation()
    result.save(tmp_path / "result")
    path = tmp_path / "result" / layer
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x40
    path.write_bytes(data)
    with pytest.raises(ResultError, match=rf"{layer}.*damaged"):
        load(tmp_path / "result")
    path.unlink()
    with pytest.raises(ResultError, match=rf"{layer}.*missing"):
        load(tmp_path / "result")


def drop(name):
    return lambda document: document.pop(name)


@pytest.mark.parametrize(
    "edit",
    [
        drop("globals"),
        drop("lights"),
        drop("basis"),
        drop("view"),
        lambda document: document["globals"].pop("n_s"),
        lambda document: document["globals"].update(extra=1.0),
        lambda document: document["globals"].update(n_s="six"),
        lambda document: document["basis"].reverse() or document["basis"].append("z"),
        lambda document: document["lights"]["a"].pop("alpha"),
        lambda document: document["lights"]["a"].update(alpha=[1.0, 2.0]),
        lambda document: document.update(lights=[]),
        lambda document: document["globals"].update(softness=float("nan")),
        lambda document: document["globals"].pop("lobe"),
        lambda document: document["globals"].update(lobe="round"),
    ],
)
def test_a_document_that_does_not_fit_the_layers_is_refused(tmp_path, edit):
    result, *_ = make_separation()
    result.save(tmp_path / "result")
    path = tmp_path / "result" / "separation.json"
    document = json.loads(path.read_text())
    edit(document)
    path.write_text(json.dumps(document))
    with pytest.raises(ResultError, match=r"separation\.json"):
        load(tmp_path / "result")


def test_the_document_tells_lights_globals_and_flags(tmp_path):
    result, stack, _, _ = make_separation()
    result.save(tmp_path / "result")
    document = json.loads((tmp_path / "result" / "separation.json").read_text())
    assert document["note"] == "made"
    assert document["basis"] == ["a", "b", "c"]
    assert list(document["lights"]) == list("abcdef")
    assert document["globals"]["n_s"] == 6.0
    assert document["flags"]["OUTSIDE_MASK"] == int((~stack.mask).sum())
