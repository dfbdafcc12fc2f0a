import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reflectsep.data import Capture, Encoding, Light, Picture, Sweep
from reflectsep.errors import CaptureError
from reflectsep.io import manifest
from reflectsep.io.capture import files, load_capture, verify, write_manifest
from reflectsep.io.files import sha256


def test_loads(tiny):
    capture = load_capture(tiny.folder)
    assert capture.folder == tiny.folder
    assert capture.object == "wax"
    assert capture.size == (5, 4)
    assert capture.basis == ("L3", "L1", "L2")
    assert capture.names == ("L3", "L1", "L2", "L4")
    assert capture.lights["L4"].direction == (0, 0, 1)
    assert capture.lights["L3"].direction == pytest.approx([x / 1.36**0.5 for x in (-0.6, -0.6, 0.8)])
    assert capture.encoding == Encoding()
    assert capture.view == (0, 0, 1)
    assert capture.full("L2") == Picture(kind="full", light="L2", file="full/L2.exr", exposure_s=0.01)
    (sweep,) = capture.sweeps
    assert sweep == Sweep(light="L1", frames="sweep/L1/{:04d}.exr", count=3, exposure_s=0.16, time_s=(0, 1, 2))
    assert load_capture(tiny.folder / "capture.json") == capture


def edit(path, value):
    """Set the entry at `path`; a value of `...` removes it."""

    def apply(document):
        place = document
        for key in path[:-1]:
            place = place[key]
        if value is ...:
            del place[path[-1]]
        else:
            place[path[-1]] = value

    return apply


