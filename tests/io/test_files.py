import errno
import json
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.errors import CaptureError, ResultError
from reflectsep.io.files import (
    atomic_folder,
    atomic_write,
    inside,
    read_json,
    refuse_existing,
    refuse_folder,
    sha256,
    write_json,
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_atomic_write_makes_folders_and_keeps_the_suffix(tmp_path):
    seen = []

    def write(path):
        seen.append(path)
        path.write_text("whole")

    atomic_write(tmp_path / "a" / "b.exr", write)
    assert (tmp_path / "a" / "b.exr").read_text() == "whole"
    assert seen[0].suffix == ".exr"
    assert seen[0].parent == tmp_path / "a"
    assert names(tmp_path / "a") == ["b.exr"]


def test_atomic_write_leaves_nothing_and_keeps_the_old_on_failure(tmp_path):
    target = tmp_path / "b.txt"
    target.write_text("old")

    def write(path):
        path.write_text("half")
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        atomic_write(target, write)
    assert target.read_text() == "old"
    assert names(tmp_path) == ["b.txt"]


def test_atomic_write_gives_the_mode_of_an_ordinary_file(tmp_path):
    (tmp_path / "plain").write_text("")
    atomic_write(tmp_path / "ours", lambda path: path.write_text(""))
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_atomic_folder_appears_whole(tmp_path):
    out = tmp_path / "deep" / "out"
    with atomic_folder(out, False) as folder:
        (folder / "x").write_text("1")
        assert not out.exists()
        assert folder.parent == out.parent
    assert names(out) == ["x"]
    assert names(out.parent) == ["out"]


def test_atomic_folder_leaves_nothing_on_failure(tmp_path):
    def fail():
        with atomic_folder(tmp_path / "out", False) as folder:
            (folder / "x").write_text("1")
            raise KeyError("stop")

    with pytest.raises(KeyError):
        fail()
    assert names(tmp_path) == []


@pytest.mark.parametrize("marker", ["separation.json", "capture.json"])
def test_atomic_folder_replaces_ours_only_when_asked_and_whole(tmp_path, marker):
    out = tmp_path / "out"
    out.mkdir()
    (out / marker).write_text("old")
    with pytest.raises(ResultError, match=r"out: exists.*overwrite=true"), atomic_folder(out, False):
        pass
    with pytest.raises(KeyError), atomic_folder(out, True):
        raise KeyError
    assert names(out) == [marker]
    with atomic_folder(out, True) as folder:
        (folder / "new").write_text("1")
        assert (out / marker).read_text() == "old"
    assert names(out) == ["new"]
    assert names(tmp_path) == ["out"]


def test_atomic_folder_never_replaces_what_is_not_ours(tmp_path):
    out = tmp_path / "home"
    out.mkdir()
    (out / "thesis.txt").write_text("years")
    for overwrite in (False, True):
        with pytest.raises(ResultError, match="not ours to replace"), atomic_folder(out, overwrite):
            pass
    assert names(out) == ["thesis.txt"]
    with pytest.raises(ResultError, match="not a folder"), atomic_folder(out / "thesis.txt", True):
        pass


def test_atomic_folder_takes_an_empty_folder(tmp_path):
    (tmp_path / "out").mkdir()
    with atomic_folder(tmp_path / "out", False) as folder:
        (folder / "x").write_text("1")
    assert names(tmp_path / "out") == ["x"]


@pytest.mark.parametrize("name", ["", "../x", "a/../../x", "/etc/passwd", "C:\\x", "\\x", "a\\..\\..\\x", "a\0b"])
def test_inside_refuses(tmp_path, name):
    with pytest.raises(CaptureError):
        inside(tmp_path, name)


def test_inside_refuses_links_that_leave_but_follows_those_that_stay(tmp_path):
    folder = tmp_path / "capture"
    (folder / "sub").mkdir(parents=True)
    (tmp_path / "secret").write_text("s")
    (folder / "out").symlink_to(tmp_path / "secret")
    (folder / "up").symlink_to(tmp_path)
    (folder / "alias").symlink_to(folder / "sub")
    for name in ("out", "up/secret"):
        with pytest.raises(CaptureError, match="outside the folder"):
            inside(folder, name)
    assert inside(folder, "alias/x") == folder / "alias" / "x"
    (tmp_path / "link").symlink_to(folder)
    assert inside(tmp_path / "link", "sub/x") == tmp_path / "link" / "sub" / "x"


def test_inside_takes_names_with_dots_in_them(tmp_path):
    assert inside(tmp_path, "a..b/c...exr") == tmp_path / "a..b" / "c...exr"


def test_sha256_is_that_of_the_standard(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")  # the example of FIPS 180-4
    assert sha256(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


documents = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=10,
)


@given(document=documents)
def test_json_round_trip(tmp_path_factory, document):
    path = tmp_path_factory.mktemp("json") / "x.json"
    write_json(path, document)
    assert read_json(path) == document


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_json_without_nan(tmp_path, value):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "x.json", {"a": value})
    assert names(tmp_path) == []
    (tmp_path / "x.json").write_text(json.dumps({"a": value}))
    with pytest.raises(CaptureError, match=r"x\.json: .*is no number"):
        read_json(tmp_path / "x.json")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b'{"a": 1,}', "not JSON: .* at line 1"),
        (b'{"a": 1, "a": 2}', "'a' appears twice"),
        (b"1e999", "too large"),
        (b"\xff\xfe{}", "not UTF-8"),
        (b"[" * 100000, "recursion"),
        (b"", "not JSON"),
    ],
)
def test_json_errors_name_the_file(tmp_path, text, message):
    (tmp_path / "x.json").write_bytes(text)
    with pytest.raises(CaptureError, match=rf"x\.json: .*{message}|x\.json: {message}"):
        read_json(tmp_path / "x.json")


