"""From words on the command line to the settings of a job, by way of Hydra; every mistake becomes one line.

What can be wrong with an override (its key, its option of a group, its type, its value) is checked here against
reflectsep.config before Hydra sees it, because Hydra's own messages take several lines and name its own syntax.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from itertools import product
from shutil import which
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from reflectsep.cli.help import config_dir, group_options, groups
from reflectsep.config import JOBS, Job
from reflectsep.errors import MissingExtraError, SettingsError
from reflectsep.settings import Kind, kinds, nearest

MISSING = "???"
"""How OmegaConf writes a value that must be given."""


@contextmanager
def hydra_ready() -> Iterator[None]:
    """Hydra with the configs of this package and the schemas of reflectsep.config."""
    store = ConfigStore.instance()
    for name, cls in JOBS.items():
        store.store(name=f"{name}_schema", node=_schema(cls))
    with initialize_config_dir(str(config_dir()), job_name="reflectsep", version_base="1.3"):
        yield


def settings_of(job: str, overrides: Sequence[str]) -> Job:
    """The settings of one run, checked.

    Args:
        job: Name in `JOBS`.
        overrides: As `checked` returns them.

    Raises:
        SettingsError: one line that names the key.
    """
    return build(job, composed(job, overrides))


def composed(job: str, overrides: Sequence[str]) -> DictConfig:
    """What Hydra makes of the overrides of one run.

    Raises:
        SettingsError: one line that names the key.
    """
    keys = tuple(f"{key}={{" for key in _open_keys(JOBS[job]))
    whole = [word for word in overrides if word.startswith(keys)]
    try:
        config = compose(f"{job}_job", [word for word in overrides if word not in whole])
        for override in _parsed(whole):
            # A backend given whole takes the place of the one in the YAML; Hydra would merge the two.
            OmegaConf.update(config, override.get_key_element(), override.value(), merge=False, force_add=True)
        return config
    except (HydraException, OmegaConfBaseException) as error:
        raise _one_line(error, JOBS[job], overrides) from None


def build(job: str, config: DictConfig) -> Job:
    """Plain settings from a composed config.

    Raises:
        SettingsError: a value is missing, impossible, or refers to a key that is not there.
    """
    try:
        values = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise _one_line(error, JOBS[job], ()) from None
    return _built(JOBS[job], values)


def expanded(overrides: Sequence[str]) -> list[list[str]]:
    """The overrides of every run of a multirun, in Hydra's order."""
    each = []
    for override in _parsed(overrides):
        if override.is_sweep_override():
            each.append([f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()])
        else:
            each.append([override.input_line or ""])
    return [list(run) for run in product(*each)]


def swept(overrides: Sequence[str]) -> frozenset[str]:
    """Keys that have several values."""
    return frozenset(o.get_key_element() for o in _parsed(overrides) if o.is_sweep_override())


def checked(job: str, words: Sequence[str], *, sweeping: bool) -> list[str]:
    """The words after the job as overrides that Hydra will take: keys and group options exist, paths are quoted.

    Args:
        job: Name in `JOBS`.
        words: `KEY=VALUE` each; for `info` one may be a bare path.
        sweeping: `KEY=A,B` means two runs.

    Raises:
        SettingsError: one line that names the word and what is known.
        MissingExtraError: a launcher that is not installed.
    """
    cls = JOBS[job]
    overrides = [_assignment(job, word) for word in words]
    overrides = [_quoted_path(cls, override, sweeping) for override in overrides]
    seen: set[str] = set()
    for override in _parsed(overrides):
        if override.key_or_group in seen:
            raise SettingsError(f"{override.input_line}: {override.key_or_group} is given twice")
        seen.add(override.key_or_group)
        _check_override(cls, override, sweeping)
    # A backend's settings differ from those of the one in the YAML: they may be new there, and the backend checks them.
    open_keys = tuple(f"{name}." for name in _open_keys(cls))
    return [f"++{word}" if word.startswith(open_keys) else word for word in overrides]


def _open_keys(cls: type) -> list[str]:
    """Settings that take any keys: the backends of devices."""
    return [name for name, kind in _keys(cls).items() if kind.base is dict]


def _schema(cls: type) -> type:
    """A twin of a settings class for OmegaConf, which knows no `Literal` and constructs what it checks."""
    fields: list[tuple[str, Any, Any]] = []
    hints = kinds(cls)
    for f in dataclasses.fields(cls):
        kind = hints[f.name]
        if dataclasses.is_dataclass(kind.base):
            inner = _schema(kind.base)
            fields.append((f.name, inner, dataclasses.field(default_factory=inner)))
            continue
        hint: Any = list[kind.item] if kind.base is list and kind.item else kind.base
        hint = dict[str, Any] if kind.base is dict else hint
        default = MISSING if f.default is dataclasses.MISSING else f.default
        fields.append((f.name, hint | None if kind.optional else hint, dataclasses.field(default=default)))
    return dataclasses.make_dataclass(cls.__name__, fields)


def _built(cls: type, values: Any) -> Any:
    arguments = {}
    for f in dataclasses.fields(cls):
        kind = kinds(cls)[f.name]
        value = values[f.name]
        if value == MISSING:
            raise SettingsError(f"no {f.name}: give {f.name}=... ({f.metadata['text']})")
        arguments[f.name] = _built(kind.base, value) if dataclasses.is_dataclass(kind.base) else value
    return cls(**arguments)