WRONG = [
    (["format"], "reflectsep-capture/2", "format is 'reflectsep-capture/2', expected 'reflectsep-capture/1'"),
    (["format"], ..., "format is None, expected"),
    (["viwe"], [0, 0, 1], "unknown key 'viwe'; did you mean 'view'"),
    (["images", 0, "exposure"], 0.1, r"images\[0\]: unknown key 'exposure'; did you mean 'exposure_s'"),
    (["sweeps", 0, "frame"], "x", r"sweeps\[0\]: unknown key 'frame'; did you mean 'frames'"),
    (["lights", "L1", "dir"], [0, 0, 1], r"lights\.L1: unknown key 'dir'; did you mean 'direction'"),
    (["encoding"], {"gama": 2.2}, "encoding: unknown key 'gama'; did you mean 'gamma'"),
    (["encoding"], {"gamma": 0}, r"encoding\.gamma: found 0, expected a positive number"),
    (["encoding"], {}, "encoding: found {}, expected"),
    (["encoding"], {"gamma": 2, "response": "r.csv"}, "encoding: found"),
    (["encoding"], "sRGB", "encoding: found 'sRGB', expected"),
    (["encoding"], {"response": "r.csv"}, r"r\.csv: no such file, but capture\.json names it \(encoding\)"),
    (["lights"], ..., "no 'lights' in it"),
    (["lights"], {}, "lights: found {}"),
    (["lights", "L1"], 3, r"lights\.L1: found 3, expected an object"),
    (["lights", "L1", "direction"], [0, 0, 1e-9], r"lights\.L1\.direction: .* has no direction"),
    (["lights", "L1", "direction"], [0, 1], r"lights\.L1\.direction: found \[0, 1\], expected three numbers"),
    (["lights", "L1", "direction"], [0, 1, "1"], r"lights\.L1\.direction\[2\]: found '1', expected a number"),
    (["lights", "L1", "direction"], [0, 1, True], r"lights\.L1\.direction\[2\]: found True, expected a number"),
    (["lights", "L1", "direction"], [0, 1, 10**400], r"direction\[2\]: .*a float can hold"),
    (["lights", "L1", "intensity"], -1, r"lights\.L1\.intensity: found -1, expected a positive number"),
    (["lights", "L1", "intensity"], [1, 2], r"lights\.L1\.intensity: .*three"),
    (["basis"], ["L1", "L2"], "basis: .*three different lights"),
    (["basis"], ["L1", "L2", "L2"], "basis: .*three different lights"),
    (["basis"], ["L1", "L2", "L9"], r"basis\[2\]: found 'L9', expected one of the lights L1, L2, L3, L4"),
    (["basis"], "L1", "basis: found 'L1', expected a list"),
    (["images"], [], "basis: basis light 'L3' has no full picture"),
    (["images", 0, "light"], "L3", "light 'L3' has 2 full pictures, expected one"),
    (["images", 0, "light"], "L7", r"images\[0\]\.light: found 'L7', expected one of the lights"),
    (["images", 0, "light"], ..., r"images\[0\]: a full picture needs its light"),
    (["images", 4, "light"], "L1", r"images\[4\]\.light: .*no light in a dark picture"),
    (["images", 0, "kind"], "half", r"images\[0\]\.kind: found 'half', expected 'full' or 'dark'"),
    (["images", 0, "file"], ..., r"images\[0\]: no 'file' in it"),
    (["images", 0, "file"], "../x.exr", r"images\[0\]\.file: .*leads out of the folder"),
    (["images", 0, "file"], "/x.exr", r"images\[0\]\.file: .*leads out of the folder"),
    (["images", 0, "file"], "none.exr", r"none\.exr: no such file, but capture\.json names it \(images\[0\]\)"),
    (["images", 4, "file"], "none.exr", r"none\.exr: no such file.*images\[4\]"),
    (["images", 0, "exposure_s"], 0, r"images\[0\]\.exposure_s: found 0, expected a positive number"),
    (["images", 0, "exposure_s"], "0.1", r"images\[0\]\.exposure_s: found '0.1', expected a number"),
    (["images", 0, "sha256"], "abc", r"images\[0\]\.sha256: .*64 hexadecimal"),
    (["mask"], "none.png", r"none\.png: no such file.*\(mask\)"),
    (["mask"], 1, "mask: found 1, expected a text"),
    (["size"], [5], r"size: found \[5\], expected \[width, height\]"),
    (["size"], [5, 0], r"size\[1\]: found 0, expected a whole number of at least 1"),
    (["size"], [5.0, 4], r"size\[0\]: found 5\.0, expected a whole number"),
    (["view"], [0, 0, 0], "view: .*no direction"),
    (["object"], "", "object: found '', expected a text"),
    (["sweeps"], {}, "sweeps: found {}, expected a list"),
    (["sweeps", 0, "count"], 0, r"sweeps\[0\]\.count: found 0, expected a whole number of at least 1"),
    (["sweeps", 0, "count"], True, r"sweeps\[0\]\.count: found True"),
    (["sweeps", 0, "time_s"], [0, 1], r"sweeps\[0\]\.time_s: 2 entries, but count is 3"),
    (["sweeps", 0, "time_s"], [0, "1", 2], r"sweeps\[0\]\.time_s\[1\]: found '1', expected a number"),
    (["sweeps", 0, "position_mm"], [0, None, 1], r"sweeps\[0\]\.time_s\[1\]: not null, but frame 1 is null elsewhere"),
    (["sweeps", 0, "light"], "L8", r"sweeps\[0\]\.light: found 'L8'"),
    (["sweeps", 0, "kind"], "stick", r"sweeps\[0\]\.kind: found 'stick', expected 'slab' or 'shadow'"),
    (["sweeps", 0, "direction"], "z", r"sweeps\[0\]\.direction: found 'z', expected 'x' or 'y'"),
    (["sweeps", 0, "video"], "v.mkv", r"sweeps\[0\]: has both frames and video"),
    (["sweeps", 0, "frames"], ..., r"sweeps\[0\]: has neither frames and video"),
    (["sweeps", 0, "frames"], "sweep/L1/0000.exr", r"sweeps\[0\]\.frames: .*a file name with one number in it"),
    (["sweeps", 0, "frames"], "{}/{}.exr", r"frames: .*one number"),
    (["sweeps", 0, "frames"], "{0.__class__}.exr", r"frames: .*one number"),
    (["sweeps", 0, "frames"], "{!r}.exr", r"frames: .*one number"),
    (["sweeps", 0, "frames"], "{:9999999999d}.exr", r"frames: .*one number"),
    (["sweeps", 0, "frames"], "{.exr", r"frames: .*one number"),
    (["sweeps", 0, "frames"], "../{:04d}.exr", r"frames: .*leads out of the folder"),
    (["sweeps", 0, "frames"], "sweep/L1/{:03d}.exr", r"000\.exr: no such file.*sweeps\[0\], frame 0"),
    (["sweeps", 0, "dark"], "none.exr", r"none\.exr: no such file.*sweeps\[0\], dark"),
    (["sweeps", 0, "sha256"], "0" * 64, r"sweeps\[0\]\.sha256: .*a list of them for frames"),
    (["checksums"], {"mask.png": 1}, r"checksums\.mask\.png: .*64 hexadecimal"),
]


