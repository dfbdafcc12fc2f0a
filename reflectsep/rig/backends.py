"""The devices that can be named in a configuration, and how one is built from it.

`_target_` is a name of the lists below, or of an entry point in the group `reflectsep.rig` that the user installed
(named KIND.NAME, e.g. `camera.mine`): never a path to any object that Python could import.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal

from reflectsep.errors import SettingsError
from reflectsep.rig.clock import Clock
from reflectsep.rig.devices import Devices
from reflectsep.settings import nearest

Kind = Literal["stage", "camera", "lights"]
ENTRY_POINTS = "reflectsep.rig"
INJECTED = ("clock", "bench", "scratch", "opener", "ask")
"""Arguments that come from the session, not from the configuration."""

BACKENDS: dict[Kind, dict[str, str]] = {
    "stage": {
        "grbl": "reflectsep.rig.grbl:GrblStage",
        "marlin": "reflectsep.rig.marlin:MarlinStage",
        "simulated": "reflectsep.rig.simulated:simulated_stage",
    },
    "camera": {
        "aravis": "reflectsep.rig.camera_aravis:AravisCamera",
        "command": "reflectsep.rig.camera_command:CommandCamera",
        "folder": "reflectsep.rig.camera_folder:FolderCamera",
        "gphoto2": "reflectsep.rig.camera_gphoto2:Gphoto2Camera",
        "simulated": "reflectsep.rig.simulated:SimulatedCamera",
        "video": "reflectsep.rig.camera_video:VideoCamera",
    },
    "lights": {
        "command": "reflectsep.rig.lights:CommandLights",
        "manual": "reflectsep.rig.lights:ManualLights",
        "serial": "reflectsep.rig.lights:SerialLights",
        "simulated": "reflectsep.rig.simulated:SimulatedLights",
    },
}


def build_devices(
    config: Mapping[Kind, Mapping[str, Any]], *, clock: Clock, bench: Any = None, scratch: Path | None = None
) -> Devices:
    """The three devices of a rig; nothing is connected.

    Args:
        config: By kind: `_target_` and the arguments of the backend.
        clock: Of the session.
        bench: Of simulated devices.
        scratch: Folder in which a camera may keep files until they are taken over; None: the system's.

    Raises:
        SettingsError: a backend that is not known, or arguments that it does not take.
    """
    built = {kind: build(kind, config.get(kind) or {}, clock=clock, bench=bench, scratch=scratch) for kind in BACKENDS}
    names = {kind: str((config.get(kind) or {}).get("_target_")) for kind in BACKENDS}
    return Devices(stage=built["stage"], camera=built["camera"], lights=built["lights"], names=names)


def build(kind: Kind, config: Mapping[str, Any], **session: Any) -> Any:
    """One device.

    Args:
        kind: Which list to look in.
        config: `_target_` and the backend's arguments.
        **session: What the session gives: `clock`, `bench`, `scratch`.

    Raises:
        SettingsError: as `build_devices`.
    """
    where = f"rig.devices.{kind}"
    given = dict(config)
    name = given.pop("_target_", None)
    make = _backend(kind, name, where)
    parameters = inspect.signature(make).parameters
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    if open_ended:  # simulated_stage hands on to the driver
        parameters = {**inspect.signature(_backend(kind, "grbl", where)).parameters, **parameters}
    # What it hands on has a name, which is no setting, and its port is the bench.
    known = [key for key in parameters if key not in (*INJECTED, *(("settings", "port") if open_ended else ()))]
    for key in given:
        if key not in known:
            raise SettingsError(f"{where}.{key}: no such setting of {name}{nearest(key, known)} ({', '.join(known)})")
    missing = [key for key in known if parameters[key].default is inspect.Parameter.empty and key not in given]
    if missing:
        raise SettingsError(f"{where}.{missing[0]}: {name} needs it")
    for key, value in given.items():
        _check_type(f"{where}.{key}", value, str(parameters[key].annotation))
    if "bench" in parameters and session.get("bench") is None:
        raise SettingsError(f"{where}: {name} needs a simulated bench")
    own = {key: value for key, value in session.items() if key in parameters and not (open_ended and key == "clock")}
    try:
        return make(**given, **own)
    except (TypeError, ValueError) as error:
        raise SettingsError(f"{where}: {name}: {error}") from error


PLAIN: dict[str, tuple[tuple[type, ...], str]] = {
    "str": ((str,), "text (YAML reads on, off, yes and no as truth values: quote them)"),
    "float": ((int, float), "a number"),
    "int": ((int,), "a whole number"),
    "bool": ((bool,), "true or false"),
}


def _check_type(where: str, value: Any, annotation: str) -> None:
    """A plain value against the annotation of its argument; others are the backend's to check."""
    first, _, rest = annotation.partition(" | ")
    if first not in PLAIN or (value is None and rest == "None"):
        return
    types, words = PLAIN[first]
    if not isinstance(value, types) or (isinstance(value, bool) and first != "bool"):
        raise SettingsError(f"{where}={value!r}: expected {words}")


def _backend(kind: Kind, name: Any, where: str) -> Any:
    known = BACKENDS[kind]
    if isinstance(name, str) and name in known:
        module, attribute = known[name].split(":")
        return getattr(import_module(module), attribute)
    installed = {point.name: point for point in entry_points(group=ENTRY_POINTS)}
    point = installed.get(f"{kind}.{name}")
    if point is not None:
        return _loaded(point, where)
    theirs = [key.removeprefix(f"{kind}.") for key in sorted(installed) if key.startswith(f"{kind}.")]
    names = list(dict.fromkeys([*known, *theirs]))
    raise SettingsError(
        f"{where}._target_={name}: no such backend{nearest(str(name), names)} (one of {', '.join(names)})"
    )


def _loaded(point: EntryPoint, where: str) -> Any:
    """The backend of an entry point; a package that is broken says so in one line."""
    try:
        return point.load()
    except Exception as error:  # whatever another package does when it is imported
        package = point.dist.name if point.dist is not None else point.value
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SettingsError(f"{where}: {point.value} of {package} cannot be imported: {reason}") from error
