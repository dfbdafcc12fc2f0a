"""What a result is compared with, fitted to the same pictures."""

from __future__ import annotations

import dataclasses

import torch

from reflectsep.calibrate.heldout import HeldOutPictures
from reflectsep.calibrate.motion import Motion
from reflectsep.comparison import left_out, weak_polynomial, without_a_lobe
from reflectsep.data import Light


def with_pictures(separation, pictures):
    """`separation` whose residual makes `pictures` the ones that it was fitted to."""
    return dataclasses.replace(separation, residual=pictures - separation.relight(separation.alpha))


def lit_by(separation, function):
    """Pictures (lights, channels, height, width) of `function` of the direction, times the intensity."""
    intensity = separation.light_vectors.norm(dim=-1)
    values = function(separation.light_vectors / intensity[:, None]) * intensity
    return values[:, None, None, None].expand(-1, *separation.d.shape[1:]).clone()


def test_least_squares_find_what_they_can_describe_at_any_intensity(result):
    separation = result(size=8, channels=3)
    polynomial = lambda v: 0.3 + 0.2 * v[:, 0] - 0.1 * v[:, 1] + 0.4 * v[:, 0] * v[:, 1] + 0.25 * v[:, 1] ** 2  # noqa: E731
    body = lambda v: v @ torch.tensor([0.3, -0.2, 0.7])  # noqa: E731
    vector = torch.tensor([0.3, -0.1, 0.9])
    wanted = 1.7 * vector / vector.norm()
    alpha = torch.linalg.solve(separation.light_vectors[:3].mT, wanted)
    found = without_a_lobe(with_pictures(separation, lit_by(separation, polynomial)), alpha)["PTM"]
    expected = float(1.7 * polynomial(wanted[None] / 1.7))
    torch.testing.assert_close(found, torch.full_like(found, expected), rtol=1e-3, atol=1e-4)
    found = without_a_lobe(with_pictures(separation, lit_by(separation, body)), alpha)["Lambert"]
    torch.testing.assert_close(found, torch.full_like(found, float(body(wanted[None]))), rtol=1e-4, atol=1e-5)


def test_a_lambertian_body_is_never_darker_than_black(result):
    separation = result(size=8, channels=1)
    dark = with_pictures(separation, -lit_by(separation, lambda v: v[:, 2]))
    assert float(without_a_lobe(dark, torch.tensor([0.4, 0.3, 0.3]))["Lambert"].abs().max()) == 0.0


def test_nothing_is_fitted_to_unknown_lights_nor_a_polynomial_to_too_few(result):
    alpha = torch.tensor([0.4, 0.3, 0.3])
    assert without_a_lobe(result(size=8, known=False), alpha) == {}
    few = result(size=8)
    few = dataclasses.replace(few, alpha=few.alpha[:5], light_vectors=few.light_vectors[:5], residual=few.residual[:5])
    assert set(without_a_lobe(few, alpha)) == {"Lambert"}


def test_a_polynomial_that_the_lights_do_not_determine_is_no_fair_figure(result):
    separation = result(size=8)
    turn = torch.arange(6) * torch.pi / 3 + 0.1
    ring = torch.stack([0.4 * turn.cos(), 0.4 * turn.sin(), torch.full((6,), 0.84).sqrt()], 1)
    ring[3:, :2] *= 1.01
    (line,) = weak_polynomial(dataclasses.replace(separation, light_vectors=ring))
    assert "PTM          not a fair figure: the 6 lights hardly tell its 6 terms apart" in line
    spread = torch.tensor([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.6, 0, 0.8], [0, -0.6, 0.8], [0.6, 0.6, 0.53]])
    assert weak_polynomial(dataclasses.replace(separation, light_vectors=spread)) == []
    assert weak_polynomial(result(size=8, known=False)) == []


def test_a_held_out_picture_says_that_it_was_moved_and_leaves_out_what_is_clipped(result):
    separation = result(size=8, channels=1)

    @dataclasses.dataclass
    class Lights:
        lights: dict

    capture = Lights({"A": Light(name="A", direction=(0.0, 0.0, 1.0)), "B": Light(name="B", direction=(0.0, 0.6, 0.8))})
    clipped = torch.zeros(2, 1, 8, 8, dtype=torch.bool)
    clipped[1, 0, 2, 3] = True
    pictures = HeldOutPictures(
        names=("A", "B"),
        values=torch.full((2, 1, 8, 8), 0.5),
        clipped=clipped,
        motions=(Motion(displacement_px=1.5, applied=True), Motion(displacement_px=0.02)),
    )
    moved, still = left_out(separation, separation, capture, pictures)
    assert moved.note == "its motion of 1.50 px undone"
    assert still.note == ""
    assert int((~still.counts).sum()) == 1
    assert float(still.real[0, 2, 3]) == 0.0
    assert left_out(separation, separation, capture, None) == []
