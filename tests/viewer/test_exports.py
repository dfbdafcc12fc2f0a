"""The planes of an export as a browser decodes and a viewer of the format adds them up."""

from __future__ import annotations

import base64
import json
import math

import numpy as np
import pytest

from reflectsep.config import ExportJob
from reflectsep.export.lights import cap, mixes, screen_picture
from reflectsep.jobs import run_export
from reflectsep.report.tone import white_point
from reflectsep.separation import load

from .conftest import decoded

pytestmark = [pytest.mark.slow, pytest.mark.browser]
VIEWER = """
(async () => {
  const info = INFO, weights = WEIGHTS, planes = [];
  for (const data of PLANES) {
    const image = new Image();
    image.src = "data:image/jpeg;base64," + data;
    await image.decode();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
    const pen = canvas.getContext("2d", { willReadFrequently: true });
    pen.drawImage(image, 0, 0);
    planes.push(pen.getImageData(0, 0, canvas.width, canvas.height).data);
  }
  const { scale, bias } = info.materials[0], out = [];
  for (const w of weights) {
    const picture = new ImageData(info.width, info.height);
    for (let i = 0; i < picture.data.length; i++) {
      if (i % 4 === 3) { picture.data[i] = 255; continue; }
      let sum = 0;
      planes.forEach((plane, k) => { sum += w[k] * (plane[i] / 255 - bias[3 * k + i % 4]) * scale[3 * k + i % 4]; });
      picture.data[i] = 255 * sum;  // clamped and rounded by the array
    }
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [info.width, info.height];
    canvas.getContext("2d").putImageData(picture, 0, 0);
    out.push(canvas.toDataURL());
  }
  return out;
})()
"""


def weights_of(kind, x, y, z):
    """What a viewer of the format multiplies the planes by (Malzbender et al., 2001; Gautron et al., 2004)."""
    if kind == "ptm":
        return [1, x, y, x * x, x * y, y * y]
    phi, g = math.atan2(y, x), math.sqrt(max(0.0, z - z * z))
    a, b = math.sqrt(6 / math.pi), math.sqrt(30 / math.pi)
    return [
        1 / math.sqrt(2 * math.pi),
        a * math.cos(phi) * g,
        math.sqrt(3 / (2 * math.pi)) * (2 * z - 1),
        a * math.sin(phi) * g,
        b * math.cos(2 * phi) * (z * z - z),
        b * math.cos(phi) * (2 * z - 1) * g,
        math.sqrt(5 / (2 * math.pi)) * (1 - 6 * z + 6 * z * z),
        b * math.sin(phi) * (2 * z - 1) * g,
        b * math.sin(2 * phi) * (z * z - z),
    ]


@pytest.mark.parametrize(("kind", "channels"), [("ptm", 3), ("hsh", 3), ("hsh", 1)])
def test_a_browser_sees_what_the_export_says(page, result, tmp_path, kind, channels):
    result(size=64, channels=channels, n_d=1.0, ggx=False).save(tmp_path / "result")
    out = tmp_path / "out"
    run_export(ExportJob(result=str(tmp_path / "result"), format=f"relight_{kind}", out=str(out), tilt_deg=40.0))
    separation = load(tmp_path / "result")
    info = json.loads((out / "info.json").read_text())
    assert info["type"] == kind
    planes = [
        base64.b64encode((out / f"plane_{k}.jpg").read_bytes()).decode() for k in range(math.ceil(info["nplanes"] / 3))
    ]
    directions = cap(16, 40.0)
    weights = [weights_of(kind, *direction.tolist()) for direction in directions]
    script = VIEWER
    for name, value in (("INFO", info), ("WEIGHTS", weights), ("PLANES", planes)):
        script = script.replace(name, json.dumps(value), 1)
    page.call("Page.navigate", url="about:blank")
    seen = page.run(script)
    white = white_point(separation.highlight_free + separation.specular, separation.mask)
    errors, mask = [], separation.mask.numpy()
    for picture, alpha in zip(seen, mixes(separation, directions), strict=True):
        expected = screen_picture(separation, alpha, white).numpy().transpose(1, 2, 0)
        errors.append(np.mean((decoded(picture.split(",", 1)[1]) / 255 - expected)[mask] ** 2))
    found = -10 * math.log10(np.mean(errors))
    said = json.loads((out / "relit.json").read_text())["distance_db"]["all_db"]
    print(f"{kind}, {channels} channels: {found:.2f} dB in the browser, {said:.2f} dB by the export")
    assert found == pytest.approx(said, abs=0.1)
