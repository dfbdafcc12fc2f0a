"""How right the scattering is before the joint fit, and whether its error runs in stripes along the slab.

`python scripts/scattering_spectrum.py CAPTURE ... [maps=FOLDER] [registration=none] [scatter.SETTING=VALUE ...]`

Prints for every capture with truth beside it, over its basis lights:

    rms       error of the scattering against light that left more than 1 pixel from where it entered, relative to the
              RMS of that light; relative to the RMS of the picture where the truth is nothing
    scale     what the measured scattering is to be multiplied with for the least error
    sd        RMS of error over its standard deviation: 1 where that is honest
    stripes   power of the error's spectrum along the sweep's axis over that along the slab, at 2 to 8 pixels a period:
              1 without stripes
    truth     the same ratio of the true scattering
    seconds   of processor time that the stage took

over the pixels whose mean picture is above 8 per cent of the brightest. A wave counts along an axis where it lies
within 30 degrees of it. `maps` writes the scattering, its truth and its error (eight times enlarged about grey) of
every basis light as PNG, side by side.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from reflectsep.calibrate.stack import calibrate_stack, without
from reflectsep.config import CalibrationSettings, FitSettings, ScatterSettings
from reflectsep.data import PhotometricStack, Scattering
from reflectsep.io.capture import load_capture
from reflectsep.io.exr import read_channels
from reflectsep.io.pictures import write_picture
from reflectsep.pipeline import alignment_of, measure
from reflectsep.progress import silent
from reflectsep.scatter.frames import signed_root

PERIODS_PX = (2.0, 8.0)
LEAST_COSINE = 0.866
BRIGHT = 0.08


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A capture's scattering with its truth, basis lights only."""

    scattering: Tensor
    truth: Tensor
    sd: Tensor
    inner: Tensor
    pictures: Tensor
    axes: list[str]
    seconds: float


def measured(folder: Path, settings: ScatterSettings, registration: str) -> Measured:
    """The stage as a fit runs it, and what it should have found."""
    capture = without(load_capture(folder), ())
    calibration = CalibrationSettings(registration=registration)  # pyright: ignore[reportArgumentType]
    alignment = None if registration == "none" else alignment_of(capture, calibration, settings)
    stack, _ = calibrate_stack(capture, alignment=alignment)
    begin = time.process_time()
    found = measure(capture, stack, FitSettings(), settings, silent, alignment)
    seconds = time.process_time() - begin
    if found is None:
        raise SystemExit(f"{folder}: no sweeps")
    return _with_truth(folder, stack, found, seconds)


def _with_truth(folder: Path, stack: PhotometricStack, found: Scattering, seconds: float) -> Measured:
    names = stack.names[:3]
    pictures = stack.images[: len(names)]
    mean = stack.images.mean((0, 1))
    bright = BRIGHT * float(stack.images.flatten()[:: max(1, stack.images.numel() >> 23)].quantile(0.999))
    deviation = found.root_sd if found.root_sd is not None else torch.full_like(found.root, torch.nan)
    n = float(found.n_d)
    return Measured(
        scattering=signed_root(found.root[:3], 1.0 / n),
        truth=torch.stack([truth_of(folder, name) for name in names]),
        sd=n * found.root[:3].abs().clamp(min=1e-9) ** (n - 1) * deviation[:3],
        inner=stack.mask & (mean > bright),
        pictures=pictures,
        axes=[next(s.direction for s in found.sweeps if s.light == name) for name in names],
        seconds=seconds,
    )


def truth_of(folder: Path, light: str) -> Tensor:
    """Light that left more than a pixel from where it entered, (channels, height, width)."""
    planes = read_channels(folder / "truth" / f"{light}.exr")
    layer = "scattering_beyond_1px."
    return torch.stack([torch.as_tensor(planes[key]) for key in sorted(planes, reverse=True) if key.startswith(layer)])


