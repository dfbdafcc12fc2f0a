"""The page in headless Chromium: its pixels are the model's, and it does what hands and addresses ask of it."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from reflectsep.data import Light
from reflectsep.relight import alphas_for
from reflectsep.report.tone import tone, white_point
from reflectsep.viewer.page import Shown, object_box, write_page

pytestmark = [pytest.mark.slow, pytest.mark.browser]

SIZE = 64
WINDOW = (1000, 700)


def as_shown(separation, name="bumps"):
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    return Shown(name=name, separation=separation, white=white)


def written(path, *separations, **options):
    write_page(path, [as_shown(s, f"result {i}") for i, s in enumerate(separations)], **options)
    return path


def directions_inside(separation, count, seed=0):
    """Random unit vectors with three positive alphas."""
    weights = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) + 0.02
    vectors = weights @ separation.light_vectors[:3]
    return vectors / vectors.norm(dim=1, keepdim=True)


def mix_of(separation, direction, intensity):
    light = Light(name="l", direction=tuple(direction.tolist()), intensity=(intensity,))
    return torch.tensor(alphas_for([light], separation.light_vectors)["l"].alpha)


def middle(pixels, size=SIZE):
    """The picture in a canvas that shows it 1 : 1."""
    top, left = round((pixels.shape[0] - size) / 2), round((pixels.shape[1] - size) / 2)
    return pixels[top : top + size, left : left + size]


def share_within_one(found, expected):
    apart = np.abs(found.astype(int) - expected.astype(int)).max(-1)
    return float((apart <= 1).mean()), int(apart.max())


@pytest.fixture(scope="module")
def colour(result):
    return result(size=SIZE)


@pytest.fixture(scope="module")
def colour_page(tmp_path_factory, colour):
    return written(tmp_path_factory.mktemp("page with spaces") / "the page.html", colour)


@pytest.fixture(autouse=True)
def window(page):
    page.size(*WINDOW)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"channels": 1, "n_d": 1.0, "softness": 0.0, "fresnel": 0.0, "f": 1.0, "ggx": False},
        {"unit": 3000.0},
        {"unit": 1e-5, "channels": 1},
        {"size": 600, "channels": 1},
    ],
    ids=["colour", "paper", "bright units", "faint units", "tiles"],
)
def test_canvas_is_relight_and_the_tone_curve_for_lights_inside_the_cone(page, result, tmp_path, options):
    separation = result(**{"size": SIZE, **options})
    size = separation.mask.shape[0]
    page.size(1000, max(700, size + 20))
    page.open(written(tmp_path / "page.html", separation), "zoom=1")
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    mean = float(separation.intensity.mean())
    for direction in directions_inside(separation, 20):
        page.settle(x=float(direction[0]), y=float(direction[1]))
        expected = tone(separation.relight(mix_of(separation, direction, mean)), white=white)
        share, worst = share_within_one(middle(page.pixels(), size), expected)
        assert share >= 0.999, f"worst {worst}"
        assert not page.run("!document.getElementById('extrapolated').hidden")
    assert page.errors == []


def test_picture_at_its_own_resolution_is_the_canvas(page, colour, colour_page):
    page.open(colour_page, "zoom=1&x=0.1&y=0.2&ev=-1")
    assert np.array_equal(page.pixels("picture"), middle(page.pixels()))


def test_two_lights_with_intensities_and_exposure_add_up(page, colour, colour_page):
    page.open(colour_page, "zoom=1")
    first, second = directions_inside(colour, 2, seed=3)
    page.settle(
        x=first[0].item(), y=first[1].item(), x2=second[0].item(), y2=second[1].item(), i1=0.7, i2=0.4, two=1, ev=-0.5
    )
    mean = float(colour.intensity.mean())
    linear = sum(colour.relight(mix_of(colour, v, i * mean)) for v, i in ((first, 0.7), (second, 0.4)))
    white = white_point(colour.highlight_free + colour.specular, colour.mask)
    share, worst = share_within_one(middle(page.pixels()), tone(linear * 2**-0.5, white=white))
    assert share >= 0.999, f"worst {worst}"


@pytest.mark.parametrize(
    ("show", "component"),
    [("specular", "specular"), ("local", "local_diffuse"), ("scattering", "scattering"), ("nospec", "diffuse")],
)
def test_components_of_a_basis_light_are_the_results(page, colour, colour_page, show, component):
    page.open(colour_page, "zoom=1")
    page.run("(() => { const e = document.getElementById('captured'); e.value = 1; e.onchange({target: e}); })()")
    page.settle(show=show)
    white = white_point(colour.highlight_free + colour.specular, colour.mask)
    expected = tone(getattr(colour, component)[1], white=white)
    share, worst = share_within_one(middle(page.pixels()), expected)
    assert share >= 0.999, f"worst {worst}"


@pytest.mark.parametrize("index", [0, 2, 4])
def test_measured_picture_is_the_captured_one(page, colour, colour_page, index):
    page.open(colour_page, f"zoom=1&show=measured&m={index}")
    white = white_point(colour.highlight_free + colour.specular, colour.mask)
    real = colour.relight(colour.alpha[index]) + colour.residual[index]
    expected = tone(real, white=white)
    lit = expected.min(-1) > 10  # below, an 8-bit code of one white is more than a code of another
    found = middle(page.pixels())
    assert share_within_one(found[lit], expected[lit])[0] >= 0.99


def test_highlight_fader_at_zero_removes_the_highlight_and_components_fade(page, colour, colour_page):
    page.open(colour_page, "zoom=1&x=0.1&y=0.1")
    page.settle(spec=0)
    without = page.pixels()
    page.settle(spec=1, show="nospec")
    assert np.array_equal(without, page.pixels())
    page.settle(show="whole", spec=0, loc=0, scat=1)
    only = middle(page.pixels())
    page.settle(spec=1, loc=1, show="scattering")
    # The edge of the shadow is soft in the whole picture alone.
    assert np.abs(only.astype(int) - middle(page.pixels()).astype(int)).max() <= 12


def test_gloss_changes_the_lobe_as_the_formula_says(page, result, tmp_path):
    separation = result(size=SIZE, ggx=False)
    page.open(written(tmp_path / "page.html", separation), "zoom=1")
    direction = directions_inside(separation, 1, seed=8)[0]
    page.settle(x=direction[0].item(), y=direction[1].item(), ns=5.0)
    other = dataclasses.replace(separation, n_s=torch.tensor(5.0), materials=torch.tensor([[1.0, 5.0]]))
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    expected = tone(other.relight(mix_of(other, direction, float(separation.intensity.mean()))), white=white)
    assert share_within_one(middle(page.pixels()), expected)[0] >= 0.999


def test_a_lobe_stops_at_the_ceiling_as_in_relight(page, result, tmp_path):
    separation = dataclasses.replace(result(size=SIZE), ceilings=torch.tensor([0.6]))
    page.open(written(tmp_path / "page.html", separation), "zoom=1")
    direction = directions_inside(separation, 1, seed=8)[0]
    page.settle(x=direction[0].item(), y=direction[1].item())
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    alpha = mix_of(separation, direction, float(separation.intensity.mean()))
    assert share_within_one(middle(page.pixels()), tone(separation.relight(alpha), white=white))[0] >= 0.999
    free = dataclasses.replace(separation, ceilings=torch.tensor([torch.inf]))
    assert share_within_one(middle(page.pixels()), tone(free.relight(alpha), white=white))[0] < 0.999


def test_dragging_moves_the_light_on_picture_and_hemisphere(page, colour_page):
    page.open(colour_page)
    left, top, width, height = page.box("#picture")
    centre = (left + width / 2, top + height / 2)
    reach = min(width, height) / 2
    page.drag(centre, (centre[0] + 0.5 * reach, centre[1] - 0.25 * reach))
    assert page.state()["x"] == pytest.approx(0.5, abs=0.01)
    assert page.state()["y"] == pytest.approx(0.25, abs=0.01)
    assert not page.run("document.getElementById('extrapolated').hidden")
    left, top, width, height = page.box("#dome")
    page.drag((left + width / 2, top + height / 2), (left + width / 2 - 20, top + height / 2))
    assert page.state()["x"] == pytest.approx(-20 / (width / 2 - 8), abs=0.01)
    assert page.state()["y"] == pytest.approx(0.0, abs=0.01)
    assert page.run("document.getElementById('extrapolated').hidden")


def test_touch_moves_the_light_and_two_fingers_zoom(page, colour, colour_page):
    page.open(colour_page)
    left, top, width, height = page.box("#picture")
    x, y = left + width / 2, top + height / 2
    page.touch([(x, y), (x + 50, y)])
    assert page.state()["x"] == pytest.approx(50 / (min(width, height) / 2), abs=0.01)
    before = page.state()
    page.touch([(x - 50, y), (x - 100, y)], [(x + 50, y), (x + 100, y)])
    after = page.state()
    assert after["x"] == before["x"]
    left, top, right, bottom = object_box(colour.mask)
    fit = min(width / (right - left), height / (bottom - top))
    assert after["zoom"] == pytest.approx(2 * fit, rel=0.02)
    assert (after["cx"], after["cy"]) == pytest.approx((0.5, 0.5), abs=0.02)


def test_keys_move_the_light_and_switch_views(page, colour_page):
    page.open(colour_page)
    page.run("document.getElementById('picture').focus()")
    page.key("ArrowRight")
    assert page.state()["x"] == pytest.approx(math.sin(math.radians(2)), abs=1e-6)
    page.key("ArrowUp", shift=True)
    assert page.state()["y"] == pytest.approx(math.sin(math.radians(10)), abs=1e-6)
    for key, layout in (("l", "lens"), ("s", "split"), ("b", "pair"), ("b", "single")):
        page.key(key)
        assert page.state()["layout"] == layout
    page.key("h")
    assert page.state()["spec"] == 0
    page.key("2")
    page.key("ArrowDown")
    assert page.state()["two"] == 1
    assert page.state()["y"] == pytest.approx(math.sin(math.radians(10)), abs=1e-6)  # the second light moved
    page.key("1")
    assert page.state()["zoom"] == 1


def test_sliders_change_the_state_and_double_click_sets_back(page, colour_page):
    page.open(colour_page)
    for key, value in (("spec", 0), ("loc", 0.5), ("scat", 1.5), ("ev", 2), ("i1", 2)):
        page.run(
            f"(e => {{ e.value = {value}; e.dispatchEvent(new Event('input')); }})(document.getElementById('{key}'))"
        )
        assert page.state()[key] == value
        page.run(f"document.getElementById('{key}').dispatchEvent(new Event('dblclick'))")
        assert page.state()[key] == (0 if key == "ev" else 1)


def test_lens_shows_its_component_inside_and_the_picture_outside(page, colour_page):
    page.open(colour_page, "x=0.1&y=0.1&smooth=0")
    whole = page.pixels()
    page.settle(show="specular")
    specular = page.pixels()
    page.settle(show="whole", show2="specular", layout="lens", lr=0.2)
    seen = page.pixels()
    height, width = seen.shape[:2]
    row, column = np.mgrid[:height, :width]
    far = np.hypot(column + 0.5 - width / 2, row + 0.5 - height / 2) - 0.2 * min(height, width)
    assert np.array_equal(seen[far < -3], specular[far < -3])
    assert np.array_equal(seen[far > 1], whole[far > 1])
    left, top, box_width, box_height = page.box("#picture")
    page.drag((left + box_width / 2, top + box_height / 2), (left + box_width / 2 + 100, top + box_height / 2))
    assert page.state()["lx"] == pytest.approx(0.5 + 100 / box_width, abs=1e-3)
    assert page.state()["x"] == 0.1


def test_split_and_side_by_side_show_both(page, result, tmp_path, colour):
    other = result(size=SIZE, n_d=1.0, channels=1)
    page.open(written(tmp_path / "page.html", colour, other), "x=0.1&y=0.1&smooth=0")
    first = page.pixels()
    page.settle(r1=1)
    second = page.pixels()
    assert not np.array_equal(first, second)
    page.settle(r1=0, r2=1, show2="whole", layout="split")
    seen = page.pixels()
    cut = seen.shape[1] // 2
    assert np.array_equal(seen[:, : cut - 2], first[:, : cut - 2])
    assert np.array_equal(seen[:, cut + 2 :], second[:, cut + 2 :])
    page.settle(layout="pair", zoom=1)
    seen = page.pixels()
    quarter = seen.shape[1] // 4
    top = round((seen.shape[0] - SIZE) / 2)
    halves = [seen[top : top + SIZE, x - SIZE // 2 : x + SIZE // 2] for x in (quarter, 3 * quarter)]
    assert not np.array_equal(*halves)
    assert all(half.max() > 50 for half in halves)


def test_the_fragment_holds_the_view_and_restores_it(page, colour_page):
    state = {
        "x": 0.2,
        "y": -0.1,
        "spec": 0.0,
        "layout": "lens",
        "lr": 0.3,
        "show2": "local",
        "ev": 0.5,
        "tone": "shoulder",
    }
    page.open(colour_page)
    page.settle(**state)
    page.until("location.hash.length > 10")
    shared = page.run("(dispatchEvent(new Event('pagehide')), location.hash)")
    seen = page.pixels()
    page.open(colour_page, shared[1:])
    assert {key: page.state()[key] for key in state} == state
    assert np.array_equal(page.pixels(), seen)


@pytest.mark.parametrize(
    "fragment",
    ["x=NaN&y=Infinity", "layout=%3Cscript%3E&show=constructor", "__proto__=1&ev=1e9&r1=7", "m=-5&zoom=-3", "%E0%A4%A"],
)
def test_a_fragment_that_anyone_may_have_written_does_no_harm(page, colour_page, fragment):
    page.open(colour_page, fragment)
    assert page.errors == []
    assert all(math.isfinite(value) for value in page.state().values() if not isinstance(value, str))
    assert page.state()["layout"] == "single"


def test_pan_and_zoom_keep_the_place_under_the_pointer(page, colour_page):
    page.open(colour_page)
    left, top, width, height = page.box("#picture")
    at = (left + width / 2 + 60, top + height / 2 - 40)
    zoom = page.run("Number(document.getElementById('zoom_text').textContent.replace('%', '')) / 100")
    page.call("Input.dispatchMouseEvent", type="mouseWheel", x=at[0], y=at[1], deltaX=0, deltaY=-400)
    page.until("reflectsep.state().zoom > 0")
    page.settle()
    state = page.state()
    before = (SIZE / 2 + 60 / zoom, SIZE / 2 - 40 / zoom)
    after = (SIZE * state["cx"] + 60 / state["zoom"], SIZE * state["cy"] - 40 / state["zoom"])
    assert after == pytest.approx(before, abs=0.3)
    page.drag(at, (at[0] + 30, at[1]), button="right")
    assert page.state()["cx"] == pytest.approx(state["cx"] - 30 / state["zoom"] / SIZE, abs=1e-3)
    assert page.state()["x"] == 0


def test_read_out_tells_the_parameters_of_the_pixel(page, colour, colour_page):
    page.open(colour_page, "zoom=1&x=0.1&y=0.1")
    left, top, width, height = page.box("#picture")
    column, row = 20, 40
    x = left + round((width - SIZE) / 2) + column + 0.5
    y = top + round((height - SIZE) / 2) + row + 0.5
    page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    page.settle()
    rows = page.run("[...document.querySelectorAll('#pixel tr')].map(r => [...r.children].map(c => c.textContent))")
    said = dict(rows)
    assert said["pixel"] == f"x {column}, y {row}"
    found = [float(word) for word in said["d"].split(" | ")[1].split()]
    assert found == pytest.approx(colour.d[:, 1, row, column].tolist(), rel=2e-2)
    assert float(said["B"]) == pytest.approx(float(colour.B[row, column]), rel=1e-2)
    assert said["flags"].count(";") == 2
    direction = torch.tensor([0.1, 0.1, math.sqrt(1 - 0.02)])
    value = colour.relight(mix_of(colour, direction, float(colour.intensity.mean())))[:, row, column]
    assert [float(w.strip(",")) for w in said["value"].split("(")[0].split()] == pytest.approx(value.tolist(), rel=1e-2)


@pytest.mark.parametrize("width", [400, 1200])
def test_labels_stand_on_one_line(page, colour_page, width):
    page.size(width, 800)
    page.open(colour_page)
    page.run("document.querySelectorAll('details').forEach(part => part.open = true)")
    page.call("Input.dispatchMouseEvent", type="mouseMoved", x=150, y=150)
    page.settle()
    lines = """[...document.querySelectorAll("details th")].map(label => {
        const range = document.createRange(); range.selectNodeContents(label);
        return [label.textContent, range.getClientRects().length]; })"""
    found = page.run(lines)
    assert len(found) > 8
    assert [name for name, count in found if name and count != 1] == []


def test_flags_are_marked(page, colour, colour_page):
    page.open(colour_page, "zoom=1&show=flags&flag=UNDEREXPOSED")
    seen = middle(page.pixels()).astype(int)
    marked = (seen[..., 0] - seen[..., 2]) > 60
    expected = (colour.flags.numpy() & 2048) > 0
    assert np.array_equal(marked, expected)


def test_nothing_leaves_the_file_and_names_are_no_markup(page, colour, tmp_path):
    folder = tmp_path / "a folder & <b>"
    path = folder / "page <script>.html"
    name = '</script><script>window.broken = 1</script><img src=http://example.invalid/x onerror="window.broken=1">'
    evil = dataclasses.replace(
        colour,
        names=(name, *colour.names[1:]),
        document={**colour.document, "object": name, "warnings": [name], "model": name},
    )
    write_page(path, [as_shown(evil, name)])
    url = page.open(path)
    page.settle(layout="lens", show2="measured", show="flags")
    page.screenshot()
    assert page.run("window.broken") is None
    assert [r for r in page.requests if not r.startswith(("data:", "blob:"))] == [url]
    assert page.errors == []
    assert name in page.run("document.getElementById('title').textContent")
    assert name in page.run("document.getElementById('about').textContent")
    assert page.run("fetch('http://127.0.0.1:9/').then(() => 'let out', () => 'refused')") == "refused"


def test_without_light_directions_a_light_is_a_mix(page, result, tmp_path):
    separation = result(size=SIZE, known=False)
    page.open(written(tmp_path / "page.html", separation), "zoom=1")
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    for index in range(6):
        page.settle(m=index)
        expected = tone(separation.relight(separation.alpha[index]), white=white)
        assert share_within_one(middle(page.pixels()), expected)[0] >= 0.999
    page.settle(m=-1, x=0, y=0)
    expected = tone(separation.relight(torch.full((3,), 1 / 3)), white=white)
    assert share_within_one(middle(page.pixels()), expected)[0] >= 0.999


def test_a_reduced_page_says_so_and_shows_the_coarser_level(page, result, tmp_path):
    separation = result(size=256, channels=1)
    (exact,) = write_page(tmp_path / "page.html", [as_shown(separation)], max_pixels=128 * 128)
    page.open(tmp_path / "page.html", "x=0.1&y=0.1")
    assert page.pixels("picture").shape[:2] == (128, 128)
    assert "here 128 x 128" in page.run("document.getElementById('about').textContent")
    assert 25 < exact.psnr_db < 90


def test_measures(page, result, tmp_path):
    """Frames a second under the software renderer, file size and load time; printed with `pytest -s`."""
    for width, height, size in ((512, 512, 512), (1024, 1024, 1024)):
        for channels in (1, 3):
            path = written(tmp_path / f"{size}{channels}.html", result(size=size, channels=channels))
            page.size(width + 340, height)
            page.open(path, "zoom=1")
            loaded, frame = page.run("reflectsep.loaded_ms()"), page.run("reflectsep.frame_ms(10)")
            page.settle(zoom=0.9)
            smooth = page.run("reflectsep.frame_ms(5)")
            said = {
                "size": size,
                "channels": channels,
                "MB": round(path.stat().st_size / 1e6, 1),
                "load_ms": round(loaded),
            }
            print(json.dumps({**said, "fps": round(1000 / frame, 1), "fps_smoothed": round(1000 / smooth, 1)}))
            assert 0 < frame < 5000
