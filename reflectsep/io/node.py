"""Reading a JSON document value by value, with errors that name the file and the place in it."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Formatter
from typing import Any, TypeVar

from reflectsep.data import Vector
from reflectsep.errors import CaptureError
from reflectsep.io.files import inside
from reflectsep.io.lights import unit

T = TypeVar("T")


@dataclass(frozen=True)
class Node:
    """A value of the document and where it stands, for messages that name the place."""

    path: Path
    place: str
    value: Any

    def fail(self, expected: str) -> CaptureError:
        """The error of a value that is not what was expected."""
        return CaptureError(f"{self.path}: {self.place}: found {self.value!r:.80}, expected {expected}")

    def child(self, key: str | int) -> Node:
        """The value under `key`, which must exist."""
        place = f"{self.place}[{key}]" if isinstance(key, int) else f"{self.place}.{key}".removeprefix("manifest.")
        return Node(self.path, place, self.value[key])

    def object(self, known: Sequence[str], required: Iterable[str]) -> Node:
        """Itself, sure to be an object with known keys and all of the required ones."""
        if not isinstance(self.value, dict):
            raise self.fail("an object")
        for key in self.value:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)[0]
                raise CaptureError(f"{self.path}: {self.place}: unknown key {key!r}; did you mean {near!r}?")
        for key in required:
            if key not in self.value:
                raise CaptureError(f"{self.path}: {self.place}: no {key!r} in it")
        return self

    def optional(self, key: str, read: Callable[[Node], T], default: T) -> T:
        """`read` of the value under `key`, or `default` where there is none."""
        return read(self.child(key)) if key in self.value else default

    def items(self) -> list[Node]:
        """The nodes of a list."""
        if not isinstance(self.value, list):
            raise self.fail("a list")
        return [self.child(index) for index in range(len(self.value))]


def nullable(read: Callable[[Node], T]) -> Callable[[Node], T | None]:
    """A reader that takes null for None."""
    return lambda node: None if node.value is None else read(node)


def text(node: Node) -> str:
    """A text that is not empty."""
    if not isinstance(node.value, str) or not node.value:
        raise node.fail("a text")
    return node.value


def number(node: Node) -> float:
    """A number; true and false are none."""
    if isinstance(node.value, bool) or not isinstance(node.value, int | float):
        raise node.fail("a number")
    try:
        return float(node.value)
    except OverflowError:
        raise node.fail("a number that a float can hold") from None


def positive(node: Node) -> float:
    """A number above zero."""
    value = number(node)
    if not (math.isfinite(value) and value > 0):
        raise node.fail("a positive number")
    return value


def whole(node: Node, least: int) -> int:
    """A whole number of at least `least`."""
    if isinstance(node.value, bool) or not isinstance(node.value, int) or node.value < least:
        raise node.fail(f"a whole number of at least {least}")
    return node.value


def choice(node: Node, allowed: tuple[str, ...]) -> Any:
    """One of the allowed words."""
    if node.value not in allowed:
        raise node.fail(" or ".join(repr(word) for word in allowed))
    return node.value


def direction(node: Node) -> Vector:
    """Three numbers, made a unit vector."""
    numbers = [number(item) for item in node.items()]
    if len(numbers) != 3:
        raise node.fail("three numbers")
    return unit(numbers, f"{node.path}: {node.place}")


def file(node: Node) -> str:
    """A file name that stays in the manifest's folder."""
    name = text(node)
    try:
        inside(node.path.parent, name)
    except CaptureError as error:
        raise CaptureError(f"{node.path}: {node.place}: {error}") from error
    return name


def pattern(node: Node) -> str:
    """A file name with one whole-number field and nothing else that `str.format` would follow."""
    name = text(node)
    try:
        fields = [(key, form, conversion) for _, key, form, conversion in Formatter().parse(name) if key is not None]
    except ValueError:
        fields = []
    # The form is empty, or fills up with zeros: blanks in a file name are nobody's wish.
    plain = [key in ("", "0") and not conv and re.fullmatch(r"(0\d{1,2})?d?", form or "") for key, form, conv in fields]
    if len(plain) != 1 or not plain[0]:
        raise node.fail("a file name with one number in it, like sweep/L1/{:04d}.exr")
    file(Node(node.path, node.place, name.format(0)))
    return name


def checksum(node: Node) -> str:
    """A SHA-256, in lower case."""
    if not isinstance(node.value, str) or not re.fullmatch(r"[0-9a-fA-F]{64}", node.value):
        raise node.fail("a SHA-256 of 64 hexadecimal digits")
    return node.value.lower()
