import dataclasses

import pytest
import torch

from reflectsep.calibrate.stack import calibrate_stack
from reflectsep.config import FitSettings, ObjectSettings, ScatterSettings, SimulateJob
from reflectsep.errors import SettingsError, SweepError
from reflectsep.flags import Flag
from reflectsep.io.capture import load_capture
from reflectsep.io.exr import read_channels
from reflectsep.jobs import run_simulate
from reflectsep.pipeline import measure
from reflectsep.progress import silent
from reflectsep.scatter import ScatterOptions, gains, measure_scattering
from reflectsep.scatter.filling import FILLINGS
from reflectsep.scatter.options import HeldSweeps
from reflectsep.scatter.passage import watch
from reflectsep.scatter.shared import passage_of, tensors_of


def has(result, flag):
    return (result.flags & int(flag)) != 0


@pytest.mark.parametrize(("filling", "limit"), [("profile", 0.10), ("maximum", 0.10), ("interpolation", 0.15)])
def test_scattering_of_a_translucent_disc(body, error, filling, limit):
    b = body()
    result = measure_scattering(b.stack(), b.streams(), options=ScatterOptions(hole_filling=filling))
    for k in range(3):
        assert error(result.root[k, 0], b.truth(k, beyond_px=0.5)) < limit
    assert result.measured == (True, True, True)
    assert result.n_d_source == "estimated"


def test_more_distance_leaves_less(body):
    b = body()
    sums = [
        float(measure_scattering(b.stack(), b.streams(), options=ScatterOptions(distance_px=d)).root.sum())
        for d in (0.5, 1.0, 2.0, 4.0)
    ]
    assert sums == sorted(sums, reverse=True)
    assert sums[-1] < 0.75 * sums[0]


@pytest.mark.parametrize("filling", list(FILLINGS))
@pytest.mark.parametrize("width_px", [2.6, 3.3, 4.0])
def test_opaque_object_has_no_scattering(body, filling, width_px):
    b = body(albedo=0.0, width_px=width_px)
    stack = b.stack()
    result = measure_scattering(stack, b.streams(), options=ScatterOptions(hole_filling=filling))
    assert float(result.root[0].norm() / stack.images[0].norm()) < 0.005
    assert result.n_d == 1.0


def test_opaque_object_under_a_slab_as_wide_as_its_step(body):
    b = body(albedo=0.0, width_px=2.0, step_px=2.0)
    stack = b.stack()
    result = measure_scattering(stack, b.streams())
    assert float(result.root[0].norm() / stack.images[0].norm()) < 0.005


def test_plain_opaque_object_cannot_tell_n_d(body):
    b = body(albedo=0.0, width_px=3.0)
    result = measure_scattering(b.stack(), b.streams())
    assert result.n_d_source == "unidentifiable"
    assert result.n_d == 1.0
    assert 0.02 < result.n_d_sd < 10.0
    assert any("n_d cannot be told" in w for w in result.warnings)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_exponent_and_gain_with_noise_in_the_full_pictures(body, seed):
    b = body()
    result = measure_scattering(b.stack(noise=0.01, seed=seed), b.streams())
    assert abs(result.n_d - 1.0) < 0.01
    for report in result.sweeps:
        assert report.gain == pytest.approx(2.6, rel=0.003)


def test_exponent_of_a_camera_curve(body):
    b = body()
    result = measure_scattering(b.stack(gamma=1 / 2.2), b.streams(gamma=1 / 2.2))
    assert result.n_d == pytest.approx(1 / 2.2, abs=0.003)
    assert result.sweeps[0].gain == pytest.approx(2.6, rel=0.003)


def test_curve_is_undone_by_the_root(body, error):
    b = body()
    plain = measure_scattering(b.stack(), b.streams(), options=ScatterOptions(n_d=1.0))
    bent = measure_scattering(b.stack(gamma=0.5), b.streams(gamma=0.5), options=ScatterOptions(n_d=0.5))
    assert bent.n_d_source == "fixed"
    # The passage is found in the frames as they are, whose peaks a curve makes flatter.
    assert error(bent.root, plain.root) < 0.08


def test_fixed_exponent_is_kept(body):
    b = body()
    result = measure_scattering(b.stack(), b.streams(), options=ScatterOptions(n_d=1.0))
    assert (result.n_d, result.n_d_sd, result.n_d_source) == (1.0, 0.0, "fixed")


