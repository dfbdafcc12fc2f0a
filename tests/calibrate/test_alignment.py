"""Alignment of whole captures, against the simulator's truth."""

import json
from dataclasses import replace

import pytest
import torch

from reflectsep.calibrate import alignment
from reflectsep.calibrate.align_options import AlignOptions
from reflectsep.calibrate.aligned_stream import aligned_stream
from reflectsep.calibrate.alignment import Alignment, align, covered
from reflectsep.calibrate.exposure import developed_stream, response_of
from reflectsep.calibrate.motion import Motion, displacement, shifted
from reflectsep.calibrate.stack import calibrate_stack, develop_pictures
from reflectsep.data import Frame, Sweep
from reflectsep.flags import Flag
from reflectsep.io.frames import open_sweep
from reflectsep.io.stack import read_full, read_mask
from reflectsep.progress import silent
from reflectsep.solve.sharing import one_thread
from reflectsep.synth.drift import Drift

from .conftest import simulated, truth

EYE = torch.eye(3, dtype=torch.float64)


def aligned(capture, options=None, progress=silent):
    response = response_of(capture)
    raw = read_full(capture)
    pictures, clipped = develop_pictures(capture, raw, response)
    streams = [developed_stream(capture, open_sweep(capture, sweep), response) for sweep in capture.sweeps]
    return align(capture, raw.names, pictures, clipped, read_mask(capture), streams, options=options, progress=progress)


@pytest.fixture(scope="module")
def drifted(tmp_path_factory):
    """A printed object; sweeps 1.5 px and 0.4 degrees, lights 2 px apart."""
    drift = Drift(between_px=1.5, between_deg=0.4, across_px=2.0)
    return simulated(tmp_path_factory.mktemp("drifted") / "capture", drift=drift)


@pytest.fixture(scope="module")
def found(drifted):
    return aligned(drifted)


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("still") / "capture")


def test_sweeps_are_found_against_the_full_pictures_of_their_lights(drifted, found):
    mask = read_mask(drifted)
    for sweep, motion in zip(drifted.sweeps, found.against_full, strict=True):
        relative = truth(drifted, f"sweep/{sweep.light}").matrix @ torch.linalg.inv(
            truth(drifted, f"full/{sweep.light}").matrix
        )
        assert motion.applied
        assert displacement(relative @ torch.linalg.inv(motion.matrix), mask) < 0.05


def test_lights_are_found_against_the_first(drifted, found):
    mask = read_mask(drifted)
    assert not found.pictures["L1"].applied
    for name in drifted.names[1:]:
        motion = found.pictures[name]
        assert motion.applied
        error = displacement(truth(drifted, f"full/{name}").matrix @ torch.linalg.inv(motion.matrix), mask)
        assert error < 0.2
        assert error < 4 * motion.sd_px


def test_pictures_side_by_side_are_those_one_after_the_other(drifted, monkeypatch):
    told = []
    progress = lambda stage, done, total: told.append((stage, done, total))  # noqa: E731
    with one_thread(), monkeypatch.context() as patch:
        # Two are said to be there, but torch keeps to one: by its own two, sums differ by rounding.
        patch.setattr(torch, "set_num_threads", lambda count: None)
        patch.setattr(torch, "get_num_threads", lambda: 2)
        together = aligned(drifted, AlignOptions(scope="all"), progress).pictures
        patch.setattr(alignment, "SIDE_BY_SIDE_PX", 0)
        apart = aligned(drifted, AlignOptions(scope="all")).pictures
    lights = [entry for entry in told if entry[0] == "alignment"]
    assert lights == [("alignment", i + 1, len(drifted.names) - 1) for i in range(len(drifted.names) - 1)]
    assert {name: m.plain() for name, m in together.items()} == {name: m.plain() for name, m in apart.items()}


def test_a_sweep_is_moved_once_by_both_its_motions(drifted, found):
    for sweep, motion, own in zip(drifted.sweeps, found.sweeps, found.against_full, strict=True):
        light = found.pictures[sweep.light]
        torch.testing.assert_close(motion.matrix, own.matrix @ light.matrix)


def test_nothing_is_moved_in_a_still_capture(still):
    result = aligned(still)
    assert not result.moved
    assert all(motion.reason for motion in (*result.pictures.values(), *result.sweeps))
    stack, _ = calibrate_stack(still, alignment=result)
    plain, _ = calibrate_stack(still)
    assert torch.equal(stack.images, plain.images)
    assert torch.equal(stack.mask, plain.mask)


def test_shading_that_goes_with_the_light_is_no_motion(tmp_path):
    """A bumpy object without a print: its structure is shading."""
    capture = simulated(tmp_path / "wax", "wax")
    assert not any(motion.applied for motion in aligned(capture).pictures.values())


def test_same_light_alone_leaves_the_lights_where_they_are(drifted):
    result = aligned(drifted, AlignOptions(scope="same_light", richest="rigid"))
    assert not any(motion.applied for motion in result.pictures.values())
    assert all(motion.applied and motion.model == "rigid" for motion in result.sweeps)


