import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from reflectsep.calibrate import linear_combination
from reflectsep.calibrate.alpha import alpha_from_vectors, check_basis, condition_number, light_vector, solve_alpha
from reflectsep.calibrate.linear_combination import EstimateSettings, estimate_alpha, select_diffuse, signed_root
from reflectsep.data import Light
from reflectsep.errors import LightError


def direction(off_view_deg, azimuth_deg):
    off, azimuth = math.radians(off_view_deg), math.radians(azimuth_deg)
    return (math.sin(off) * math.cos(azimuth), math.sin(off) * math.sin(azimuth), math.cos(off))


LIGHTS = [
    direction(28, 90),
    direction(27, 210),
    direction(30, 330),
    direction(8, 20),
    direction(20, 270),
    direction(45, 150),
]
NAMES = ["L1", "L2", "L3", "L4", "L5", "L6"]


def render(vectors, *, size=72, highlight=0.8, noise=0.0, seed=0, channels=1, floor=0.0):
    """A half ball with bumps and spots: Lambert with attached shadows, a Blinn highlight, noise. (n, c, h, w), mask."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.linspace(1, -1, size), torch.linspace(-1, 1, size), indexing="ij")
    mask = x.square() + y.square() < 0.9
    z = (1 - x.square() - y.square()).clamp_min(0.02).sqrt()
    normal = torch.stack([x + 0.15 * torch.sin(9 * x), y + 0.15 * torch.cos(8 * y), z])
    normal = (normal / normal.norm(dim=0)).double()
    albedo = torch.where(torch.sin(5 * x) * torch.cos(4 * y) > 0, 0.9, 0.5)
    pictures = []
    for vector in vectors:
        light = torch.tensor(vector, dtype=torch.float64)
        diffuse = albedo * torch.einsum("chw,c->hw", normal, light)
        scattered = floor * albedo * light[2]  # linear in the light, as scattering is
        half = light / light.norm() + torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        lobe = torch.einsum("chw,c->hw", normal, half / half.norm()).clamp_min(0) ** 60
        pictures.append(diffuse.clamp_min(0) + scattered + highlight * light.norm() * lobe)
    images = torch.stack(pictures)[:, None].repeat(1, channels, 1, 1).float()
    images = images + noise * torch.randn(images.shape, generator=generator)
    return torch.where(mask, images, 0.0), mask


def solve(images, mask, vectors, **kwargs):
    usable = mask.expand_as(images)
    return solve_alpha(NAMES[: len(vectors)], vectors, images, usable, **kwargs)


unit_vectors = st.tuples(st.floats(-60, 60), st.floats(0, 360)).map(lambda t: direction(*t))


@given(lights=st.lists(unit_vectors, min_size=4, max_size=7), scale=st.floats(0.1, 10))
@settings(deadline=None, max_examples=40)
def test_alpha_rebuilds_every_vector_with_its_intensity(lights, scale):
    vectors = scale * torch.tensor(lights, dtype=torch.float64)
    assume(condition_number(vectors[:3]) < 50)
    alpha = alpha_from_vectors(vectors, vectors[:3])
    torch.testing.assert_close(alpha @ vectors[:3], vectors, rtol=0, atol=1e-9 * scale)
    torch.testing.assert_close(alpha[:3], torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-9)


def test_condition_number_is_that_of_the_directions():
    # Three lights at 30 degrees off one axis, 120 degrees apart: singular values sqrt(3) cos 30 and sqrt(1.5) sin 30.
    basis = torch.tensor([direction(30, a) for a in (0, 120, 240)], dtype=torch.float64)
    expected = math.sqrt(3) * math.cos(math.pi / 6) / (math.sqrt(1.5) * 0.5)
    assert condition_number(basis) == pytest.approx(expected)
    assert condition_number(torch.diag(torch.tensor([1.0, 5.0, 9.0])).double() @ basis) == pytest.approx(expected)


@pytest.mark.parametrize(
    "lights",
    [
        [direction(30, 0), direction(10, 0), direction(20, 180)],
        [direction(30, 0), direction(30, 0), direction(20, 90)],
        [direction(1, 0), direction(1, 120), direction(1, 240)],
    ],
    ids=["coplanar", "repeated", "bundled"],
)
def test_bad_basis_is_refused_with_its_condition_number(lights):
    with pytest.raises(LightError, match=r"L1, L2, L3 .*condition number (inf|\d)") as caught:
        check_basis(torch.tensor(lights), NAMES[:3])
    assert "\n" not in str(caught.value)


def test_condition_limit_is_an_argument():
    basis = torch.tensor([direction(30, a) for a in (0, 120, 240)])
    with pytest.raises(LightError, match="at most 2"):
        check_basis(basis, NAMES[:3], condition_limit=2.0)


def test_zero_vector_is_refused():
    with pytest.raises(LightError, match="zero"):
        check_basis(torch.tensor([[0.0, 0, 0], [0, 1, 0], [0, 0, 1]]), NAMES[:3])


def test_coloured_intensity_leaves_the_vector_at_unit_length():
    assert light_vector(Light(name="a", direction=(0, 0, 1), intensity=(2.0,))) == (0, 0, 2.0)
    assert light_vector(Light(name="a", direction=(0, 0, 1), intensity=(2.0, 3.0, 4.0))) == (0, 0, 1.0)
    assert light_vector(Light(name="a", intensity=(2.0,))) is None


def test_known_vectors_decide_and_the_pictures_agree():
    vectors = [*LIGHTS[:3], LIGHTS[3], tuple(1.7 * c for c in LIGHTS[4]), LIGHTS[5]]
    images, mask = render(vectors, noise=0.005)
    report = solve(images, mask, vectors)
    expected = torch.linalg.solve(torch.tensor(vectors[:3]).mT, torch.tensor(vectors).mT).mT
    torch.testing.assert_close(report.alpha, expected, rtol=0, atol=1e-5)
    assert report.source == ("basis",) * 3 + ("vectors",) * 3
    assert [a.light for a in report.agreement] == NAMES[3:]
    for agreement in report.agreement:
        assert agreement.angle_deg < 0.5
        assert abs(agreement.magnitude_percent) < 1.0


def test_a_wrong_vector_is_told_by_angle_and_magnitude():
    images, mask = render(LIGHTS, noise=0.002)
    off, azimuth = math.acos(LIGHTS[4][2]), math.atan2(LIGHTS[4][1], LIGHTS[4][0])
    turned = direction(math.degrees(off) + 5.0, math.degrees(azimuth))
    report = solve(images, mask, [*LIGHTS[:4], tuple(c / 1.25 for c in turned), LIGHTS[5]])
    told = {a.light: a for a in report.agreement}["L5"]
    assert told.angle_deg == pytest.approx(5.0, abs=0.3)
    assert told.magnitude_percent == pytest.approx(25.0, abs=1.0)


@pytest.mark.parametrize("channels", [1, 3])
def test_unknown_lights_are_estimated_through_highlights_and_shadows(channels):
    images, mask = render(LIGHTS, noise=0.005, channels=channels)
    truth = torch.linalg.solve(torch.tensor(LIGHTS[:3]).mT, torch.tensor(LIGHTS).mT).mT
    report = solve(images, mask, [None] * 6)
    torch.testing.assert_close(report.alpha[:3], torch.eye(3))
    torch.testing.assert_close(report.alpha, truth, rtol=0, atol=0.015)
    assert report.light_vectors is None
    assert report.condition is None
    assert report.source == ("basis",) * 3 + ("pictures",) * 3


def test_scattering_that_mixes_by_the_same_alpha_does_no_harm():
    lights = LIGHTS[:5]  # L6 throws attached shadows, which the floor would fill; here the mix itself is in question
    images, mask = render(lights, noise=0.003, floor=0.5)
    truth = torch.linalg.solve(torch.tensor(lights[:3]).mT, torch.tensor(lights).mT).mT
    torch.testing.assert_close(solve(images, mask, [None] * 5).alpha, truth, rtol=0, atol=0.015)


def test_mixed_knowledge_implies_the_unknown_vector():
    images, mask = render(LIGHTS, noise=0.003)
    report = solve(images, mask, [*LIGHTS[:4], None, LIGHTS[5]])
    assert report.source == ("basis",) * 3 + ("vectors", "pictures", "vectors")
    assert report.light_vectors is not None
    torch.testing.assert_close(report.light_vectors[4], torch.tensor(LIGHTS[4]), rtol=0, atol=0.01)
    assert [a.light for a in report.agreement] == ["L4", "L6"]


def test_unknown_basis_light_sends_every_alpha_to_the_pictures():
    images, mask = render(LIGHTS, noise=0.003)
    report = solve(images, mask, [LIGHTS[0], None, *LIGHTS[2:]])
    assert report.source == ("basis",) * 3 + ("pictures",) * 3
    assert report.agreement == ()


def test_the_root_domain_is_where_the_mix_is_linear():
    n_d = 0.4546
    images, mask = render(LIGHTS, highlight=0.0)
    curved = signed_root(images, 1 / n_d)
    truth = torch.linalg.solve(torch.tensor(LIGHTS[:3]).mT, torch.tensor(LIGHTS).mT).mT
    right = solve(curved, mask, [None] * 6, settings=EstimateSettings(n_d=n_d))
    wrong = solve(curved, mask, [None] * 6)
    torch.testing.assert_close(right.alpha, truth, rtol=0, atol=1e-4)
    assert float((wrong.alpha - truth).abs().max()) > 0.05


def test_beats_plain_least_squares_by_far():
    images, mask = render(LIGHTS, noise=0.003)
    truth = torch.linalg.solve(torch.tensor(LIGHTS[:3]).mT, torch.tensor(LIGHTS[5])[:, None])[:, 0]
    samples = images[:, 0, mask].mT
    plain = torch.linalg.lstsq(samples[:, :3], samples[:, 5:6]).solution[:, 0]
    robust = estimate_alpha(images[:3], images[5], mask[None]).alpha
    assert float((robust - truth).norm()) < 0.1 * float((plain - truth).norm())


def test_noise_in_the_basis_pictures_does_not_pull_alpha_towards_zero():
    truth = torch.linalg.solve(torch.tensor(LIGHTS[:3]).mT, torch.tensor(LIGHTS[4])[:, None])[:, 0]
    errors = []
    for seed in range(6):
        images, mask = render(LIGHTS, noise=0.03, highlight=0.0, seed=seed)
        errors.append(estimate_alpha(images[:3], images[4], mask[None]).alpha - truth)
    assert float(torch.stack(errors).mean(0).norm()) < 0.01


def test_standard_error_is_the_spread_over_noise():
    found = []
    for seed in range(16):
        images, mask = render(LIGHTS, noise=0.01, highlight=0.0, seed=seed)
        found.append(estimate_alpha(images[:3], images[3], mask[None]))
    spread = torch.stack([e.alpha for e in found]).std(0)
    claimed = torch.stack([e.sd for e in found]).mean(0)
    assert bool((claimed / spread > 0.5).all())
    assert bool((claimed / spread < 2.0).all())


def test_the_same_pictures_give_the_same_alpha_at_any_scale():
    images, mask = render(LIGHTS, noise=0.01)
    first = estimate_alpha(images[:3], images[4], mask[None])
    again = estimate_alpha(images[:3], images[4], mask[None])
    scaled = estimate_alpha(1000 * images[:3], 1000 * images[4], mask[None])
    assert bool((first.alpha == again.alpha).all())
    torch.testing.assert_close(scaled.alpha, first.alpha, rtol=1e-4, atol=1e-5)
    assert scaled.noise == pytest.approx(1000 * first.noise, rel=1e-3)


def test_a_share_of_the_pixels_is_enough():
    images, mask = render(LIGHTS, noise=0.003)
    whole = estimate_alpha(images[:3], images[4], mask[None])
    share = estimate_alpha(images[:3], images[4], mask[None], settings=EstimateSettings(most_pixels=500))
    torch.testing.assert_close(share.alpha, whole.alpha, rtol=0, atol=0.01)
    assert float(share.sd.norm()) < 10 * float(whole.sd.norm())


def test_of_a_very_large_picture_every_so_many_rows_and_columns_are_enough(monkeypatch):
    images, mask = render(LIGHTS, noise=0.003)
    monkeypatch.setattr(linear_combination, "LARGEST_PICTURE", 72 * 72)
    whole = estimate_alpha(images[:3], images[4], mask[None])
    expected = estimate_alpha(images[:3, :, ::2, ::2], images[4, :, ::2, ::2], mask[None, ::2, ::2])
    monkeypatch.setattr(linear_combination, "LARGEST_PICTURE", 72 * 72 // 4)
    share = estimate_alpha(images[:3], images[4], mask[None])
    assert torch.equal(share.alpha, expected.alpha)
    assert share.pixels < whole.pixels / 3
    torch.testing.assert_close(share.alpha, whole.alpha, rtol=0, atol=0.01)


def test_unusable_values_do_not_count():
    images, mask = render(LIGHTS, noise=0.003)
    expected = estimate_alpha(images[:3], images[4], (mask & (torch.arange(72) < 50))[None]).alpha
    images[:, :, :, 50:] = 1e6
    torch.testing.assert_close(
        estimate_alpha(images[:3], images[4], (mask & (torch.arange(72) < 50))[None]).alpha, expected
    )


@pytest.mark.parametrize("shade", [0.3, 0.6])
def test_a_cast_shadow_over_two_fifths_of_the_object_does_not_move_alpha(shade):
    images, mask = render(LIGHTS, noise=0.003)
    truth = torch.linalg.solve(torch.tensor(LIGHTS[:3]).mT, torch.tensor(LIGHTS[4])[:, None])[:, 0]
    columns = mask.sum(0).cumsum(0) < 0.4 * mask.sum()
    images[4] = torch.where(columns, shade * images[4], images[4])
    torch.testing.assert_close(estimate_alpha(images[:3], images[4], mask[None]).alpha, truth, rtol=0, atol=0.02)


def test_selection_leaves_out_highlights_and_shadows():
    roots = torch.ones(4, 1, 10, 10, dtype=torch.float64) + 0.001 * torch.arange(100.0).reshape(10, 10)
    roots[1, 0, 2, 2] = 2.0  # not so bright that the others would count as shadowed
    roots[3, 0, 5, 5] = 0.05
    chosen = select_diffuse(roots, torch.ones(1, 10, 10, dtype=torch.bool), EstimateSettings(faintest=0.0))
    assert not bool(chosen[0, 2, 2])
    assert not bool(chosen[0, 5, 5])
    assert bool(chosen[0, 0, 0])


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_repeated_basis_pictures_are_refused(noise):
    images, mask = render([LIGHTS[0], LIGHTS[0], LIGHTS[2], LIGHTS[4]], noise=noise, highlight=0.0)
    with pytest.raises(LightError, match=r"light L4 as a mix of L1, L2, L3.*repeated or coplanar"):
        solve(images, mask, [None] * 4)


def test_a_flat_object_does_not_carry_alpha():
    images = torch.rand(1, 1, 40, 40).repeat(4, 1, 1, 1) + 0.5
    images = images + 0.01 * torch.randn(images.shape, generator=torch.Generator().manual_seed(1))
    with pytest.raises(LightError, match="orientations"):
        solve(images, torch.ones(40, 40, dtype=torch.bool), [None] * 4)


def test_a_needless_estimate_that_fails_is_only_a_warning():
    images, mask = render(LIGHTS)
    images[4] = 0
    report = solve(images, mask, LIGHTS)
    assert report.estimates[1] is None
    assert len(report.warnings) == 1
    assert "L5" in report.warnings[0]
    assert bool(torch.isfinite(report.alpha).all())


def test_too_few_pixels_is_one_line():
    images, mask = render(LIGHTS)
    few = mask & (torch.arange(72) == 36)
    with pytest.raises(LightError, match="pixels are diffuse and lit") as caught:
        solve(images, few, [None] * 6)
    assert "\n" not in str(caught.value)
