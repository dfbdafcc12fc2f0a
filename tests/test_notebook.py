"""What a notebook shows of a result, a capture and a sweep."""

import dataclasses
import subprocess
import sys

import pytest

from reflectsep.config import ObjectSettings, RigSettings, SimulateJob
from reflectsep.io.capture import load_capture
from reflectsep.io.frames import open_sweep
from reflectsep.jobs import run_simulate

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    out = tmp_path_factory.mktemp("notebook") / "capture"
    rig = RigSettings(slab_width_px=8.0, slab_step_px=4.0)
    run_simulate(SimulateJob(object=ObjectSettings(name="wax", size_px=16), rig=rig, out=str(out)))
    return load_capture(out)


def test_a_result_shows_its_components_and_escapes_its_words(result):
    separation = result(size=16)
    named = dataclasses.replace(separation, document={**separation.document, "object": "<b>x</b>"})
    text = named._repr_html_()
    assert text.count("data:image/png;base64,") == 4
    assert "&lt;b&gt;x&lt;/b&gt;" in text
    assert "a warning" in text
    assert separation.plot()._repr_png_().startswith(PNG)


def test_a_capture_and_its_sweeps_show_themselves(capture):
    text = capture._repr_html_()
    for name in capture.names:
        assert f"light {name}" in text
    assert text.count("slab along x") == 3
    assert "slab along x" in capture.sweeps[0]._repr_html_()
    assert capture.plot()._repr_png_().startswith(PNG)
    stream = open_sweep(capture, capture.sweeps[0])
    assert stream._repr_html_() == capture.sweeps[0]._repr_html_()
    assert stream.plot(frames=2)._repr_png_().startswith(PNG)


def test_a_display_without_a_plot_imports_no_matplotlib(capture):
    program = (
        "import sys; from reflectsep.io.capture import load_capture; import reflectsep.separation;"
        f"load_capture({str(capture.folder)!r})._repr_html_();"
        "print([name for name in sys.modules if name.startswith('matplotlib')])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
