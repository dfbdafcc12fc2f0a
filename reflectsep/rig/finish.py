"""From a session whose steps are all done to a capture: the mask, and `capture.json` last."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from reflectsep.data import Capture, Encoding, Picture, Sweep
from reflectsep.errors import SessionError
from reflectsep.io.capture import write_manifest
from reflectsep.io.pictures import read_picture, write_picture
from reflectsep.rig.plan import Plan, SlabSweep, Still
from reflectsep.rig.session import Session, unwritable

OBJECT_SHARE = 0.02
"""Of the brightest 0.1 %: what any light raises above this over the dark picture is the object."""


def finish(session: Session, plan: Plan) -> Capture:
    """Write the capture of a session.

    Raises:
        SessionError: a step is not done, there is no object to be seen, or the folder cannot be written.
    """
    try:
        return _finish(session, plan)
    except OSError as error:
        raise unwritable(session.folder, error) from error


def _finish(session: Session, plan: Plan) -> Capture:
    records: dict[str, Mapping[str, Any]] = {}
    for shot in plan.shots:
        record = session.step(shot.name)
        if record is None:
            raise SessionError(f"{session.folder}: step {shot.name} is not done; resume=true takes it")
        records[shot.name] = record
    images = tuple(_picture(still, records[still.name]) for still in plan.stills)
    mask = None
    if plan.mask == "auto":
        write_picture(session.folder / "mask.png", object_mask(session, images)[None].to(torch.float32))
        mask = "mask.png"
    darks = {still.exposure: _file(records[still.name]) for still in plan.stills if still.kind == "dark"}
    width, height = next(iter(records.values()))["size"]
    capture = Capture(
        folder=session.folder,
        object=plan.object,
        created=session.recall("created"),
        encoding=Encoding() if plan.encoding == "linear" else Encoding(kind="gamma", gamma=float(plan.encoding)),
        size=(width, height),
        mask=mask,
        lights=plan.lights,
        basis=plan.basis,
        images=images,
        sweeps=tuple(_sweep(shot, records[shot.name], darks.get("slab")) for shot in plan.sweeps),
    )
    written = write_manifest(session.folder, capture)
    session.remember("finished", True)
    session.event("finished")
    return written


def object_mask(session: Session, images: tuple[Picture, ...]) -> Bool[Tensor, "height width"]:
    """Where any light makes a difference.

    Raises:
        SessionError: nowhere.
    """
    dark = next((read_picture(session.folder / p.file)[0] for p in images if p.kind == "dark"), None)
    brightest: Tensor | None = None
    for picture in images:
        if picture.kind == "full":
            values = read_picture(session.folder / picture.file)[0]
            brightest = values if brightest is None else torch.maximum(brightest, values)
    if brightest is None:
        raise SessionError(f"{session.folder}: no full pictures")
    light = (brightest - (0 if dark is None else dark)).amax(0)
    limit = OBJECT_SHARE * float(torch.quantile(light.flatten()[:: max(1, light.numel() // 1_000_000)], 0.999))
    mask = light > max(limit, 0.0)
    if not bool(mask.any()):
        raise SessionError(f"{session.folder}: no light makes any difference to the full pictures: are they on?")
    return mask


def _picture(still: Still, record: Mapping[str, Any]) -> Picture:
    return Picture(kind=still.kind, light=still.light, file=_file(record), exposure_s=record["exposure_s"])


def _file(record: Mapping[str, Any]) -> str:
    (file,) = record["files"]
    return file


def _sweep(shot: SlabSweep, record: Mapping[str, Any], dark: str | None) -> Sweep:
    return Sweep(
        light=shot.light,
        kind="slab",
        direction=shot.axis,
        exposure_s=record["exposure_s"],
        frames=record["frames"],
        count=record["count"],
        lost=frozenset(record["lost"]),
        position_mm=tuple(record["position_mm"]),
        time_s=tuple(record["time_s"]),
        dark=dark,
    )
