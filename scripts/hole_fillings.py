"""How right the scattering is with each hole filling, before the joint fit, on captures with truth beside them.

`python scripts/hole_fillings.py [captures=FOLDER,FOLDER] [size=96]`

Prints, for every filling, the relative RMS error over the object of the basis lights' scattering against light that
left more than 1 and more than 2 pixels from where it entered; `profile` is told so by its `distance_px`. Where no
captures are given, simulated ones of a wax and of a pudding are made.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import torch

from reflectsep.calibrate.stack import calibrate_stack, without
from reflectsep.config import CalibrationSettings, FitSettings, ObjectSettings, ScatterSettings, SimulateJob
from reflectsep.io.capture import load_capture
from reflectsep.io.exr import read_channels
from reflectsep.jobs import run_simulate
from reflectsep.pipeline import alignment_of, measure
from reflectsep.progress import silent
from reflectsep.scatter.options import HoleFilling

BEYOND_PX = (1, 2)


def errors(folder: Path) -> dict[str, list[float]]:
    """Of every filling, the error beyond each distance, as a share of the true scattering."""
    capture = without(load_capture(folder), ())
    calibration = CalibrationSettings()
    alignment = alignment_of(capture, calibration, ScatterSettings())
    stack, _ = calibrate_stack(capture, alignment=alignment)
    found: dict[str, list[float]] = {}
    for filling in get_args(HoleFilling):
        for distance_px in BEYOND_PX:
            settings = ScatterSettings(hole_filling=filling, distance_px=float(distance_px))
            scattering = measure(capture, stack, FitSettings(), settings, silent, alignment)
            if scattering is None:
                raise SystemExit(f"{folder}: no sweeps")
            found.setdefault(filling, []).append(
                sum(
                    _error(folder, name, distance_px, scattering.root[i] ** float(scattering.n_d), stack.mask)
                    for i, name in enumerate(capture.basis)
                )
                / len(capture.basis)
            )
    return found


def _error(folder: Path, name: str, distance_px: int, measured: torch.Tensor, mask: torch.Tensor) -> float:
    planes = read_channels(folder / "truth" / f"{name}.exr")
    layer = f"scattering_beyond_{distance_px}px."
    truth = torch.stack([torch.as_tensor(planes[key]) for key in sorted(planes, reverse=True) if key.startswith(layer)])
    difference = (measured - truth)[:, mask].double()
    return float(difference.norm() / truth[:, mask].double().norm())


def main(arguments: Sequence[str]) -> None:
    """Print a table."""
    given = dict(argument.split("=", 1) for argument in arguments)
    with tempfile.TemporaryDirectory() as temporary:
        folders = [Path(folder) for folder in given["captures"].split(",")] if "captures" in given else []
        for name in () if folders else ("wax", "pudding"):
            item = ObjectSettings(name=name, preset=name, size_px=int(given.get("size", "96")))
            folders.append(Path(temporary) / name)
            run_simulate(SimulateJob(object=item, out=str(folders[-1])))
        columns = {folder.name: errors(folder) for folder in folders}
    print("".join(f"{name:>24s}" for name in ("", *columns)))
    print(" " * 24 + "".join(f"{f'{distance} px':>12s}" for _ in columns for distance in BEYOND_PX))
    for filling in get_args(HoleFilling):
        row = "".join(f"{100 * error:10.1f} %" for found in columns.values() for error in found[filling])
        print(f"{filling:24s}{row}")


if __name__ == "__main__":
    main(sys.argv[1:])