def test_unknown_exposure_ratio_goes_into_the_gain(body, error):
    b = body()
    plain, brighter = (measure_scattering(b.stack(), b.streams(gain=g)) for g in (1.0, 16.0))
    assert brighter.sweeps[0].gain == pytest.approx(16 * 2.6, rel=0.003)
    # Half the width comes from the profiles here, not from C, hence a difference at all.
    assert error(brighter.root, plain.root) < 0.05


def test_clipped_lit_frames_are_noticed(body, error):
    b = body()
    # Lit pixels hold at least 0.2, all others less.
    result = measure_scattering(b.stack(), b.streams(clip=0.2))
    assert any("clipped" in w and "sweep of L1" in w for w in result.warnings)
    assert result.sweeps[0].gain == pytest.approx(2.6, rel=0.25)
    assert error(result.root[0, 0], b.truth(0, 0.5)) < 0.45
    known = measure_scattering(b.stack(), b.streams(clip=0.2), options=ScatterOptions(lit_frames=2.6))
    assert known.sweeps[0].gain == 2.6


def test_shadowed_pixels_keep_all_their_light(body):
    b = body(shadow=True)
    stack = b.stack()
    result = measure_scattering(stack, b.streams())
    dark = (b.entering(0) == 0) & b.mask
    assert int(dark.sum()) > 20
    # Away from the shadow's edge, where half a pixel of slab may count either way.
    core = dark & (b.x > 9) & (b.x < 15) & (b.y > 14)
    ratio = result.root[0, 0][core] / stack.images[0, 0][core]
    assert float(ratio.median()) == pytest.approx(1.0, abs=0.05)
    assert not has(result, Flag.NO_SWEEP_COVERAGE)[core].any()


def test_a_lost_frame_is_filled_and_said(body, error):
    b = body()
    whole = measure_scattering(b.stack(), b.streams())
    result = measure_scattering(b.stack(), b.streams(lost=[10, 17, 18]))
    assert error(result.root[0], whole.root[0]) < 0.13
    assert abs(result.n_d - 1.0) < 0.01
    assert sum("3 frames lost" in w for w in result.warnings) == 3


def test_lights_without_a_sweep_are_mixed(body):
    b = body()
    alpha = [[0.3, 0.3, 0.4], [1.2, -0.1, -0.1]]
    result = measure_scattering(b.stack(extra=alpha), b.streams())
    assert result.measured == (True, True, True, False, False)
    for j, row in enumerate(alpha):
        mixed = sum(w * result.root[k] for k, w in enumerate(row))
        assert torch.allclose(result.root[3 + j], mixed, atol=1e-6)


def test_sweeps_of_one_light_are_averaged(body):
    b = body()
    across = [b.stream(0, "x"), b.stream(0, "y"), b.stream(1), b.stream(2)]
    one = measure_scattering(b.stack(), b.streams()).root[0]
    other = measure_scattering(b.stack(), [b.stream(0, "y"), b.stream(1), b.stream(2)]).root[0]
    both = measure_scattering(b.stack(), across)
    assert torch.allclose(both.root[0], (one + other) / 2, atol=2e-3)
    assert [r.direction for r in both.sweeps] == ["x", "y", "x", "x"]


def test_shadow_sweep_is_the_complement(body):
    b = body()
    stack = b.stack()
    streams = b.streams()
    shadows = []
    for k, s in enumerate(streams):
        frames = [stack.images[k] - f for f in s.frames]
        shadows.append(dataclasses.replace(s, sweep=dataclasses.replace(s.sweep, kind="shadow"), frames=frames))
    slab, shadow = measure_scattering(stack, streams), measure_scattering(stack, shadows)
    assert torch.allclose(slab.root, shadow.root, atol=1e-3)


def test_colour_is_treated_channel_by_channel(body):
    grey, colour = body(), body(channels=3)
    one = measure_scattering(grey.stack(), grey.streams())
    three = measure_scattering(colour.stack(), colour.streams())
    assert three.root.shape[1] == 3
    assert torch.allclose(three.root, one.root.expand_as(three.root), atol=1e-3)


def test_every_sweep_is_read_at_most_twice(body):
    b = body()
    for filling in FILLINGS:
        streams = b.streams()
        measure_scattering(b.stack(), streams, options=ScatterOptions(hole_filling=filling))
        assert all(len(s.passes) == 2 for s in streams), filling


