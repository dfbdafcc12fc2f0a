"""The report: what it says of a result, that it is one safe file, and the numbers behind its figures."""

from __future__ import annotations

import dataclasses
import html
import re

import pytest
import torch

from reflectsep import presentation
from reflectsep.config import FitSettings
from reflectsep.data import Capture, Frame, PhotometricStack, Sweep
from reflectsep.errors import SweepError
from reflectsep.flags import WORDS, Flag
from reflectsep.presentation import command
from reflectsep.progress import silent
from reflectsep.report import charts
from reflectsep.report.advice import ADVICE, GENERAL, what_to_do
from reflectsep.report.charts import upper_limit
from reflectsep.report.figures import HeldOut
from reflectsep.report.quality import flag_shares, reproduce
from reflectsep.report.sweeps import view_sweep
from reflectsep.report.valley import cost_valley
from reflectsep.report.writer import Facts, lead, write_report

SIZE = 24


class Slab:
    """A slab four pixels wide in steps of two over a flat object that does not scatter."""

    def __init__(self, lost=()):
        self.sweep = Sweep(light="A", count=16, frames="{}.exr", lost=frozenset(lost))

    def __len__(self):
        return 16

    def __iter__(self):
        column = torch.arange(SIZE)
        for index in range(16):
            if index in self.sweep.lost:
                continue
            edge = 2 * index - 4
            lit = ((column >= edge) & (column < edge + 4)).float()
            yield Frame(index=index, values=(0.5 * lit).expand(1, SIZE, SIZE).clone())


@pytest.fixture
def flat():
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool)
    mask[:2] = False
    return PhotometricStack(
        names=("A", "B", "C"),
        images=torch.full((3, 1, SIZE, SIZE), 0.5) * mask,
        saturated=torch.zeros(3, 1, SIZE, SIZE, dtype=torch.bool),
        mask=mask,
        alpha=torch.eye(3),
        view=torch.tensor([0.0, 0.0, 1.0]),
        flags=torch.zeros(SIZE, SIZE, dtype=torch.int32),
    )