def test_json_missing_and_error_class(tmp_path):
    with pytest.raises(ResultError, match="no such file"):
        read_json(tmp_path / "none.json", ResultError)
    with pytest.raises(CaptureError, match="cannot be read"):
        read_json(tmp_path)


def test_nothing_is_left_when_rename_fails(tmp_path, monkeypatch):
    def refuse(self, target):
        raise OSError("full")

    monkeypatch.setattr("pathlib.Path.replace", refuse)
    with pytest.raises(OSError, match="full"):
        atomic_write(tmp_path / "x", lambda path: path.write_text("1"))
    assert names(tmp_path) == []


def test_old_folder_comes_back_when_the_new_one_cannot_be_moved(tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    (out / "capture.json").write_text("old")
    real = type(out).rename

    def rename(self, target):
        if self.name.endswith(".part"):
            raise OSError("full")
        return real(self, target)

    monkeypatch.setattr("pathlib.Path.rename", rename)
    with pytest.raises(OSError, match="full"), atomic_folder(out, True):
        pass
    assert (out / "capture.json").read_text() == "old"
    assert names(tmp_path) == ["out"]


def test_an_error_of_the_disk_names_what_was_to_be_written(tmp_path):
    def full(temporary):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match="No space left") as caught:
        atomic_write(tmp_path / "page.html", full)
    assert caught.value.filename == str(tmp_path / "page.html")
    with pytest.raises(OSError, match="No space left") as caught, atomic_folder(tmp_path / "out", False) as folder:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder / "L1.exr"))
    assert caught.value.filename == str(tmp_path / "out/L1.exr")
    with pytest.raises(FileNotFoundError) as caught, atomic_folder(tmp_path / "out", False):
        (tmp_path / "elsewhere").read_text()
    assert caught.value.filename == str(tmp_path / "elsewhere")


def test_an_output_that_can_never_be_written_is_refused_at_once(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultError, match=r"file/x/y: cannot be written: .*file is not a folder"):
        refuse_folder(tmp_path / "file/x/y", False)
    refuse_folder(tmp_path / "new/deep/folder", False)
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != tmp_path)
    with pytest.raises(ResultError, match=r"new/x\.png: cannot be written: nothing may be written in"):
        refuse_existing(tmp_path / "new/x.png", False)
