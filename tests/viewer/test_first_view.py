"""What a page shows before anyone has touched it."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from reflectsep.viewer.page import write_page

from .test_browser import as_shown

pytestmark = [pytest.mark.slow, pytest.mark.browser]


def test_the_light_starts_where_nothing_is_extrapolated(page, result, tmp_path):
    """At the camera, or amid the basis lights where the camera is outside their triangle."""
    separation = result(size=24)
    write_page(tmp_path / "a.html", [as_shown(separation)])
    page.open(tmp_path / "a.html")
    assert [page.state()[key] for key in "xy"] == [0, 0]
    basis = torch.nn.functional.normalize(torch.tensor([[0.1, 0.1, 1.0], [0.6, 0.2, 1.0], [0.2, 0.7, 1.0]]), dim=1)
    vectors = torch.cat([basis, separation.light_vectors[3:]])
    aside = dataclasses.replace(separation, light_vectors=vectors)
    write_page(tmp_path / "b.html", [as_shown(aside)])
    page.open(tmp_path / "b.html")
    middle = torch.nn.functional.normalize(basis.sum(0), dim=0)
    assert [page.state()[key] for key in "xy"] == pytest.approx(middle[:2].tolist(), abs=1e-5)
    assert page.run("document.getElementById('extrapolated').hidden")
    assert page.run("location.hash") in ("", "#")
    page.key("ArrowRight")
    page.run("document.getElementById('reset').click()")
    page.settle()
    assert [page.state()[key] for key in "xy"] == pytest.approx(middle[:2].tolist(), abs=1e-5)


def test_without_scattering_there_is_no_fader_for_it(page, result, tmp_path):
    separation = result(size=24)
    opaque = dataclasses.replace(separation, s=torch.zeros_like(separation.s))
    for shown, hidden, body in ((separation, False, "Local diffuse"), (opaque, True, "Diffuse")):
        write_page(tmp_path / f"{hidden}.html", [as_shown(shown)])
        page.open(tmp_path / f"{hidden}.html")
        assert page.run("document.getElementById('row_scat').hidden") == hidden
        assert page.run("document.getElementById('loc_label').textContent") == body
        offered = page.run("[...document.getElementById('show').options].map(o => o.value)")
        assert ("scattering" in offered) == (not hidden)


def test_two_objects_of_different_size_are_both_in_sight(page, result, tmp_path):
    small, large = result(size=24), result(size=48)
    left = dataclasses.replace(small, mask=small.mask & (torch.arange(24) < 8))
    large = dataclasses.replace(large, mask=large.mask & (torch.arange(48) < 40) & (torch.arange(48)[:, None] < 40))
    write_page(tmp_path / "both.html", [as_shown(left, "left"), as_shown(large, "large")])
    page.size(1000, 700)
    page.open(tmp_path / "both.html", "layout=pair&r2=1&show2=whole&smooth=0")
    pixels = page.pixels()
    zoom = float(page.run("document.getElementById('zoom_text').textContent").rstrip(" %")) / 100
    seen = int((pixels[:, pixels.shape[1] // 2 + 2 :].max(-1) > 0).sum())
    # All of it: a pixel of the larger picture is half as large as one of the first, by which the zoom counts.
    assert seen == pytest.approx(int(large.mask.sum()) * (zoom / 2) ** 2, rel=0.05)