def test_a_sweep_is_seen_to_pass_at_its_speed_and_to_add_up(flat):
    view = view_sweep(flat, Slab(), n_d=1.0, lit_frames=2.0)
    inside = flat.mask
    # Pixel x is lit while 2 i - 4 <= x < 2 i: in frames floor(x / 2) + 1 and + 2.
    expected = (torch.arange(SIZE) // 2 + 1.5).expand(SIZE, SIZE)
    assert torch.allclose(view.peak[inside], expected[inside])
    assert view.peak[~inside].isnan().all()
    assert float(view.straight[1]) == pytest.approx(0.5, abs=0.05)
    assert torch.allclose(view.root_sum[0][inside], 2 * view.root_full[0][inside])
    for frame in view.frames:
        lit = frame.values[0] > 0
        assert bool((frame.band | ~lit)[inside].all())
        assert float(frame.filled[0][inside].max()) == 0.0


def test_roots_are_summed_with_the_exponent_of_the_result(flat):
    view = view_sweep(flat, Slab(), n_d=2.0, lit_frames=2.0)
    assert torch.allclose(view.root_sum[0][flat.mask], torch.tensor(2 * 0.5**0.5))
    assert torch.allclose(view.root_full[0][flat.mask], torch.tensor(0.5**0.5))


def test_a_sweep_without_frames_is_refused(flat):
    with pytest.raises(SweepError, match="no frame to show"):
        view_sweep(flat, Slab(lost=range(16)), n_d=1.0, lit_frames=2.0)


def test_the_valley_is_lowest_where_the_data_were_made(exact):
    found = cost_valley(*exact)
    middle = len(found.scales) // 2
    assert float(found.scales[middle]) == pytest.approx(1.0)
    assert divmod(int(found.misfit.argmin()), len(found.scales)) == (middle, middle)
    assert float(found.misfit[middle, middle]) < 1e-6
    assert int(found.along.argmin()) == middle
    # With B free the misfit is nowhere above that of the best common B.
    assert bool((found.along <= found.misfit.amin(1) + 1e-9).all())


def test_there_is_no_valley_without_a_highlight(exact):
    separation, stack = exact
    faint = dataclasses.replace(separation, flags=torch.full_like(separation.flags, int(Flag.FAINT_LOBE)))
    assert cost_valley(faint, stack) is None


def test_a_report_without_capture_says_what_is_missing(exact, tmp_path):
    separation, _ = exact
    notes = ("The capture is not there.",)
    write_report(tmp_path / "r.html", Facts(name="x", separation=separation, command="reflectsep fit", notes=notes))
    text = (tmp_path / "r.html").read_text()
    assert notes[0] in text
    assert "No picture was held out" in text
    assert text.count("data:image/png;base64,") >= 5
    assert "NaN" not in re.sub(r"base64,[^\"]*", "", text)


def test_what_was_moved_is_said_among_the_first_things(exact):
    separation, stack = exact
    told = "moved between lights: L3 by 1.52 px; no sweep moved"
    document = {**separation.document, "alignment": {"pictures": {}, "sweeps": [], "told": told}}
    facts = Facts(name="n", separation=separation, stack=stack, command="reflectsep fit n")
    assert told not in lead(facts)
    assert told in lead(dataclasses.replace(facts, separation=dataclasses.replace(separation, document=document)))


def test_names_and_warnings_are_no_markup(exact, tmp_path):
    separation, stack = exact
    evil = '<script>alert(1)</script>"><img src=x>'
    document = {**separation.document, "object": evil, "model": evil, "warnings": [evil], "capture": evil}
    named = dataclasses.replace(separation, names=(evil, *separation.names[1:]), document=document)
    facts = Facts(name=evil, separation=named, stack=stack, command=f"reflectsep fit {evil}", notes=(evil,))
    write_report(tmp_path / "r.html", facts)
    text = (tmp_path / "r.html").read_text()
    assert "<script" not in text
    assert "<img src=x" not in text
    assert "&lt;script&gt;alert(1)" in text
    assert GENERAL in text


def test_held_out_lights_come_with_their_numbers(exact, tmp_path):
    separation, _ = exact
    real = separation.relight(torch.tensor([0.4, 0.3, 0.4]))
    off = real + 0.01 * float(real[:, separation.mask].max())
    light = HeldOut(light="H1", real=real, ours=off, baseline=0.5 * real)
    facts = Facts(name="x", separation=separation, command="", heldout=[light], baseline=separation)
    write_report(tmp_path / "r.html", facts)
    text = (tmp_path / "r.html").read_text()
    assert "<td>40.0 dB</td>" in text  # 1 % of the peak
    assert "<td>50.0 %</td>" in text


@pytest.mark.parametrize("words", [words for words, _ in ADVICE])
def test_every_known_warning_has_its_own_advice(words):
    assert what_to_do(f"sweep of L1: {words} and more") == dict(ADVICE)[words]


def test_the_command_names_what_is_not_the_default(exact):
    separation, _ = exact
    document = {
        "capture": "/data/my wax",
        "heldout": ["L7"],
        "settings": {
            "fit": {"lobe": "power", "chunk": FitSettings().chunk, "n_s": None},
            "scatter": {"distance_px": 2.0},
        },
    }
    said = command(dataclasses.replace(separation, document=document), "out")
    assert said == (
        "reflectsep fit 'capture=/data/my wax' out=out 'basis=[L1,L2,L3]' 'heldout=[L7]' "
        "fit.lobe=power scatter.distance_px=2.0"
    )


def test_an_object_without_pixels_is_refused(exact, tmp_path):
    separation, _ = exact
    empty = dataclasses.replace(separation, mask=torch.zeros_like(separation.mask))
    with pytest.raises(ValueError, match="no pixel on the object"):
        write_report(tmp_path / "r.html", Facts(name="x", separation=empty, command=""))


def test_frames_to_show_are_those_that_were_asked_for(flat):
    view = view_sweep(flat, Slab(), n_d=1.0, lit_frames=2.0, frames=[3, 9])
    assert [frame.index for frame in view.frames] == [3, 9]
    with pytest.raises(SweepError, match="frames=16 to show: the sweep has 0 to 15"):
        view_sweep(flat, Slab(), n_d=1.0, lit_frames=2.0, frames=[2, 16])


NAMED = {
    "softness": (0.2, "shadow edges soft by 0.20 of the cosine"),
    "fresnel": (0.45, "45 % of Fresnel's losses in the body"),
    "f": (0.4, "the lobe turns with d + 0.60 s"),
    "ggx": (True, "GGX lobe of roughness 0.26"),
}


@pytest.mark.parametrize("there", [(), ("softness",), ("fresnel",), ("f",), ("ggx",), tuple(NAMED)])
def test_only_extensions_that_are_there_are_named(exact, tmp_path, there):
    separation, _ = exact
    changes = {name: NAMED[name][0] for name in there}
    changes |= {name: torch.tensor(value) for name, value in changes.items() if name != "ggx"}
    made = dataclasses.replace(separation, **changes)
    assert float(made.n_s) == 14.0
    write_report(tmp_path / "r.html", Facts(name="x", separation=made, command=""))
    text = html.unescape((tmp_path / "r.html").read_text())
    for name, (_, said) in NAMED.items():
        assert (said in text) == (name in there), name


def test_the_model_of_lin_lee_is_not_set_beside_itself(exact, tmp_path):
    separation, _ = exact
    nothing = torch.zeros_like(separation.s)
    opaque = dataclasses.replace(separation, s=nothing, scattering=nothing)
    write_report(tmp_path / "r.html", Facts(name="x", separation=opaque, command=""))
    text = (tmp_path / "r.html").read_text()
    assert "has no other to stand beside it" in text
    assert "Local diffuse light left" not in text


def test_frames_that_cannot_be_shown_are_an_error_and_nothing_is_written(exact, tmp_path, monkeypatch):
    def lacking(*_):
        raise SweepError("frames=999 to show: the sweep has 0 to 15")

    separation, stack = exact
    monkeypatch.setattr(presentation, "calibrate_stack", lambda *_, **__: (stack, None))
    monkeypatch.setattr(presentation, "sweep_views", lacking)
    capture = Capture(folder=tmp_path, object="x", lights={}, basis=separation.basis, images=())
    out = tmp_path / "r.html"
    with pytest.raises(SweepError, match="frames=999"):
        presentation.report(out, separation, capture, result="x", frames=[999], progress=silent)
    assert not out.exists()
    presentation.report(out, separation, capture, result="x", progress=silent)
    assert "frames=999 to show" in out.read_text()


def test_flags_are_a_table_that_needs_no_width(exact):
    separation, _ = exact
    flags = torch.zeros_like(separation.flags)
    on_object = separation.mask.nonzero()
    for row, column in on_object[: len(on_object) // 4]:
        flags[row, column] = int(Flag.SATURATED)
    share = 100 * (len(on_object) // 4) / len(on_object)
    said = flag_shares(dataclasses.replace(separation, flags=flags))
    assert f'<i style="width:{share:.4g}%"></i>{share:.1f} %' in said
    table, none = said.split("On no pixel")
    assert WORDS["SATURATED"] in table
    assert WORDS["SATURATED"] not in none
    assert html.escape(WORDS["FAINT_LOBE"]) in none


def test_settings_stand_as_they_are_typed(exact):
    separation, _ = exact
    document = {**separation.document, "settings": {"fit": {"n_s": None, "refine_n_d": False, "lobe": "auto"}}}
    body = reproduce(dataclasses.replace(separation, document=document), "reflectsep fit").body
    assert "<td>n_s</td><td>null</td>" in body
    assert "<td>refine_n_d</td><td>false</td>" in body


def test_the_limit_of_a_map_is_its_quantile_whatever_its_size(monkeypatch):
    monkeypatch.setattr(charts, "QUANTILE_OF", 1000)
    values = torch.linspace(0, 1, 50_001)
    assert upper_limit(values)[1] == pytest.approx(0.99, abs=2e-3)
