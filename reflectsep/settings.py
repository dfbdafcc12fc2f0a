"""What a settings dataclass is made of: fields with help and bounds, and the check that holds them to these."""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from reflectsep.errors import SettingsError


def setting(default: Any, text: str, **bounds: Any) -> Any:
    """A field with its help text and bounds: `above`, `at_least`, `at_most`, `length` (of a list), `path` (a file)."""
    return field(default=default, metadata={"text": text, **bounds})


def required(text: str, **bounds: Any) -> Any:
    """A field that must be given."""
    return field(metadata={"text": text, **bounds})


def nearest(word: str, known: Iterable[str]) -> str:
    """`; did you mean X?` with the name in `known` that is most like `word`, or nothing."""
    found = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f"; did you mean {found[0]}?" if found else ""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """The type of a setting, taken apart."""

    base: type
    """str, int, float, bool, list, or a settings class."""
    item: type | None = None
    """Of a list."""
    choices: tuple[Any, ...] = ()
    optional: bool = False

    @property
    def expected(self) -> str:
        """In words, for messages and help."""
        if self.choices:
            words = _either([str(choice) for choice in self.choices])
        else:
            names = {str: "a text", int: "a whole number", float: "a number", bool: "true or false"}
            names[dict] = "keys with values"
            words = names.get(self.base, self.base.__name__)
            if self.base is list:
                words = {float: "a list of numbers", int: "a list of whole numbers"}.get(self.item, "a list of names")
        return f"{words} or null" if self.optional else words


def kinds(cls: type) -> dict[str, Kind]:
    """Kind of every field of a settings class, by name."""
    hints = get_type_hints(cls)
    return {f.name: _kind(hints[f.name]) for f in dataclasses.fields(cls)}


def check(settings: Any) -> None:
    """Check every field of a settings instance against its type, its choices and its bounds.

    Raises:
        SettingsError: naming the field, what it is, and what it may be.
    """
    of = kinds(type(settings))
    for f in dataclasses.fields(settings):
        kind, value = of[f.name], getattr(settings, f.name)
        where = f"{settings.key}{f.name}={shown(value)}"
        if value is None and kind.optional:
            continue
        if not _is_a(value, kind):
            hint = nearest(str(value), map(str, kind.choices)) if kind.choices else ""
            raise SettingsError(f"{where}: expected {kind.expected}{hint}")
        _check_bounds(where, value, f.metadata)


def _check_bounds(where: str, value: Any, bounds: Any) -> None:
    if "length" in bounds and len(value) != bounds["length"]:
        raise SettingsError(f"{where}: expected {bounds['length']} values, got {len(value)}")
    if "above" in bounds and not value > bounds["above"]:
        raise SettingsError(f"{where}: must be above {bounds['above']:g}")
    if "at_least" in bounds and not value >= bounds["at_least"]:
        raise SettingsError(f"{where}: must be at least {bounds['at_least']:g}")
    if "at_most" in bounds and not value <= bounds["at_most"]:
        raise SettingsError(f"{where}: must be at most {bounds['at_most']:g}")


def _is_a(value: Any, kind: Kind) -> bool:
    if kind.choices:
        return value in kind.choices and not isinstance(value, bool)
    if kind.base is list:
        item = Kind(base=kind.item or str)
        return isinstance(value, list | tuple) and all(_is_a(v, item) for v in value)
    if kind.base is float:
        return isinstance(value, float | int) and not isinstance(value, bool) and math.isfinite(value)
    if kind.base is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, kind.base)


def _kind(hint: Any) -> Kind:
    if get_origin(hint) in (Union, types.UnionType):
        (inner,) = [arg for arg in get_args(hint) if arg is not type(None)]
        return dataclasses.replace(_kind(inner), optional=True)
    if get_origin(hint) is Literal:
        choices = get_args(hint)
        return Kind(base=type(choices[0]), choices=choices)
    if get_origin(hint) is dict:
        return Kind(base=dict)
    if get_origin(hint) is list:
        return Kind(base=list, item=get_args(hint)[0])
    return Kind(base=hint)


def _either(words: list[str]) -> str:
    return f"{', '.join(words[:-1])} or {words[-1]}"


def shown(value: Any) -> str:
    """`value` as one writes it on the command line."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(str, value))}]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return str(value)
