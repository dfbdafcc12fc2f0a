import math
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
import torch
from matplotlib import pyplot

from reflectsep.report.figures import ComparisonRow, HeldOut, comparison_figure, write_comparison

SIZE = (48, 40)
Y, X = torch.meshgrid(torch.linspace(1, -1, SIZE[0]), torch.linspace(-1, 1, SIZE[1]), indexing="ij")
MASK = X.square() + Y.square() < 0.8


def picture(level, channels=3):
    return (level * (1.2 - X.square() - Y.square()) * MASK)[None].repeat(channels, 1, 1)


def row(channels=3, **changes):
    names = ("scattering", "local_diffuse", "specular", "baseline_diffuse", "baseline_specular")
    levels = (0.4, 0.3, 0.02, 0.6, 0.03)
    parts = {name: picture(level, channels) for name, level in zip(names, levels, strict=True)}
    return replace(ComparisonRow(light="L1", original=picture(0.72, channels), **parts), **changes)


def held_out(channels=3, **changes):
    real = picture(0.5, channels)
    return replace(HeldOut(light="L7", real=real, ours=real + 0.01 * MASK, baseline=real - 0.05 * MASK), **changes)


def texts(figure):
    found = [text.get_text() for text in figure.texts]
    for axes in figure.axes:
        found += [axes.get_title(), axes.get_xlabel(), axes.get_ylabel()]
    return found


def panel(figure, title):
    (axes,) = [axes for axes in figure.axes if axes.get_title() == title]
    return axes


@pytest.mark.parametrize("channels", [1, 3])
def test_every_panel_of_the_papers_rows_is_there(channels):
    figure = comparison_figure([row(channels)], [held_out(channels)], mask=MASK, title="wax")
    found = "\n".join(texts(figure))
    for words in (
        "wax",
        "Basis light L1",
        "(a) original",
        "(b) scattering",
        "(c) local diffuse",
        "(d) specular",
        "(e) diffuse, Lin & Lee",
        "(f) specular, Lin & Lee",
        "Held-out light L7",
        "(a) real",
        "(b) synthetic, ours",
        "(c) real − ours",
        "(d) synthetic, Lin & Lee",
        "(e) real − Lin & Lee",
        "real − synthetic, % of white",
        "white is",
    ):
        assert words in found


def test_numbers_are_those_of_the_pictures():
    figure = comparison_figure([], [held_out()], mask=MASK)
    real = picture(0.5)[:, MASK]
    expected = 10 * math.log10(float(real.max()) ** 2 / 0.05**2)
    caption = panel(figure, "(d) synthetic, Lin & Lee").get_xlabel()
    assert f"PSNR {expected:.1f} dB" in caption
    share = 100 * 0.05 / float(real.square().mean().sqrt())
    assert f"RMS error {share:.1f} %" in caption


def test_pixels_that_do_not_count_do_not_move_the_numbers():
    counts = MASK.clone()
    counts[:, :20] = False
    light = held_out(counts=counts)
    spoilt = light.real.clone()
    spoilt[:, :, :20] = 3.0
    one = comparison_figure([], [light], mask=MASK)
    other = comparison_figure([], [replace(light, real=torch.where(counts, light.real, spoilt))], mask=MASK)
    title = "(b) synthetic, ours"
    assert panel(one, title).get_xlabel() == panel(other, title).get_xlabel()


def test_faint_components_are_shown_brighter_and_say_so():
    figure = comparison_figure([row()], [], mask=MASK)
    ours = panel(figure, "(d) specular").get_xlabel()
    theirs = panel(figure, "(f) specular, Lin & Lee").get_xlabel()
    assert "shown ×16" in ours  # white is about 0.86, the brighter of the two about 0.036
    assert "shown ×16" in theirs
    assert "shown" not in panel(figure, "(a) original").get_xlabel()


def test_nothing_is_not_amplified():
    dark = torch.zeros(3, *SIZE)
    figure = comparison_figure([row(scattering=dark)], [], mask=MASK)
    assert "shown" not in panel(figure, "(b) scattering").get_xlabel()
    assert panel(figure, "(b) scattering").get_xlabel().startswith("0 %")


