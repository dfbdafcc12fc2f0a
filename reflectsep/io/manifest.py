"""`capture.json`, both ways: a JSON document to a `Capture`, and back.

Every check that needs the document alone is here; whether the files exist is asked in reflectsep/io/capture.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from reflectsep.data import Capture, Encoding, Light, Picture, Sweep
from reflectsep.errors import CaptureError
from reflectsep.io import node as read
from reflectsep.io.node import Node

FORMAT = "reflectsep-capture/1"

KEYS = {
    "capture": (
        *("format", "object", "created", "view", "encoding", "size", "mask"),
        *("lights", "basis", "images", "sweeps", "checksums"),
    ),
    "light": ("direction", "intensity"),
    "image": ("kind", "light", "file", "exposure_s", "sha256"),
    "sweep": (
        *("light", "kind", "direction", "exposure_s", "frames", "video", "start", "fps"),
        *("count", "position_mm", "time_s", "dark", "sha256"),
    ),
    "encoding": ("gamma", "response"),
}
"""Keys that an object of each kind may have."""

SAME_PLACE = 0.05
"""Of a step, within which the frames of two exposures show the slab at the same place."""
PER_FRAME = ("position_mm", "time_s", "sha256")

T = TypeVar("T")


def parse(document: Any, path: Path) -> Capture:
    """A capture from the JSON document of its manifest.

    Args:
        document: what the JSON says.
        path: the manifest; its folder is the capture's.

    Returns:
        The capture, light directions and view of length 1. No file but the manifest has been looked at.

    Raises:
        CaptureError: anything that the format does not allow, by the place where it stands.
    """
    root = Node(path, "manifest", document)
    if isinstance(document, dict) and document.get("format") != FORMAT:
        raise CaptureError(f"{path}: format is {document.get('format')!r}, expected {FORMAT!r}")
    root.object(KEYS["capture"], ("format", "lights", "basis", "images"))
    lights = _lights(root.child("lights"))
    images = tuple(_picture(node, lights) for node in root.child("images").items())
    sweeps = root.optional("sweeps", lambda node: _bracketed([_sweep(item, lights) for item in node.items()]), ())
    return Capture(
        folder=path.parent,
        object=root.optional("object", read.text, "object"),
        created=root.optional("created", read.text, None),
        view=root.optional("view", read.direction, (0.0, 0.0, 1.0)),
        encoding=root.optional("encoding", _encoding, Encoding()),
        size=root.optional("size", _size, None),
        mask=root.optional("mask", read.nullable(read.file), None),
        lights=lights,
        basis=_basis(root.child("basis"), lights, images),
        images=images,
        sweeps=sweeps,
        checksums=root.optional("checksums", _checksums, {}),
    )


def serialise(capture: Capture) -> dict[str, Any]:
    """The JSON document of a capture; `parse` gives the same capture back.

    Raises:
        CaptureError: a lost frame that no per-frame entry can show as null.
    """
    document: dict[str, Any] = {"format": FORMAT, "object": capture.object, "created": capture.created}
    document["view"] = list(capture.view)
    document["encoding"] = _encoding_document(capture.encoding)
    document["size"] = None if capture.size is None else list(capture.size)
    document["mask"] = capture.mask
    document = _without_none(document)
    document["lights"] = {name: _light_document(light) for name, light in capture.lights.items()}
    document["basis"] = list(capture.basis)
    document["images"] = [
        _without_none({key: getattr(picture, key) for key in KEYS["image"]}) for picture in capture.images
    ]
    document["sweeps"] = [_sweep_document(capture, one) for sweep in capture.sweeps for one in sweep.exposures]
    if capture.checksums:
        document["checksums"] = dict(capture.checksums)
    return document


def frame_file(sweep: Sweep, index: int) -> str:
    """File name of a frame, relative to the capture's folder.

    Raises:
        ValueError: the sweep is a video.
    """
    if sweep.frames is None:
        raise ValueError(f"the sweep of {sweep.light} is a video")
    return sweep.frames.format(index)


def _lights(node: Node) -> dict[str, Light]:
    if not isinstance(node.value, dict) or not node.value:
        raise node.fail("an object with an entry for every light")
    lights: dict[str, Light] = {}
    for name in node.value:
        entry = node.child(name).object(KEYS["light"], ())
        direction = entry.optional("direction", read.nullable(read.direction), None)
        lights[name] = Light(name=name, direction=direction, intensity=entry.optional("intensity", _intensity, (1.0,)))
    return lights


def _picture(node: Node, lights: Mapping[str, Light]) -> Picture:
    node.object(KEYS["image"], ("kind", "file"))
    kind = read.choice(node.child("kind"), ("full", "dark", "flat"))
    light = node.optional("light", read.nullable(read.text), None)
    if kind == "dark" and light is not None:
        raise node.child("light").fail("no light in a dark picture")
    if kind == "full" and light is None:
        raise CaptureError(f"{node.path}: {node.place}: a full picture needs its light")
    if light is not None:
        _known_light(node.child("light"), lights)
    return Picture(
        kind=kind,
        file=read.file(node.child("file")),
        light=light,
        exposure_s=node.optional("exposure_s", read.nullable(read.positive), None),
        sha256=node.optional("sha256", read.nullable(read.checksum), None),
    )


def _basis(node: Node, lights: Mapping[str, Light], images: tuple[Picture, ...]) -> tuple[str, str, str]:
    names = [_known_light(item, lights) for item in node.items()]
    if len(names) != 3 or len(set(names)) != 3:
        raise node.fail("the names of three different lights")
    full = [picture.light for picture in images if picture.kind == "full"]
    for name in dict.fromkeys(full):
        exposures = [picture.exposure_s for picture in images if picture.kind == "full" and picture.light == name]
        if len(exposures) > 1 and (None in exposures or len(set(exposures)) < len(exposures)):
            raise CaptureError(
                f"{node.path}: images: light {name!r} has {len(exposures)} full pictures, expected one, or a bracket "
                "of different exposure_s"
            )
    for name in names:
        if name not in full:
            raise CaptureError(f"{node.path}: {node.place}: basis light {name!r} has no full picture in images")
    return (names[0], names[1], names[2])


def _sweep(node: Node, lights: Mapping[str, Light]) -> Sweep:
    node.object(KEYS["sweep"], ("light", "count"))
    count = read.whole(node.child("count"), least=1)
    frames = node.optional("frames", read.nullable(read.pattern), None)
    video = node.optional("video", read.nullable(read.file), None)
    if (frames is None) == (video is None):
        raise CaptureError(
            f"{node.path}: {node.place}: has {'both' if frames else 'neither'} frames and video, expected one"
        )
    arrays = {key: _per_frame(node.child(key), count) for key in PER_FRAME if _is_list(node, key)}
    return Sweep(
        light=_known_light(node.child("light"), lights),
        kind=node.optional("kind", lambda item: read.choice(item, ("slab", "shadow")), "slab"),
        direction=node.optional("direction", lambda item: read.choice(item, ("x", "y")), "x"),
        exposure_s=node.optional("exposure_s", read.nullable(read.positive), None),
        frames=frames,
        video=video,
        video_start=node.optional("start", lambda item: read.whole(item, least=0), 0),
        fps=node.optional("fps", read.nullable(read.positive), None),
        count=count,
        lost=_lost(node, arrays, count),
        position_mm=_values(arrays, "position_mm", read.number),
        time_s=_values(arrays, "time_s", read.number),
        dark=node.optional("dark", read.nullable(read.file), None),
        sha256=_sweep_checksums(node, arrays, video),
    )


def _bracketed(sweeps: list[Sweep]) -> tuple[Sweep, ...]:
    """The sweeps, those that are exposures of one another under the first of them."""
    groups: list[list[Sweep]] = []
    for sweep in sweeps:
        group = next((group for group in groups if all(_is_bracket(other, sweep) for other in group)), None)
        if group is None:
            groups.append([sweep])
        else:
            group.append(sweep)
    return tuple(replace(group[0], bracket=tuple(group[1:])) for group in groups)


def _is_bracket(a: Sweep, b: Sweep) -> bool:
    """Whether two sweeps have the same frames at different exposures, as far as the manifest tells."""
    if (a.light, a.kind, a.direction, a.count) != (b.light, b.kind, b.direction, b.count):
        return False
    if a.exposure_s is None or b.exposure_s is None or a.exposure_s == b.exposure_s:
        return False
    if a.position_mm is None or b.position_mm is None:
        return True
    known = [(x, y) for x, y in zip(a.position_mm, b.position_mm, strict=True) if x is not None and y is not None]
    if len(known) < 2:
        return True
    step_mm = abs(known[-1][0] - known[0][0]) / (len(known) - 1)
    return max(abs(x - y) for x, y in known) <= SAME_PLACE * step_mm


def _is_list(node: Node, key: str) -> bool:
    """Whether `key` holds a per-frame array: the checksum of a video is one for the whole file."""
    value = node.value.get(key)
    return value is not None and not (key == "sha256" and isinstance(value, str))


def _per_frame(node: Node, count: int) -> list[Node]:
    items = node.items()
    if len(items) != count:
        raise CaptureError(f"{node.path}: {node.place}: {len(items)} entries, but count is {count}")
    return items


def _lost(node: Node, arrays: Mapping[str, list[Node]], count: int) -> frozenset[int]:
    """Frames that are null; all arrays must agree, for a frame is there or it is not."""
    absent = {key: {i for i in range(count) if items[i].value is None} for key, items in arrays.items()}
    lost = set().union(*absent.values())
    for key, indices in absent.items():
        if indices != lost:
            index = min(lost - indices)
            raise CaptureError(
                f"{node.path}: {node.place}.{key}[{index}]: not null, but frame {index} is null elsewhere"
            )
    return frozenset(lost)


def _values(arrays: Mapping[str, list[Node]], key: str, reader: Callable[[Node], T]) -> tuple[T | None, ...] | None:
    return tuple(None if node.value is None else reader(node) for node in arrays[key]) if key in arrays else None


def _sweep_checksums(node: Node, arrays: Mapping[str, list[Node]], video: str | None) -> tuple[str | None, ...] | None:
    value = node.value.get("sha256")
    if value is None:
        return None
    if isinstance(value, str) != (video is not None):
        raise node.child("sha256").fail("one checksum of a video, a list of them for frames")
    return (
        (read.checksum(node.child("sha256")),) if isinstance(value, str) else _values(arrays, "sha256", read.checksum)
    )


def _sweep_document(capture: Capture, sweep: Sweep) -> dict[str, Any]:
    document: dict[str, Any] = {key: getattr(sweep, "video_start" if key == "start" else key) for key in KEYS["sweep"]}
    if sweep.video is None or sweep.video_start == 0:
        document["start"] = None
    for key in PER_FRAME:
        if document[key] is not None:
            document[key] = list(document[key])
    if sweep.video is not None and sweep.sha256:
        document["sha256"] = sweep.sha256[0]
    shown = [document[key] for key in PER_FRAME if isinstance(document[key], list)]
    nulls = [{index for index, value in enumerate(array) if value is None} for array in shown]
    if any(null != sweep.lost for null in nulls) or (sweep.lost and not shown):
        raise CaptureError(
            f"{capture.folder}: sweep of {sweep.light}: lost frames {sorted(sweep.lost)} must be null in every "
            "per-frame array, and there must be one to show them"
        )
    return _without_none(document)


def _encoding_document(encoding: Encoding) -> Any:
    if encoding.kind == "linear":
        return "linear"
    return {"gamma": encoding.gamma} if encoding.kind == "gamma" else {"response": encoding.response}


def _light_document(light: Light) -> dict[str, Any]:
    document: dict[str, Any] = {} if light.direction is None else {"direction": list(light.direction)}
    document["intensity"] = light.intensity[0] if len(light.intensity) == 1 else list(light.intensity)
    return document


def _without_none(document: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in document.items() if value is not None}


def _intensity(node: Node) -> tuple[float, ...]:
    if isinstance(node.value, list):
        if len(node.value) not in (1, 3):
            raise node.fail("a number, or three (R, G, B)")
        return tuple(read.positive(item) for item in node.items())
    return (read.positive(node),)


def _size(node: Node) -> tuple[int, int] | None:
    if node.value is None:
        return None
    numbers = [read.whole(item, least=1) for item in node.items()]
    if len(numbers) != 2:
        raise node.fail("[width, height]")
    return (numbers[0], numbers[1])


def _encoding(node: Node) -> Encoding:
    if node.value == "linear":
        return Encoding()
    expected = '"linear", {"gamma": number} or {"response": "file.csv"}'
    if not isinstance(node.value, dict):
        raise node.fail(expected)
    node.object(KEYS["encoding"], ())
    if len(node.value) != 1:
        raise node.fail(expected)
    if "gamma" in node.value:
        return Encoding(kind="gamma", gamma=read.positive(node.child("gamma")))
    return Encoding(kind="response", response=read.file(node.child("response")))


def _checksums(node: Node) -> dict[str, str]:
    if not isinstance(node.value, dict):
        raise node.fail("an object of SHA-256 by file")
    for name in node.value:
        read.file(Node(node.path, node.place, name))
    return {name: read.checksum(node.child(name)) for name in node.value}


def _known_light(node: Node, lights: Mapping[str, Light]) -> str:
    if not isinstance(node.value, str) or node.value not in lights:
        raise node.fail(f"one of the lights {', '.join(lights)}")
    return node.value