@pytest.mark.parametrize(("path", "value", "message"), WRONG)
def test_every_wrong_entry_is_named(tiny, path, value, message):
    tiny.change(edit(path, value))
    with pytest.raises(CaptureError, match=message) as error:
        load_capture(tiny.folder)
    assert str(tiny.folder) in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_frame(tiny):
    (tiny.folder / "sweep/L1/0001.exr").unlink()
    with pytest.raises(
        CaptureError, match=r"0001\.exr: no such file, but capture\.json names it \(sweeps\[0\], frame 1\)"
    ):
        load_capture(tiny.folder)


def test_lost_frame_is_not_asked_for(tiny):
    (tiny.folder / "sweep/L1/0001.exr").unlink()
    tiny.change(edit(["sweeps", 0, "time_s"], [0, None, 2]))
    (sweep,) = load_capture(tiny.folder).sweeps
    assert sweep.lost == {1}
    assert sweep.time_s == (0, None, 2)


@pytest.mark.parametrize("link", ["full/L1.exr", "sweep/L1/0002.exr"])
def test_link_out_of_the_folder(tiny, link):
    (tiny.folder / link).rename(tiny.folder.parent / "outside.exr")
    (tiny.folder / link).symlink_to(tiny.folder.parent / "outside.exr")
    with pytest.raises(CaptureError, match="outside the folder"):
        load_capture(tiny.folder)


def test_repeated_light_in_the_document(tiny):
    text = (tiny.folder / "capture.json").read_text().replace('"L2": {', '"L1": {', 1)
    (tiny.folder / "capture.json").write_text(text)
    with pytest.raises(CaptureError, match="key 'L1' appears twice"):
        load_capture(tiny.folder)


@pytest.mark.parametrize("document", [[], 3, None, "x"])
def test_no_object(tiny, document):
    tiny.rewrite(document)
    with pytest.raises(CaptureError, match=r"manifest: found .* expected an object"):
        load_capture(tiny.folder)


def test_no_folder_no_capture(tmp_path):
    with pytest.raises(CaptureError, match="none: no such folder"):
        load_capture(tmp_path / "none")
    (tmp_path / "file").write_text("")
    with pytest.raises(CaptureError, match="file: a file, a folder was expected"):
        load_capture(tmp_path / "file")


def test_another_basis(tiny):
    assert load_capture(tiny.folder, basis=("L4", "L1", "L2")).names == ("L4", "L1", "L2", "L3")
    with pytest.raises(CaptureError, match="basis"):
        load_capture(tiny.folder, basis=("L4", "L1"))


def test_lights_from_another_list(tiny):
    (tiny.folder / "other.lp").write_text("1\nL1.exr 0 3 4\n")
    capture = load_capture(tiny.folder, lights_file=tiny.folder / "other.lp")
    assert capture.lights["L1"].direction == pytest.approx((0, 0.6, 0.8))
    assert capture.lights["L2"].direction == pytest.approx((0.6, 0, 0.8))
    (tiny.folder / "other.lp").write_text("1\nX.exr 0 3 4\n")
    with pytest.raises(CaptureError, match="none of its lights"):
        load_capture(tiny.folder, lights_file=tiny.folder / "other.lp")


def test_written_manifest_loads_with_every_checksum(tiny):
    (tiny.folder / "r.csv").write_text("0,0\n1,1\n")
    (tiny.folder / "dark_0.16.exr").write_bytes((tiny.folder / "dark.exr").read_bytes())
    tiny.change(edit(["encoding"], {"response": "r.csv"}))
    tiny.change(edit(["sweeps", 0, "dark"], "dark_0.16.exr"))
    capture = load_capture(tiny.folder)
    written = write_manifest(tiny.folder, capture)
    assert load_capture(tiny.folder) == written
    assert written.full("L1").sha256 == sha256(tiny.folder / "full/L1.exr")
    assert set(written.checksums) == {"mask.png", "r.csv", "dark_0.16.exr"}
    named = {file: recorded for file, _, recorded in files(written)}
    everything = {str(path.relative_to(tiny.folder)) for path in tiny.folder.rglob("*") if path.is_file()}
    assert set(named) == everything - {"capture.json"}
    assert named == {file: sha256(tiny.folder / file) for file in named}
    plain = replace(written, images=capture.images, sweeps=capture.sweeps, checksums={})
    assert plain == capture


