"""Tiles of a capture: how it is cut, and how parts become one result again."""

import dataclasses
import itertools
import json
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from reflectsep import jobs, pipeline, tiling
from reflectsep.config import FitJob, FitSettings, InfoJob, ObjectSettings, RigSettings, SimulateJob
from reflectsep.data import Region
from reflectsep.errors import FitError, ResultError, SettingsError
from reflectsep.fit import reflectance
from reflectsep.separation import MAPS, load
from reflectsep.tiling import TilesJob, Tiling, join, run_tiles, say, shares, spans

SIZE = (64, 64)


@given(st.integers(1, 6), st.integers(8, 40), st.integers(0, 300))
def test_pieces_cover_everything_and_overlap_as_told(count, overlap, more):
    length = count * 2 * overlap + more
    pieces = spans(length, count, overlap)
    assert pieces[0][0] == 0
    assert sum(pieces[-1]) == length
    for (start, size), (after, _) in itertools.pairwise(pieces):
        assert start + size - after == overlap


def test_tiles_that_cannot_be_are_refused():
    with pytest.raises(
        SettingsError, match=r"4 tiles of 64 pixels with overlap_px=20: a tile of 26 pixels; expected 40"
    ):
        Tiling(columns=4, rows=1, overlap_px=20).regions(SIZE)
    with pytest.raises(SettingsError, match="overlap_px=7: must be at least 8"):
        Tiling(columns=1, rows=1, overlap_px=7)
    with pytest.raises(SettingsError, match="rows=0: must be at least 1"):
        Tiling(columns=1, rows=0)


def test_a_tile_has_all_the_say_where_the_picture_itself_ends():
    weight = say(Region(x=0, y=10, width=30, height=54), SIZE, 8)
    assert weight.shape == (54, 30)
    assert float(weight[20, 0]) == 1.0  # the picture's left edge
    assert float(weight[-1, 5]) == 1.0  # and its bottom
    assert 0.0 < float(weight[0, 5]) < 1e-5  # it misses its neighbours
    assert float(weight[3, 5]) == pytest.approx(1.5 / 4)
    assert float(weight[20, -3]) == pytest.approx(0.5 / 4)
    assert float(weight[6, 5]) == 1.0


@pytest.mark.parametrize("cut", ["feathered", "hard"])
def test_shares_add_up_wherever_a_tile_has_the_object(cut):
    plan = Tiling(columns=2, rows=3, overlap_px=10, cut=cut)
    regions = plan.regions(SIZE)
    masks = [
        torch.rand(r.height, r.width, generator=torch.Generator().manual_seed(i)) > 0.3 for i, r in enumerate(regions)
    ]
    total, known = torch.zeros(64, 64), torch.zeros(64, 64, dtype=torch.bool)
    for region, mask, share in zip(regions, masks, shares(regions, masks, SIZE, plan), strict=True):
        total[region.rows, region.columns] += share
        known[region.rows, region.columns] |= mask
        assert not share[~mask].any()
        assert set(share.unique().tolist()) <= {0.0, 1.0} or cut == "feathered"
    torch.testing.assert_close(total, known.float(), rtol=0, atol=1e-6)


def cut_up(whole, plan):
    """A result in the tiles of `plan`, as fits of them under the same globals would give it."""
    parts = []
    for region in plan.regions(SIZE):
        maps = {name: getattr(whole, name)[..., region.rows, region.columns].clone() for name in MAPS}
        own = {
            "region": region.plain(),
            "cost": 2.0,
            "iterations": 3,
            "residual": {"rms": 0.1},
            "timings_s": {"fit": 1.5},
        }
        document = {**whole.document, **own, "created": f"{region}"}
        parts.append(dataclasses.replace(whole, **maps, document=document))
    return parts


@pytest.fixture(scope="module")
def whole(result):
    return result()


@pytest.fixture
def plan():
    return Tiling(columns=2, rows=2, overlap_px=12)


@pytest.mark.parametrize("cut", ["feathered", "hard"])
def test_parts_of_a_result_are_that_result(whole, plan, cut, tmp_path):
    plan = dataclasses.replace(plan, cut=cut)
    parts = cut_up(whole, plan)
    joined = join("1234", parts, SIZE, plan)
    for name in MAPS:
        first, second = getattr(whole, name), getattr(joined, name)
        if cut == "hard" or not first.is_floating_point():
            assert torch.equal(first, second), name
        else:
            torch.testing.assert_close(first, second, rtol=1e-5, atol=1e-7, msg=name)
    document = joined.document
    assert "region" not in document
    assert [tile["region"] for tile in document["tiles"]] == [r.plain() for r in plan.regions(SIZE)]
    assert document["tiling"] == {"overlap_px": 12, "cut": cut}
    assert document["cost"] == 8.0
    assert document["timings_s"] == {"fit": 6.0}
    assert document["warnings"] == ["a warning"]
    rms = float(whole.residual[..., whole.mask].double().square().mean().sqrt())
    assert document["residual"]["rms"] == pytest.approx(rms, rel=1e-5)
    joined.save(tmp_path / "joined")
    assert torch.equal(load(tmp_path / "joined").specular, joined.specular)


def test_what_two_tiles_find_is_mixed_where_they_overlap(whole, plan):
    parts = cut_up(whole, plan)
    for i, part in enumerate(parts):
        for name in ("specular", "d"):
            getattr(part, name)[:] = float(i % 2)  # 0 in the left tiles, 1 in the right ones
    joined = join("1234", parts, SIZE, plan).specular[0, 0, 32]
    assert not joined[:26].any()
    assert joined[38:60].eq(1.0).all()
    ramp = joined[26:38]
    expected = ((torch.arange(12) + 0.5 - 3) / 6).clamp(0.0, 1.0)
    torch.testing.assert_close(ramp, expected, rtol=1e-4, atol=1e-5)
    hard = join("1234", parts, SIZE, dataclasses.replace(plan, cut="hard")).specular[0, 0, 32]
    assert set(hard.unique().tolist()) == {0.0, 1.0}
    assert int(hard.diff().abs().sum()) == 2 - int(whole.mask[32, -1])  # one cut, and the object's end