def test_flags(body):
    b = body()
    stack = b.stack()
    result = measure_scattering(stack, b.streams())
    assert torch.equal(has(result, Flag.HOLE_FILLED), stack.mask)
    assert not has(result, Flag.SWEEP_SATURATED).any()
    assert (result.root[:, :, ~stack.mask] == 0).all()
    assert torch.isfinite(result.root).all()
    assert torch.isfinite(result.root_sd).all()


def test_clipping_beside_the_lit_band_is_flagged(body):
    b = body()
    result = measure_scattering(b.stack(), b.streams(clip=0.02))
    assert has(result, Flag.SWEEP_SATURATED).any()


def test_noise_of_the_frames_is_carried(body):
    b = body()
    clean, noisy = (measure_scattering(b.stack(), b.streams(noise=n)) for n in (0.0, 0.002))
    spread = float((noisy.root[0] - clean.root[0])[:, b.mask].std())
    claimed = float(noisy.root_sd[0][:, b.mask].median())
    assert 0.3 < claimed / spread < 3.0


def test_reports_speed_and_width(body):
    b = body()
    even = measure_scattering(b.stack(), b.streams()).sweeps[0]
    assert even.speed_deviation < 0.01
    assert even.lit_frames == pytest.approx(2.6, rel=0.1)
    assert even.coverage == 1.0
    streams = b.streams()
    # Every other frame of the second half is taken twice as the stage hesitates.
    frames = streams[0].frames
    uneven = frames[:18] + [f for f in frames[18:] for _ in range(2)]
    streams[0] = dataclasses.replace(streams[0], frames=uneven)
    assert measure_scattering(b.stack(), streams).sweeps[0].speed_deviation > 0.1


@pytest.mark.parametrize("until_px", [8.0, 13.0, 16.0])
def test_sweep_shorter_than_the_object(body, until_px):
    b = body()
    streams = [b.stream(0), b.stream(1, until_px=until_px), b.stream(2)]
    with pytest.raises(
        SweepError, match=r"sweep of L2 along x .*L2.*reached \d+% of the object, expected at least 90%"
    ):
        measure_scattering(b.stack(), streams)


def test_missing_basis_light(body):
    b = body()
    with pytest.raises(SweepError, match="no sweep of basis light L2"):
        measure_scattering(b.stack(), [b.stream(0), b.stream(2)])


def test_sweep_of_an_unknown_light(body):
    b = body()
    stray = b.stream(0)
    stray = dataclasses.replace(stray, sweep=dataclasses.replace(stray.sweep, light="L9"))
    with pytest.raises(SweepError, match=r"sweep of L9 .*no full picture"):
        measure_scattering(b.stack(), [*b.streams(), stray])


def test_too_few_frames(body):
    b = body()
    streams = b.streams()
    streams[1] = dataclasses.replace(streams[1], frames=streams[1].frames[:4])
    with pytest.raises(SweepError, match=r"sweep of L2 .*4 frames, expected at least 5"):
        measure_scattering(b.stack(), streams)


def test_wrong_size(body):
    b = body()
    streams = b.streams()
    streams[2].frames[7] = torch.zeros(1, 24, 25)
    with pytest.raises(SweepError, match=r"sweep of L3 .*frame 7: 25x24x1, but the full picture is 24x24x1"):
        measure_scattering(b.stack(), streams)


def test_not_a_number(body):
    b = body()
    streams = b.streams()
    streams[0].frames[5] = streams[0].frames[5].clone()
    streams[0].frames[5][0, 12, 12] = torch.nan
    with pytest.raises(SweepError, match=r"sweep of L1 .*frame 5: 1 values on the object"):
        measure_scattering(b.stack(), streams)


def test_empty_mask(body):
    b = body()
    stack = dataclasses.replace(b.stack(), mask=torch.zeros(24, 24, dtype=torch.bool))
    with pytest.raises(SweepError, match="mask is empty"):
        measure_scattering(stack, b.streams())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n_d", 0.0),
        ("threshold", 1.5),
        ("distance_px", -1.0),
        ("hole_filling", "max"),
        ("lit_band", "x"),
        ("reach_frames", 0),
    ],
)
def test_impossible_settings(name, value):
    with pytest.raises(SettingsError, match=f"scatter.{name}={value}"):
        ScatterOptions(**{name: value})