@pytest.mark.parametrize("file", ["full/L1.exr", "dark.exr", "mask.png", "sweep/L1/0002.exr"])
def test_verify_names_what_changed(tiny, file):
    written = write_manifest(tiny.folder, load_capture(tiny.folder))
    assert verify(written) == []
    with open(tiny.folder / file, "ab") as stream:
        stream.write(b"x")
    (problem,) = verify(written)
    assert problem.startswith(f"{tiny.folder / file}: its SHA-256 is")
    (tiny.folder / file).unlink()
    assert verify(written) == [f"{tiny.folder / file}: no such file"]


def test_verify_without_checksums(tiny):
    assert verify(load_capture(tiny.folder)) == []


def test_manifest_of_missing_files_is_not_written(tiny):
    capture = load_capture(tiny.folder)
    before = (tiny.folder / "capture.json").read_text()
    (tiny.folder / "sweep/L1/0001.exr").unlink()
    with pytest.raises(CaptureError, match=r"0001\.exr: no such file"):
        write_manifest(tiny.folder, capture)
    assert (tiny.folder / "capture.json").read_text() == before


def test_lost_frames_survive_writing(tiny):
    capture = load_capture(tiny.folder)
    (tiny.folder / "sweep/L1/0001.exr").unlink()
    sweep = replace(capture.sweeps[0], lost=frozenset({1}), time_s=None)
    written = write_manifest(tiny.folder, replace(capture, sweeps=(sweep,)))
    assert written.sweeps[0].lost == {1}
    assert json.loads((tiny.folder / "capture.json").read_text())["sweeps"][0]["sha256"][1] is None
    with pytest.raises(CaptureError, match=r"lost frames \[1\] must be null"):
        write_manifest(tiny.folder, replace(capture, sweeps=(replace(sweep, time_s=(0, 1, 2)),)))


def test_a_capture_that_cannot_be_loaded_is_not_written(tiny):
    capture = load_capture(tiny.folder)
    with pytest.raises(CaptureError, match="basis"):
        write_manifest(tiny.folder, replace(capture, basis=("L1", "L1", "L2")))


texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=5)
exposures = st.none() | st.floats(1e-6, 100)
directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: sum(x * x for x in v) > 1e-3)


@st.composite
def captures(draw):
    names = draw(st.lists(texts, min_size=3, max_size=6, unique=True))
    intensity = st.tuples(st.floats(0.1, 9)) | st.tuples(*[st.floats(0.1, 9)] * 3)
    lights = {name: Light(name=name, intensity=draw(intensity)) for name in names}
    images = [
        Picture(kind="full", light=name, file=f"{index}.exr", exposure_s=draw(exposures))
        for index, name in enumerate(names)
    ]
    count = draw(st.integers(1, 5))
    lost = draw(st.frozensets(st.integers(0, count - 1)))
    times = tuple(None if index in lost else draw(st.floats(-1e9, 1e9)) for index in range(count))
    sweeps = [
        Sweep(light=names[0], kind="shadow", frames="a{:d}.png", count=count, lost=lost, time_s=times),
        Sweep(
            light=names[1], direction="y", video="v.mkv", count=count, video_start=draw(st.integers(0, 9)), fps=29.97
        ),
    ]
    kinds = [Encoding(), Encoding(kind="gamma", gamma=2.2), Encoding(kind="response", response="r.csv")]
    return Capture(
        folder=manifest.Path("/capture"),
        object=draw(texts),
        created=draw(st.none() | texts),
        encoding=draw(st.sampled_from(kinds)),
        size=draw(st.none() | st.tuples(st.integers(1, 9), st.integers(1, 9))),
        lights=lights,
        basis=tuple(draw(st.permutations(names))[:3]),
        images=(*images, Picture(kind="dark", file="d.exr", exposure_s=draw(exposures))),
        sweeps=tuple(sweeps),
        checksums=draw(st.sampled_from([{}, {"r.csv": "a" * 64}])),
    )


@given(capture=captures())
def test_document_round_trip(capture):
    document = json.loads(json.dumps(manifest.serialise(capture)))
    assert manifest.parse(document, capture.folder / "capture.json") == capture


@given(vector=directions)
def test_directions_come_out_at_length_one(vector):
    lights = {name: {"direction": list(vector)} for name in "abc"}
    images = [{"kind": "full", "light": name, "file": f"{name}.exr"} for name in "abc"]
    document = {"format": "reflectsep-capture/1", "lights": lights, "basis": ["a", "b", "c"], "images": images}
    direction = manifest.parse(document, manifest.Path("/x/capture.json")).lights["a"].direction
    length = sum(x * x for x in vector) ** 0.5
    assert direction == pytest.approx([x / length for x in vector])
