import dataclasses

import matplotlib.image
import numpy as np
import pytest
import torch

from reflectsep.report.figures import HeldOut
from reflectsep.report.metrics import psnr
from reflectsep.report.showcase import PAGE, Apart, showcase_figure, write_figure

SIZE = (40, 48)
Y, X = torch.meshgrid(torch.linspace(1, -1, SIZE[0]), torch.linspace(-1, 1, SIZE[1]), indexing="ij")
MASK = X.square() + Y.square() < 0.8
LIGHTS = ((0.0, 0.4, 0.9), (0.1, 0.0, 0.99))


def picture(*levels):
    colour = torch.tensor(levels if len(levels) > 1 else levels * 3)
    return colour[:, None, None] * (1.2 - X.square() - Y.square()) * MASK


def apart(shine=0.1, local=0.2):
    parts = {"specular": picture(shine), "local_diffuse": picture(local), "scattering": picture(0.6, 0.4, 0.2)}
    whole = sum(parts.values())
    return Apart(photograph=whole, highlight_free=whole - parts["specular"], **parts)


def relit(**changes):
    real = picture(0.7, 0.5, 0.3)
    return dataclasses.replace(HeldOut(light="L7", real=real, ours=real * 0.99, baseline=real * 0.9), **changes)


def figure(**changes):
    given = {"ours": apart(0.09), "truth": apart(), "baseline": apart(0.05), "relit": relit()} | changes
    return showcase_figure(**given, mask=MASK, directions=LIGHTS, words="12 lights")


def texts(drawn):
    return [text.get_text() for text in drawn.texts]


def test_components_the_truth_and_both_relit_pictures_are_there_with_their_numbers():
    light = relit(others={"Lambert": picture(0.6)})
    drawn = figure(relit=light)
    assert len(drawn.axes) == 5 + 4 + 5
    said = "\n".join(texts(drawn))
    for words in (
        "photograph",
        "off-specular",
        "local diffuse",
        "scattering",
        "highlights removed",
        "the truth",
        "12 lights",
    ):
        assert words in said
    assert "reflectsep off by 10 %, Lin & Lee 50 %" in said
    assert "reflectsep off by 0 %" in said
    for name in ("ours", "baseline"):
        assert f"{psnr(getattr(light, name), light.real, MASK):.1f} dB" in said
    assert f"(least squares {psnr(light.others['Lambert'], light.real, MASK):.1f} dB)" in said


def test_clipped_pixels_are_not_counted():
    real = picture(0.5)
    bad = (X > 0.2) & MASK
    spoilt = relit(real=real, ours=torch.where(bad, 9.0, real * 0.99), counts=~bad)
    assert f"{psnr(real * 0.99, real, MASK & ~bad):.1f} dB" in "\n".join(texts(figure(relit=spoilt)))


def test_a_faint_component_is_shown_brighter_and_says_so_in_its_title():
    faint = apart(0.02)
    said = texts(figure(ours=faint, truth=faint, baseline=faint))
    assert any(text.startswith("off-specular  ×") for text in said)
    assert "scattering" in said


def test_the_file_is_a_page_of_1600_pixels_on_which_nothing_stands_but_the_object(tmp_path):
    path = tmp_path / "front.png"
    write_figure(path, figure())
    pixels = matplotlib.image.imread(path)
    assert pixels.shape[1] == 1600
    page = np.array([int(PAGE[at : at + 2], 16) for at in (1, 3, 5)]) / 255
    assert np.abs(pixels[:3, :, :3] - page).max() < 0.01
    assert pixels[..., :3].max() > 0.9


@pytest.mark.parametrize("channels", [1, 3])
def test_grey_and_colour_are_drawn(channels):
    grey = {field.name: getattr(apart(), field.name)[:channels] for field in dataclasses.fields(Apart)}
    light = HeldOut(light="L7", **{name: picture(0.5)[:channels] for name in ("real", "ours", "baseline")})
    drawn = figure(ours=Apart(**grey), truth=Apart(**grey), baseline=Apart(**grey), relit=light)
    assert "inf dB from the photograph" in texts(drawn)


def test_pictures_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="cannot be compared"):
        figure(baseline=dataclasses.replace(apart(), specular=picture(0.1)[:, 1:]))
