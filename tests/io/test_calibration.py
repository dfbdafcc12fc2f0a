"""The calibration file."""

import json

import pytest

from reflectsep.data import Capture, Encoding, Light, Picture
from reflectsep.errors import CaptureError
from reflectsep.io.calibration import Calibration, calibrated, read_calibration, write_calibration

LIGHTS = {
    "L1": Light(name="L1", direction=(0.0, 0.6, 0.8), intensity=(0.7,)),
    "L2": Light(name="L2", intensity=(1.0, 0.9, 0.8)),
}
CURVE = ((0.0, 0.0), (0.5, 0.2), (1.0, 1.0))


def test_round_trip(tmp_path):
    given = Calibration(lights=LIGHTS, response=CURVE, notes={"ball": [1, 2]})
    write_calibration(tmp_path / "c.json", given)
    assert read_calibration(tmp_path / "c.json") == given


def test_capture_takes_what_it_names_and_keeps_the_rest(tmp_path):
    capture = Capture(
        folder=tmp_path,
        lights={
            "L1": Light(name="L1", direction=(0.0, 0.0, 1.0)),
            "L2": Light(name="L2", direction=(1.0, 0.0, 0.0)),
            "L3": Light(name="L3"),
        },
        basis=("L1", "L2", "L3"),
        images=(Picture(kind="full", light="L1", file="1.exr"),),
        encoding=Encoding(kind="gamma", gamma=2.2),
    )
    found = calibrated(capture, Calibration(lights=LIGHTS, response=CURVE))
    assert found.lights["L1"].direction == (0.0, 0.6, 0.8)
    assert found.lights["L2"].direction == (1.0, 0.0, 0.0)  # the calibration knows none
    assert found.lights["L2"].intensity == (1.0, 0.9, 0.8)
    assert found.lights["L3"] == capture.lights["L3"]
    assert (found.encoding.kind, found.encoding.table) == ("response", CURVE)
    assert calibrated(capture, Calibration(lights={})).encoding == capture.encoding


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "reflectsep-capture/1"}, "format is 'reflectsep-capture/1', expected 'reflectsep-calibration/1'"),
        ({"responze": []}, "responze"),
        ({"lights": {"L1": {"direction": [0, 0]}}}, "direction"),
        ({"lights": {"L1": {"intensity": [0]}}}, "intensity"),
        ({"lights": []}, "an object with an entry for every light"),
        ({"response": [[0, 0], [0.5, 0.5], [0.4, 0.6]]}, "a row above the one before it"),
        ({"response": [[0, 0]]}, "two rows or more"),
    ],
)
def test_broken_files_say_where(tmp_path, change, message):
    document = {"format": "reflectsep-calibration/1", "lights": {}, **change}
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(CaptureError, match=rf"c\.json: .*{message}"):
        read_calibration(tmp_path / "c.json")


def test_missing_file(tmp_path):
    with pytest.raises(CaptureError, match=r"c\.json: no such file; reflectsep calibrate writes one"):
        read_calibration(tmp_path / "c.json")
