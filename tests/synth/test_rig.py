from dataclasses import replace

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from reflectsep.data import Light
from reflectsep.errors import LightError, SettingsError
from reflectsep.synth.paper import paper_alpha
from reflectsep.synth.presets import make_object
from reflectsep.synth.rig import RIGS, SimulatedCamera, SimulatedRig, direction, make_rig, slab_frames


@settings(max_examples=60, deadline=None)
@given(
    st.floats(0, 70),
    st.floats(0, 360),
    st.sampled_from("xy"),
    st.integers(1, 9),
    st.floats(0.13, 7.0),
    st.integers(0, 99),
)
@example(0.0, 0.0, "x", 3, 2.884952440348699, 0)  # 3 steps over a step is 3.0000000000000004
def test_every_point_is_lit_in_exactly_width_over_step_frames(tilt, azimuth, axis, ratio, step, seed):
    points = torch.rand(300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * 90 - 45
    lit = slab_frames(points, direction(tilt, azimuth), axis, ratio * step, step)
    assert (lit.sum(1) == ratio).all()


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("light", [direction(0, 0), direction(35, 330), direction(60, 215)])
def test_a_sweep_starts_before_the_object_and_ends_after_it(light, axis):
    lit = slab_frames(make_object("wax", size=48).points, light, axis, 4.0, 2.0)
    assert not lit[:, 0].any()
    assert not lit[:, -1].any()
    assert lit[:, 1].any()
    assert lit[:, -2].any()


def test_a_width_that_is_no_multiple_of_the_step_lights_that_many_frames_on_average():
    points = torch.linspace(-40, 40, 4001, dtype=torch.float64)[:, None].expand(-1, 3)
    count = slab_frames(points, (0.0, 0.0, 1.0), "x", 5.0, 2.0).sum(1)
    assert set(count.tolist()) == {2, 3}
    assert count.double().mean() == pytest.approx(2.5, abs=0.02)


def test_the_slab_is_parallel_to_its_light():
    light = direction(40, 200)
    start = torch.tensor([[3.3, -2.7, 0.0], [-20.0, -11.0, 0.0], [20.0, 13.0, 0.0]], dtype=torch.float64)
    moved = start + torch.tensor([17.0, 0.0, 0.0])[:, None] * torch.tensor(light, dtype=torch.float64)
    for axis in ("x", "y"):
        before, after = (slab_frames(points, light, axis, 4.0, 2.0) for points in (start, moved))
        assert torch.equal(before, after)


def test_a_slab_moves_to_larger_x_and_larger_y():
    points = torch.tensor([[-10.0, -10.0, 0.0], [10.0, 10.0, 0.0]], dtype=torch.float64)
    for axis in ("x", "y"):
        lit = slab_frames(points, (0.0, 0.0, 1.0), axis, 2.0, 2.0)
        first, second = lit.double().argmax(1).tolist()
        assert second - first == 10


@pytest.mark.parametrize("name", sorted(RIGS))
def test_presets_hold_out_lights_inside_the_cone_of_the_basis_and_the_last_outside(name):
    rig = RIGS[name]
    alpha = paper_alpha((*rig.lights, *rig.heldout))[len(rig.lights) :]
    assert len(rig.heldout) == 4
    assert (alpha[:3] > 0).all()
    assert alpha[3].min() < 0


@pytest.mark.parametrize(("name", "count"), [("six", 6), ("paper", 6), ("twelve", 12), ("dome50", 50)])
def test_presets_have_their_lights_and_sweep_the_basis(name, count):
    rig = RIGS[name]
    assert len(rig.lights) == count
    assert rig.sweep_x == ("L1", "L2", "L3")
    assert rig.lit_frames == 2.0


@settings(max_examples=25, deadline=None)
@given(st.integers(3, 60), st.floats(5, 60), st.integers(1, 8))
def test_rigs_by_numbers_keep_their_held_out_lights_inside(lights, tilt, inside):
    rig = make_rig("r", lights=lights, basis_tilt_deg=tilt, heldout=(inside, 1))
    alpha = paper_alpha((*rig.lights, *rig.heldout))[lights:]
    assert (alpha[:-1] > 0).all()
    assert alpha[-1].min() < 0


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"slab_step_px": 5.0}, SettingsError, "slab of 4.0 px stepping 5.0 px"),
        ({"slab_step_px": 0.0}, SettingsError, "stepping 0.0 px"),
        ({"sweep_x": ("L9",)}, LightError, "sweeps for L9, which it has no light for"),
        ({"lights": (Light(name="a", direction=(0.0, 0.0, 1.0)),)}, LightError, "1 lights, expected at least the 3"),
        ({"heldout": (Light(name="L1", direction=(0.0, 0.0, 1.0)),)}, LightError, "expected all different"),
        ({"heldout": (Light(name="b", direction=(0.0, 1.0, 0.0)),)}, LightError, "light b needs a direction"),
    ],
)
def test_impossible_rigs_are_refused(change, error, says):
    with pytest.raises(error, match=says):
        replace(RIGS["six"], **change)


@pytest.mark.parametrize(
    "change",
    [
        {"bits": 3},
        {"bits": 17},
        {"full_exposure_s": 0.0},
        {"dark_level": -0.1},
        {"full_well_e": 0.0},
        {"gamma": 0.0},
        {"bits": 8, "saturation": 1.5},
        {"dark_frames": 0},
        {"peak": float("nan")},
    ],
)
def test_impossible_cameras_are_refused(change):
    with pytest.raises(SettingsError, match=r"simulated camera: .* expected"):
        SimulatedCamera(**change)


def test_more_sweeps_than_lights_are_refused():
    with pytest.raises(LightError, match="7 lights to sweep, but it has 6"):
        make_rig("r", sweeps=(7, 0))
    assert isinstance(make_rig("r", sweeps=(6, 2)), SimulatedRig)
