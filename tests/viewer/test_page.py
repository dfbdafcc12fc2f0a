"""The page's file: what is written, what is refused."""

from __future__ import annotations

import dataclasses
import json
import re

import pytest
import torch

from reflectsep.config import ViewJob
from reflectsep.errors import ResultError, SettingsError
from reflectsep.flags import WORDS, Flag
from reflectsep.jobs import run_view
from reflectsep.viewer.page import Shown, safe_json, write_page


def shown(separation, name="x"):
    return Shown(name=name, separation=separation, white=1.0)


def test_the_page_is_one_file_that_names_no_other(result, tmp_path):
    write_page(tmp_path / "page.html", [shown(result(size=16))])
    text = (tmp_path / "page.html").read_text()
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]
    assert not re.search(r"https?://|<link|<img|\bsrc=|@import|url\(", text)
    assert "default-src 'none'" in text
    assert "%%" not in text


def test_names_cannot_end_the_script_that_holds_them(result, tmp_path):
    name = "</script><b>%%DATA%%&lt;"
    write_page(tmp_path / "page.html", [shown(result(size=16), name)])
    text = (tmp_path / "page.html").read_text()
    assert "</script><b>" not in text
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert json.loads(data[1])["results"][0]["name"] == name


def test_json_without_markup_is_the_same_json():
    document = {"a": ["<", ">", "&", "</script>", "<!--", "\u2028é"]}
    assert json.loads(safe_json(document)) == document
    assert not set("<>&") & set(safe_json(document))


def test_every_flag_has_its_words():
    assert set(WORDS) == {flag.name for flag in Flag}


def test_the_stated_error_is_that_of_the_stored_halves(result, tmp_path):
    (fine,) = write_page(tmp_path / "a.html", [shown(result(size=48))])
    assert fine.within_one >= 0.999
    assert 60 < fine.psnr_db < 100
    (coarse,) = write_page(tmp_path / "b.html", [shown(result(size=48))], max_pixels=24 * 24)
    assert coarse.psnr_db < fine.psnr_db


def test_parameters_that_are_no_numbers_are_refused(result, tmp_path):
    separation = result(size=16)
    B = separation.B.clone()
    B[8, 8] = torch.nan
    with pytest.raises(ResultError, match=r"bad one: 1 values of B on the object are not finite"):
        write_page(tmp_path / "page.html", [shown(dataclasses.replace(separation, B=B), "bad one")])
    assert list(tmp_path.iterdir()) == []


def test_an_empty_object_or_three_results_are_refused(result, tmp_path):
    separation = result(size=16)
    empty = dataclasses.replace(separation, mask=torch.zeros_like(separation.mask))
    with pytest.raises(ResultError, match="no pixel"):
        write_page(tmp_path / "page.html", [shown(empty)])
    with pytest.raises(ResultError, match="3 results"):
        write_page(tmp_path / "page.html", [shown(separation)] * 3)


def test_the_job_writes_beside_the_result_and_says_how_exact_it_is(result, tmp_path):
    result(size=16).save(tmp_path / "one")
    result(size=16, n_d=1.0).save(tmp_path / "two")
    said = run_view(ViewJob(result=str(tmp_path / "one")))
    assert (tmp_path / "one" / "view.html").is_file()
    # One result goes by its object's name, two by their folders'.
    assert re.search(r"bumps: basis lights \d+\.\d dB from the result, 100\.00 %", said)
    with pytest.raises(ResultError, match=r"view\.html: exists"):
        run_view(ViewJob(result=str(tmp_path / "one")))
    out = str(tmp_path / "both.html")
    said = run_view(ViewJob(result=str(tmp_path / "one"), other=str(tmp_path / "two"), out=out))
    assert "one: basis lights" in said
    assert "two: basis lights" in said
    with pytest.raises(SettingsError, match="is the result itself"):
        run_view(ViewJob(result=str(tmp_path / "one"), other=str(tmp_path / "one"), out=str(tmp_path / "c.html")))
    with pytest.raises(SettingsError, match=r"must end in \.html"):
        ViewJob(result="x", out="page.png")