def _assignment(job: str, word: str) -> str:
    """`word` as KEY=VALUE: for `info` a bare path stands for path=PATH."""
    if job == "info" and not re.match(r"(path|hydra[./][\w./]+)=", word):
        return f"path={word}"
    if "=" not in word:
        raise SettingsError(f"{word}: expected KEY=VALUE{nearest(word, _keys(JOBS[job]))}")
    if word[0] in "+~" and not word.startswith("++"):
        raise SettingsError(f"{word}: settings are set by KEY=VALUE, none can be added or removed")
    return word


def _quoted_path(cls: type, override: str, sweeping: bool) -> str:
    """Paths may hold what means something to Hydra (`=`, `(`, a leading digit): quote them."""
    key, value = override.split("=", 1)
    is_path = any(f.name == key and f.metadata.get("path") for f in dataclasses.fields(cls))
    if not is_path or value in ("", "null", MISSING) or value[0] in "'\"":
        return override
    if sweeping and _parses(override):
        return override
    value = re.sub(r"(\\*)'", r"\1\1\\'", value)
    value = re.sub(r"(\\+)$", r"\1\1", value)
    return f"{key}='{value}'"


def _parses(override: str) -> bool:
    try:
        OverridesParser.create().parse_override(override)
    except HydraException:
        return False
    return True


def _parsed(overrides: Sequence[str]) -> list[Override]:
    parsed = []
    for override in overrides:
        try:
            parsed.append(OverridesParser.create().parse_override(override))
        except HydraException:
            raise SettingsError(
                f"{override}: cannot be read; quote a value that holds any of , = : ( ) [ ] {{ }}"
            ) from None
    return parsed


def _check_override(cls: type, override: Override, sweeping: bool) -> None:
    key = override.key_or_group
    if override.is_sweep_override() and not sweeping:
        raise SettingsError(f"{override.input_line}: several values mean several runs: add -m")
    if key == "hydra/launcher":
        _check_launcher(str(override.value()))
    if key.startswith(("hydra.", "hydra/")):
        return
    known = _keys(cls)
    if key in groups(cls):
        for option in _values(override):
            _check_option(key, option)
    elif any(kind.base is dict and key.startswith(f"{name}.") for name, kind in known.items()):
        return  # a backend's own setting: it knows its names
    elif key not in known:
        raise SettingsError(f"{key}: no such setting{nearest(key, [*known, *groups(cls)]) or _some(known)}")
    elif known[key].base is bool and not all(str(value).lower() in ("true", "false") for value in _values(override)):
        # OmegaConf would take any number, and words such as `on`, for a truth value.
        raise SettingsError(f"{override.input_line}: expected {known[key].expected}")


def launcher_of(overrides: Sequence[str]) -> str:
    """Name of the launcher that the runs of a multirun go through."""
    return next((str(o.value()) for o in _parsed(overrides) if o.key_or_group == "hydra/launcher"), "basic")


def _check_launcher(name: str) -> None:
    extra = name.split("_", maxsplit=1)[0]
    if extra not in ("joblib", "submitit"):
        return
    try:
        import_module(f"hydra_plugins.hydra_{extra}_launcher")
    except ImportError:
        raise MissingExtraError(f"hydra/launcher={name}: not installed; pip install 'reflectsep[{extra}]'") from None
    if name == "submitit_slurm" and which("srun") is None:
        raise SettingsError(f"hydra/launcher={name}: no srun here; start it on a machine that submits jobs")


def _values(override: Override) -> list[Any]:
    if override.is_sweep_override():
        return [value.strip("'\"") for value in override.sweep_string_iterator()]
    return [override.value()]


def _check_option(group: str, option: Any) -> None:
    options = list(group_options(group))
    if str(option) not in options:
        raise SettingsError(
            f"{group}={option}: no such option{nearest(str(option), options)} (one of {', '.join(options)})"
        )


def _keys(cls: type) -> dict[str, Kind]:
    """Every dotted key of a job with its kind."""
    keys = {}
    for name, kind in kinds(cls).items():
        if dataclasses.is_dataclass(kind.base):
            keys |= {f"{name}.{inner}": inner_kind for inner, inner_kind in _keys(kind.base).items()}
        else:
            keys[name] = kind
    return keys


def _some(known: dict[str, Kind]) -> str:
    return f" (known: {', '.join(known)})" if known else ""


def _one_line(error: BaseException, cls: type, overrides: Sequence[str]) -> SettingsError:
    """Hydra's or OmegaConf's error, told as ours: the key, the value and what is expected."""
    cause: BaseException | None = error
    while cause is not None and not getattr(cause, "full_key", None):
        cause = cause.__cause__
    key = str(getattr(cause, "full_key", "")).split("[")[0]
    kind = _keys(cls).get(key)
    if kind is None:
        return SettingsError(flat(error))
    given = [override for override in overrides if override.lstrip("+").startswith(f"{key}=")]
    return SettingsError(f"{given[-1]}: expected {kind.expected}" if given else f"{key}: {flat(cause)}")


def flat(error: BaseException | None) -> str:
    """Hydra's or OmegaConf's message on one line, without the places where it searched."""
    return " ".join(re.split(r"Config search path:|full_key:", str(error))[0].split())