def test_truth_gives_an_error_under_the_component():
    figure = comparison_figure([row(true_specular=picture(0.04))], [], mask=MASK)
    assert "error 50 % of the true one" in panel(figure, "(d) specular").get_xlabel()
    assert "error 25 % of the true one" in panel(figure, "(f) specular, Lin & Lee").get_xlabel()
    assert "error" not in panel(figure, "(b) scattering").get_xlabel()


def test_differences_share_one_scale_with_the_sign_that_is_written():
    figure = comparison_figure([], [held_out(), held_out(light="L8")], mask=MASK)
    ours = panel_pixels(figure, "(c) real − ours")[0]
    theirs = panel_pixels(figure, "(e) real − Lin & Lee")[0]
    middle = tuple(size // 2 for size in ours.shape[:2])
    red, green, blue = (int(v) for v in ours[middle])
    assert red > blue  # ours is too bright: orange
    red, green, blue = (int(v) for v in theirs[middle])
    assert blue > green  # the baseline is too dark: purple
    assert abs(int(theirs[middle].sum()) - 3 * 255) > abs(int(ours[middle].sum()) - 3 * 255)


def panel_pixels(figure, title):
    return [axes.images[0].get_array() for axes in figure.axes if axes.get_title() == title]


def test_pictures_are_cut_to_the_object():
    figure = comparison_figure([row()], [], mask=MASK)
    shown = panel_pixels(figure, "(a) original")[0]
    tall, wide = int(MASK.any(1).sum()), int(MASK.any(0).sum())
    assert tall <= shown.shape[0] <= tall + 4
    assert wide <= shown.shape[1] <= wide + 4


def test_no_text_leaves_the_page_or_runs_into_another():
    figure = comparison_figure([row(true_specular=picture(0.04))] * 2, [held_out()] * 2, mask=MASK, title="wax")
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = [*figure.texts]
    for axes in figure.axes:
        drawn += [axes.title, axes.xaxis.label]
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in drawn if text.get_text().strip()]
    page = figure.bbox
    for index, box in enumerate(boxes):
        assert page.x0 <= box.x0
        assert box.x1 <= page.x1
        assert page.y0 <= box.y0
        assert box.y1 <= page.y1
        for other in boxes[:index]:
            assert not box.overlaps(other)


def test_png_is_written_whole_and_alone(tmp_path):
    out = tmp_path / "compare.png"
    write_comparison(out, [row()], [held_out()], mask=MASK)
    pixels = matplotlib.image.imread(out)
    assert pixels.shape[1] > 1000
    assert len(np.unique(pixels.reshape(-1, pixels.shape[2]), axis=0)) > 200
    assert [path.name for path in tmp_path.iterdir()] == ["compare.png"]
    assert pyplot.get_fignums() == []


def test_a_failed_figure_leaves_nothing(tmp_path):
    with pytest.raises(ValueError, match="not finite"):
        write_comparison(tmp_path / "c.png", [row(specular=picture(math.nan))], [], mask=MASK)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("rows", "lights", "mask", "message"),
    [
        ([], [], MASK, "no rows"),
        ([row()], [], torch.zeros_like(MASK), "empty mask"),
        ([row()], [], torch.ones(4, 4, dtype=torch.bool), "light L1: original of shape"),
        ([row(scattering=picture(0.1, 1))], [], MASK, "expected one shape"),
        ([], [held_out(ours=picture(math.inf))], MASK, "light L7: ours has values"),
    ],
)
def test_what_cannot_be_drawn(rows, lights, mask, message):
    with pytest.raises(ValueError, match=message):
        comparison_figure(rows, lights, mask=mask)


def test_lin_lees_model_itself_has_nothing_beside_it():
    figure = comparison_figure([row()], [held_out()], mask=MASK, baseline="")
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == [
        "(a) original",
        "(b) diffuse",
        "(c) specular",
        "(a) real",
        "(b) synthetic",
        "(c) real − synthetic",
    ]


def test_a_held_out_light_says_where_it_stands():
    light = held_out(place="60° off the view, outside the basis lights")
    figure = comparison_figure([], [light], mask=MASK)
    assert any(text.get_text().endswith("60° off the view, outside the basis lights") for text in figure.texts)