def test_drift_inside_a_sweep(tmp_path):
    capture = simulated(tmp_path / "capture", drift=Drift(between_px=1.0, within_px=2.0))
    for sweep, motion in zip(capture.sweeps, aligned(capture).against_full, strict=True):
        true = truth(capture, f"sweep/{sweep.light}")
        assert motion.velocity == pytest.approx(true.velocity, abs=0.15)
        for time in (-1.0, 1.0):
            assert displacement(true.at(time) @ torch.linalg.inv(motion.at(time)), read_mask(capture)) < 0.2


def test_stack_has_the_pictures_where_the_first_has_them(drifted, found, still):
    stack, _ = calibrate_stack(drifted, alignment=found)
    before, _ = calibrate_stack(drifted)
    true, _ = calibrate_stack(still)
    inner = true.mask & stack.mask
    errors = [float((s.images - true.images)[..., inner].square().mean().sqrt()) for s in (stack, before)]
    assert errors[0] < 0.35 * errors[1]
    assert bool((stack.flags[read_mask(drifted) & ~covered(found, 64, 64)] & int(Flag.MOVED_OUT)).all())


def test_pixels_that_left_the_frame_are_flagged_and_not_fitted(still):
    result = aligned(still)
    moved = replace(result, pictures={**result.pictures, "L2": Motion(matrix=shifted(30.0, 0.0), applied=True)})
    stack, _ = calibrate_stack(still, alignment=moved)
    out = ~covered(moved, 64, 64) & read_mask(still)
    assert bool(out.any())
    assert not bool((stack.mask & out).any())
    assert bool((stack.flags[out] == int(Flag.MOVED_OUT)).all())


def test_stream_warps_every_frame_by_its_own_time():
    class Three:
        sweep = Sweep(light="L1", frames="{}.exr", count=3)

        def __len__(self):
            return 3

        def __iter__(self):
            for index in range(3):
                yield Frame(index=index, values=torch.arange(30.0).repeat(30, 1)[None])

    motion = Motion(matrix=shifted(2.0, 0.0), velocity=(1.0, 0.0), applied=True)
    frames = list(aligned_stream(Three(), motion))
    assert [float(frame.values[0, 15, 10]) for frame in frames] == pytest.approx([11.0, 12.0, 13.0])
    stream = Three()
    assert aligned_stream(stream, replace(motion, applied=False)) is stream


def test_clipped_frames_are_not_registered_and_say_so(tmp_path):
    capture = simulated(tmp_path / "capture", "wax", slab_exposure_s=0.16, bits=12, peak=0.8)
    result = aligned(capture)
    assert not any(motion.applied for motion in result.sweeps)
    assert any("not registered, clipped in" in text for text in result.warnings)
    assert any("scattering itself is cut off" in text for text in result.warnings)


def test_document_names_the_reference_and_every_motion(drifted, found):
    document = found.document(drifted)
    assert document["reference"] == "L1"
    assert list(document["pictures"]) == list(drifted.names)
    assert [(s["light"], s["direction"]) for s in document["sweeps"]] == [("L1", "x"), ("L2", "x"), ("L3", "x")]
    assert json.loads(json.dumps(document)) == document


def test_what_was_moved_is_told_and_what_was_not_found_too(drifted, found, still):
    told = found.told(drifted)
    for name in drifted.names[1:]:
        assert f"{name} by {found.pictures[name].displacement_px:.2f} px" in told
    assert f"L2 along x by {found.against_full[1].displacement_px:.2f} px" in told
    assert "L1 by" not in told
    assert aligned(still).told(still) == "no motion between lights proven; no sweep moved"
    same = aligned(still, AlignOptions(scope="same_light")).told(still)
    assert same == "motion between lights not looked for; no sweep moved"
    assert found.document(drifted)["told"] == told


def test_motions_of_a_window_are_those_of_the_whole(found):
    part = found.in_window(7, 4, (20, 16))
    assert part.size == (20, 16)
    assert any(motion.applied for motion in part.sweeps)
    here = torch.tensor([3.0, 5.0, 1.0], dtype=torch.float64)
    there = here + torch.tensor([7.0, 4.0, 0.0], dtype=torch.float64)
    pairs = [(found.pictures[name], motion) for name, motion in part.pictures.items()]
    for whole, motion in (*pairs, *zip(found.sweeps, part.sweeps, strict=True)):
        moved, expected = motion.at(0.5) @ here, whole.at(0.5) @ there
        torch.testing.assert_close(moved[:2] / moved[2], expected[:2] / expected[2] - there[:2] + here[:2])
    back = part.in_window(-7, -4, found.size)
    for one, two in zip(back.sweeps, found.sweeps, strict=True):
        torch.testing.assert_close(one.matrix, two.matrix)


def test_a_document_has_the_motions_of_every_exposure(drifted, found):
    own = Motion(matrix=shifted(0.7, 0.0), applied=True, reason="told")
    several = replace(found, exposures=tuple((own,) for _ in found.sweeps))
    again = Alignment.from_document(json.loads(json.dumps(several.document(drifted))))
    assert torch.equal(again.exposures[0][0].matrix, own.matrix)
    assert len(again.exposures) == len(found.sweeps)