def test_held_sweeps_are_not_solved_again_and_give_the_same_bit_for_bit(body, monkeypatch):
    b = body()
    free = measure_scattering(b.stack(), b.streams())
    told = HeldSweeps(n_d=free.n_d, n_d_sd=free.n_d_sd, n_d_source="estimated", sweeps=free.sweeps)
    for name in ("solve_exponent", "_lit_frames", "_samples"):
        monkeypatch.setattr(gains, name, None)
    held = measure_scattering(b.stack(), b.streams(), options=ScatterOptions(held=told))
    assert torch.equal(held.root, free.root)
    assert (held.n_d, held.n_d_sd, held.sweeps) == (free.n_d, free.n_d_sd, free.sweeps)
    # C divides the sum of the frames.
    doubled = tuple(dataclasses.replace(r, gain=2 * r.gain) for r in free.sweeps)
    half = measure_scattering(
        b.stack(), b.streams(), options=ScatterOptions(held=dataclasses.replace(told, sweeps=doubled))
    )
    assert float(half.root.sum() / free.root.sum()) == pytest.approx(0.5, rel=0.15)
    with pytest.raises(SettingsError, match=r"sweep of L\d along x: no gain of it is given; given are none"):
        measure_scattering(b.stack(), b.streams(), options=ScatterOptions(held=dataclasses.replace(told, sweeps=())))


def test_a_passage_goes_from_one_process_to_another_as_it_is(body):
    b = body()
    stream, full, mask = b.streams()[0], b.stack().images[0], b.stack().mask
    grid, some = torch.tensor([1.0, 1.3], dtype=torch.float64), mask.expand_as(full)
    there = watch(stream, full, mask, exponents=grid, samples=some, progress=lambda *_: None)
    back = passage_of(stream, tensors_of(there))
    for one, two in ((there, back), (there.kept, back.kept)):
        for field in dataclasses.fields(one):
            first, second = getattr(one, field.name), getattr(two, field.name)
            if isinstance(first, torch.Tensor):
                assert torch.equal(first, second), field.name
            elif field.name != "kept":
                assert first == second, field.name
                assert type(first) is type(second), field.name


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """The scattering of a simulated object with what it should be: a small picture, three slab sweeps, 12 bits."""

    def make(name):
        folder = tmp_path_factory.mktemp(name) / "capture"
        run_simulate(SimulateJob(object=ObjectSettings(name=name, preset=name, size_px=48), out=str(folder)))
        capture = load_capture(folder)
        stack, _ = calibrate_stack(capture)
        found = measure(capture, stack, FitSettings(), ScatterSettings(), silent)
        planes = [read_channels(folder / "truth" / f"{light}.exr") for light in stack.names[:3]]
        truth = torch.stack([torch.as_tensor(plane["scattering_beyond_1px.Y"]) for plane in planes])
        mean = stack.images.mean((0, 1))
        return stack, found, truth, stack.mask & (mean > 0.08 * stack.images.amax())

    return make


def test_wax_scatters_what_it_should_without_stripes(simulated, error):
    _, found, truth, inner = simulated("wax")
    measured = found.root[:3, 0]
    for k in range(3):
        assert error(measured[k][inner], truth[k][inner]) < 0.05
    # Second differences tell stripes: along the sweep's axis no more than along the slab.
    away = (measured - truth) * inner
    square = {}
    for axis in (-1, -2):
        bend = away.roll(1, axis) - 2 * away + away.roll(-1, axis)
        inside = inner & inner.roll(2, axis) & inner.roll(-2, axis)
        square[axis] = float(bend[:, inside].square().mean())
    assert square[-1] < 4.0 * square[-2]
    # What is claimed is about what is wrong.
    spread = ((measured - truth) / found.root_sd[:3, 0])[:, inner].square().mean().sqrt()
    assert 0.3 < float(spread) < 2.0


def test_opaque_plastic_scatters_nothing(simulated, error):
    stack, found, _, inner = simulated("plastic")
    for k in range(3):
        assert float(found.root[k, 0][inner].norm() / stack.images[k, 0][inner].norm()) < 0.005


@pytest.mark.parametrize("width_px", [2.0, 2.6, 3.0])
def test_scattering_beyond_a_pixel_by_slabs_of_any_width(body, error, width_px):
    b = body(width_px=width_px)
    result = measure_scattering(b.stack(), b.streams())
    # Of pixels a pixel apart half of the light wanders farther than a pixel.
    share = (b.r - 0.5).clamp(0, 1)
    for k in range(3):
        far = ((b.transport * share) @ b.entering(k).flatten()).view_as(b.x) * b.mask
        assert error(result.root[k, 0], far.float()) < 0.08
