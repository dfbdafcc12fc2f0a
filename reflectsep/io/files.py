"""Files that are whole or not there: atomic writes, paths that stay in their folder, checksums, strict JSON."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from reflectsep.errors import CaptureError, ReflectsepError, ResultError

MARKERS = ("separation.json", "capture.json", "relit.json")
"""A folder that has one of these is ours, and may be replaced when asked."""


def atomic_write(path: Path | str, write: Callable[[Path], object]) -> None:
    """Write a file through a temporary one in the same folder: synced, then renamed over `path`.

    Args:
        path: file to make; its folder is made where missing.
        write: makes the file at the path it is given, which keeps the suffix of `path`.

    Raises:
        Exception: whatever `write` raises; the temporary file is gone then and `path` is as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.stem[:40]}.", suffix=f".part{path.suffix}", dir=path.parent)
    except OSError as error:
        raise _about(error, path) from None
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        # mkstemp makes files private; give the result the mode that an ordinary open() would have given.
        temporary.chmod(0o666 & ~_umask())
        _sync(temporary)
        temporary.replace(path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _about(error, path) from error
        raise
    _sync_folder(path.parent)


@contextmanager
def atomic_folder(out: Path | str, overwrite: bool) -> Iterator[Path]:
    """A temporary folder beside `out` that becomes `out` when the block ends well, and vanishes when it does not.

    Args:
        out: folder to make; an empty folder there is taken over.
        overwrite: replace an existing result or capture, once the new one is whole.

    Yields:
        The temporary folder to write into.

    Raises:
        ResultError: `out` exists and `overwrite` is false, or is neither empty nor a result or capture of ours.
    """
    out = Path(os.path.abspath(out))
    _may_replace(out, overwrite)
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        temporary = Path(tempfile.mkdtemp(prefix=f".{out.name[:40]}.", suffix=".part", dir=out.parent))
    except OSError as error:
        raise _about(error, out) from None
    try:
        yield temporary
        temporary.chmod(0o777 & ~_umask())
        for file in temporary.rglob("*"):
            if file.is_file():
                _sync(file)
        _may_replace(out, overwrite)
        _exchange(temporary, out)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            raise _about(error, out, temporary) from error
        raise
    _sync_folder(out.parent)


def _about(error: OSError, path: Path, temporary: Path | None = None) -> OSError:
    """The same error about the file that was to be made, not about the temporary one in its place."""
    named = Path(error.filename) if isinstance(error.filename, str) else None
    if error.errno is None or (temporary is not None and named is not None and not named.is_relative_to(temporary)):
        return error
    if temporary is not None and named is not None:
        path = path / named.relative_to(temporary)
    return OSError(error.errno, error.strerror, str(path))


def inside(folder: Path | str, relative: str) -> Path:
    """The path of `relative` in `folder`, sure not to leave it: not by `..`, an absolute path, a drive or a symlink.

    Raises:
        CaptureError: it would, or it is empty.
    """
    folder = Path(folder)
    if not relative or "\0" in relative:
        raise CaptureError(f"{folder}: {relative!r} is no file name")
    windows = PureWindowsPath(relative)
    if PurePosixPath(relative).is_absolute() or windows.drive or windows.root or ".." in windows.parts:
        raise CaptureError(f"{folder}: {relative!r} leads out of the folder; paths must be relative and stay in it")
    path = folder / relative
    root = folder.resolve()
    try:
        target = path.resolve()
    except (OSError, RuntimeError) as error:
        raise CaptureError(f"{path}: cannot be followed: {error}") from error
    if not target.is_relative_to(root):
        raise CaptureError(f"{folder}: {relative!r} is a link to {target}, outside the folder")
    return path


def sha256(path: Path | str) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_json(path: Path | str, document: Any) -> None:
    """Write `document` atomically as indented UTF-8 JSON.

    Raises:
        ValueError: it holds NaN or an infinity, which JSON has no word for.
        TypeError: it holds something that is not JSON (a tensor, a numpy scalar).
    """
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_json(path: Path | str, error: type[ReflectsepError] = CaptureError) -> Any:
    """Read JSON; NaN, infinities and repeated keys are refused.

    Args:
        path: the file.
        error: class of the errors raised.

    Raises:
        ReflectsepError: (as `error`) missing, unreadable or not JSON, with line and column.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        return json.loads(text, parse_constant=_refuse_constant, parse_float=_finite, object_pairs_hook=_unique)
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except OSError as reason:
        raise error(f"{path}: cannot be read: {reason.strerror or reason}") from reason
    except json.JSONDecodeError as reason:
        raise error(f"{path}: not JSON: {reason.msg} at line {reason.lineno}, column {reason.colno}") from reason
    except UnicodeDecodeError as reason:
        raise error(f"{path}: not JSON: not UTF-8 text") from reason
    except (ValueError, RecursionError) as reason:
        raise error(f"{path}: {reason}") from reason


def _refuse_constant(word: str) -> float:
    raise ValueError(f"{word} is no number in JSON")


def _finite(text: str) -> float:
    value = float(text)
    if value in (float("inf"), float("-inf")):
        raise ValueError(f"{text} is too large for a number")
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in pairs:
        if key in result:
            raise ValueError(f"key {key!r} appears twice in one object")
        result[key] = value
    return result


def _may_replace(out: Path, overwrite: bool) -> None:
    """Raise ResultError unless a new folder may take the place of `out`."""
    if not os.path.lexists(out):
        return
    if out.is_symlink() or not out.is_dir():
        raise ResultError(f"{out}: is a file or link, not a folder; choose another place")
    if not any(out.iterdir()):
        return
    if not any((out / marker).is_file() for marker in MARKERS):
        raise ResultError(f"{out}: not empty, and no {' or '.join(MARKERS)} in it: not ours to replace")
    if not overwrite:
        raise ResultError(f"{out}: exists; choose another folder, or say overwrite=true")


def refuse_existing(path: Path | str, overwrite: bool) -> None:
    """Refuse an output before any work is done for it: one that is there, or that can never be written.

    An empty folder is free.

    Raises:
        ResultError: `path` exists and `overwrite` is false, or its folder is none or takes no files.
    """
    path = Path(path)
    empty = path.is_dir() and not path.is_symlink() and not any(path.iterdir())
    if os.path.lexists(path) and not empty and not overwrite:
        raise ResultError(f"{path}: exists; choose another place, or say overwrite=true")
    whole = Path(os.path.abspath(path))
    above = next((folder for folder in whole.parents if os.path.lexists(folder)), whole)
    if not above.is_dir():
        raise ResultError(f"{path}: cannot be written: {above} is not a folder")
    if not os.access(above, os.W_OK | os.X_OK):
        raise ResultError(f"{path}: cannot be written: nothing may be written in {above}")


def refuse_folder(path: Path | str, overwrite: bool) -> None:
    """Refuse, before any work is done for it, an output folder that `atomic_folder` would refuse after the work.

    Raises:
        ResultError: as `atomic_folder`.
    """
    refuse_existing(path, overwrite)
    _may_replace(Path(path), overwrite)


def _exchange(temporary: Path, out: Path) -> None:
    """Move `temporary` to `out`; what was there goes only after, and comes back if the move fails."""
    if not os.path.lexists(out):
        temporary.rename(out)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{out.name[:40]}.", suffix=".old", dir=out.parent))
    out.rename(old)  # over the empty folder just made, which only reserved the name
    try:
        temporary.rename(out)
    except BaseException:
        old.rename(out)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


def _sync(path: Path) -> None:
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    # Not every file system lets a folder be opened or synced; the rename itself is done by then.
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