def stripes(error: Tensor, inner: Tensor, axis: str) -> float:
    """Power of waves along the sweep's axis over that of waves along the slab.

    What is slow is taken off first, so that it does not leak from the border of the object.
    """
    height, width = inner.shape
    weight = _window(inner)
    power = torch.fft.fft2(_without_slow(error, inner) * weight).abs().square().mean(0)
    v, u = torch.meshgrid(torch.fft.fftfreq(height), torch.fft.fftfreq(width), indexing="ij")
    rate = (u.square() + v.square()).sqrt()
    band = (rate >= 1 / PERIODS_PX[1]) & (rate <= 1 / PERIODS_PX[0])
    across, along = (u, v) if axis == "x" else (v, u)
    ratio = power[band & (across.abs() >= LEAST_COSINE * rate)].mean()
    return float(ratio / power[band & (along.abs() >= LEAST_COSINE * rate)].mean())


def _window(inner: Tensor) -> Tensor:
    """One well inside the object, falling smoothly to nothing at its border."""
    return _blurred(_eroded(inner, 4).float(), 2.0)


def _eroded(inner: Tensor, by: int) -> Tensor:
    outside = (~inner)[None, None].float()
    return torch.nn.functional.max_pool2d(outside, 2 * by + 1, stride=1, padding=by)[0, 0] == 0


def _without_slow(error: Tensor, inner: Tensor) -> Tensor:
    weight = inner.float()
    slow = torch.stack([_blurred(e * weight, 3.0) for e in error]) / _blurred(weight, 3.0).clamp(min=1e-6)
    return (error - slow) * weight


def _blurred(picture: Tensor, sigma: float) -> Tensor:
    reach = round(3 * sigma)
    bell = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / sigma) ** 2)
    bell = (bell / bell.sum()).to(picture)
    rows = torch.nn.functional.conv2d(picture[None, None], bell[None, None, None], padding=(0, reach))
    return torch.nn.functional.conv2d(rows, bell[None, None, :, None], padding=(reach, 0))[0, 0]


def figures(m: Measured) -> dict[str, float]:
    """The columns of the table, means over the lights."""
    rows = []
    for k, axis in enumerate(m.axes):
        truth, own = m.truth[k][:, m.inner].double(), m.scattering[k][:, m.inner].double()
        error = m.scattering[k] - m.truth[k]
        size = float(truth.norm()) or float(m.pictures[k][:, m.inner].double().norm())
        deviation = m.sd[k][:, m.inner].double().clamp(min=1e-12)
        rows.append(
            {
                "rms": float((own - truth).norm()) / size,
                "scale": float((own * truth).sum() / own.square().sum()),
                "sd": float(((own - truth) / deviation).square().mean().sqrt()),
                "stripes": stripes(error, m.inner, axis),
                "truth": stripes(m.truth[k], m.inner, axis),
            }
        )
    return {key: sum(row[key] for row in rows) / len(rows) for key in rows[0]} | {"seconds": m.seconds}


def write_maps(m: Measured, path: Path) -> None:
    """Scattering, truth and error of every basis light, a row a light."""
    rows = []
    for k in range(len(m.axes)):
        bright = m.truth[k].max() if float(m.truth[k].max()) > 0 else m.pictures[k].max()
        error = (0.5 + 8.0 * (m.scattering[k] - m.truth[k]) / bright) * m.inner
        rows.append(torch.cat([m.scattering[k] / bright, m.truth[k] / bright, error], -1))
    write_picture(path, torch.cat(rows, -2).clamp(0.0, 1.0), bits=8)


def main(arguments: Sequence[str]) -> None:
    """Print a table."""
    given = dict(argument.split("=", 1) for argument in arguments if "=" in argument)
    folders = [Path(argument) for argument in arguments if "=" not in argument]
    if not folders:
        raise SystemExit(__doc__)
    changed = {key.removeprefix("scatter."): value for key, value in given.items() if key.startswith("scatter.")}
    settings = ScatterSettings(**{k: float(v) if v.replace(".", "").isdigit() else v for k, v in changed.items()})  # pyright: ignore
    header = False
    for folder in folders:
        result = measured(folder, settings, given.get("registration", "none"))
        row = figures(result)
        if not header:
            print(f"{'':24s}" + "".join(f"{key:>9s}" for key in row))
            header = True
        print(f"{folder.name:24s}" + "".join(f"{value:9.4f}" for value in row.values()), flush=True)
        if "maps" in given:
            Path(given["maps"]).mkdir(parents=True, exist_ok=True)
            write_maps(result, Path(given["maps"]) / f"{folder.name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