def test_a_value_that_is_none_has_no_say_outside_of_the_object(whole, plan):
    parts = cut_up(whole, plan)
    for part in parts:
        part.B_sd[~part.mask] = torch.nan
    assert join("1234", parts, SIZE, plan).B_sd.isfinite().all()


def test_tiles_that_do_not_belong_together_are_refused(whole, plan):
    parts = cut_up(whole, plan)
    other = dataclasses.replace(parts[2], n_s=parts[2].n_s + 1)
    with pytest.raises(
        ResultError, match=r"^t3: n_s is .*, but .* in t1; tiles are put together that were fitted with"
    ):
        join(["t1", "t2", "t3", "t4"], [*parts[:2], other, parts[3]], SIZE, plan)
    with pytest.raises(ResultError, match=r"^t2: of region \[0,?.*\], expected"):
        join(["t1", "t2", "t3", "t4"], [parts[0], parts[0], *parts[2:]], SIZE, plan)
    dimmed = dataclasses.replace(parts[3], alpha=parts[3].alpha * 0.9)
    with pytest.raises(ResultError, match=r"^t4: of other lights than t1"):
        join(["t1", "t2", "t3", "t4"], [*parts[:3], dimmed], SIZE, plan)


RIG = RigSettings(slab_width_px=8.0, slab_step_px=4.0, lights=6, sweeps=3, heldout=0)


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    out = tmp_path_factory.mktemp("tiles") / "capture"
    jobs.run_simulate(SimulateJob(object=ObjectSettings(name="wax", size_px=36), rig=RIG, out=str(out)))
    return out


@given(st.floats(0.02, 0.9))
def test_a_share_of_the_object_is_strewn_over_all_of_it(share):
    mask = torch.zeros(960, 1200, dtype=torch.bool)
    mask[100:900, 50:1150] = True
    stack = SimpleNamespace(mask=mask)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline.dataclasses, "replace", lambda _, mask: SimpleNamespace(mask=mask))
        found = pipeline.strewn(stack, share).mask
    assert not found[~mask].any()
    assert float(found.sum() / mask.sum()) == pytest.approx(share, abs=0.01)
    halves = (found[:500], found[500:], found[:, :600], found[:, 600:])
    wholes = (mask[:500], mask[500:], mask[:, :600], mask[:, 600:])
    for part, all_of_it in zip(halves, wholes, strict=True):
        assert float(part.sum() / all_of_it.sum()) == pytest.approx(share, abs=0.02)


def test_a_share_without_a_pixel_of_the_object_is_refused():
    mask = torch.zeros(64, 64, dtype=torch.bool)
    mask[30:40, 30:40] = True
    with pytest.raises(FitError, match=r"fit\.share=1e-09: no pixel of the object"):
        pipeline.strewn(SimpleNamespace(mask=mask), 1e-9)


@pytest.mark.slow
def test_a_capture_in_tiles_is_one_result(captured, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(reflectance, "START_N_S", (20.0, 20.0))
    monkeypatch.setattr(reflectance, "ROUNDS", 1)
    settings = FitSettings(tolerance=1e-2, max_iterations=2)
    out = tmp_path / "out"
    job = TilesJob(
        fit=FitJob(capture=str(captured), out=str(out), fit=settings), tiling=Tiling(columns=2, rows=1, overlap_px=8)
    )
    assert "tile_1: there" not in run_tiles(dataclasses.replace(job, only=1))
    assert not out.exists()
    said = run_tiles(job)
    assert f"{out}.tiles/tile_1: there already" in said
    assert f"{out}: 2 tiles put together" in said
    joined, first = load(out), load(f"{out}.tiles/first")
    assert joined.mask.shape == (36, 36)
    assert torch.equal(joined.n_s, first.n_s)
    assert "held as they are in" in jobs.run_info(InfoJob(path=str(out)))
    # A first fit that is made again has other globals.
    document = json.loads(Path(f"{out}.tiles/first/separation.json").read_text())
    Path(f"{out}.tiles/first/separation.json").write_text(json.dumps({**document, "created": "later"}))
    again = dataclasses.replace(job, fit=dataclasses.replace(job.fit, out=str(out)))
    (tmp_path / "moved").mkdir()
    out.rename(tmp_path / "moved" / "out")
    with pytest.raises(ResultError, match=r"tile_1: its globals are those of a fit of .*, expected later"):
        run_tiles(again)
    with pytest.raises(SettingsError, match="only=3: expected a tile from 1 to 2"):
        run_tiles(dataclasses.replace(job, only=3))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["capture=c"], "capture, out, columns and rows are needed"),
        (["capture=c", "out=o", "columns=2", "rows=2", "row=3"], "unknown: row"),
        (["capture=c", "out=o", "columns=2", "rows=2", "cut=soft"], "cut=soft: expected feathered or hard"),
        (["capture=c", "out=o", "columns=2", "rows=0"], "rows=0: must be at least 1"),
    ],
)
def test_the_script_says_what_it_needs(words, said, capsys, monkeypatch):
    script = Path(tiling.__file__).parents[1] / "scripts" / "tiles.py"
    monkeypatch.setattr(sys, "argv", ["tiles.py", *words])
    threads = torch.get_num_threads()
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    torch.set_num_threads(threads)
    assert ended.value.code in (1, 2)
    assert said in capsys.readouterr().err
