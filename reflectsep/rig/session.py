"""A session on disk: a lock, an event log, whole frames, and a manifest that is replaced atomically.

session.json   what the session is (plan, firmware, camera) and which steps are done, with the checksum of every file
events.jsonl   everything that happened, one JSON object a line, each synced before the next thing is done
incoming/      frames of the step under way; emptied when the step is done or tried again
preview.png    the last frame
capture.json   written last, when every step is done

At any moment every file that the manifest names is whole. A step is done or it is not: nothing is resumed inside one.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from reflectsep.errors import SessionError
from reflectsep.io.files import atomic_write, inside, read_json, sha256, write_json

FORMAT = "reflectsep-session/1"
MANIFEST, EVENTS, LOCK, INCOMING = "session.json", "events.jsonl", "session.lock", "incoming"


class Session:
    """One session folder, held by one process.

    Args:
        folder: Of the capture.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self._document: dict[str, Any] = {}
        self._lock: TextIO | None = None
        self._log: int | None = None

    @property
    def exists(self) -> bool:
        """Whether there is a session in the folder."""
        return (self.folder / MANIFEST).is_file()

    @property
    def finished(self) -> bool:
        """Whether the capture is complete."""
        return self.exists and bool(read_json(self.folder / MANIFEST, SessionError).get("finished"))

    def open(self, *, resume: bool) -> None:
        """Take the folder: make it, or go on with what is in it.

        Raises:
            SessionError: in use, not a session of ours, an unfinished one without `resume`, a damaged manifest, or a
                folder that cannot be written.
        """
        if not resume and self.exists:
            done = len(self._read()["steps"])
            raise SessionError(f"{self.folder}: holds a session with {done} steps done; say resume=true to go on")
        if self.folder.is_dir() and any(self.folder.iterdir()) and not self.exists and not self._only_ours():
            raise SessionError(f"{self.folder}: not empty, and no {MANIFEST} in it: choose another folder")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._take_lock()
            for leftover in self.folder.glob(".*.part*"):
                shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
            self._open_log()
            self._document = self._read() if self.exists else {"format": FORMAT, "steps": {}}
        except BaseException as error:
            self.close()
            if isinstance(error, OSError):
                raise unwritable(self.folder, error) from error
            raise

    def close(self) -> None:
        """Let go of the folder; never raises."""
        if self._log is not None:
            os.close(self._log)
            self._log = None
        if self._lock is not None:
            self._lock.close()  # which unlocks it: a lock file that is left behind locks nothing
            self._lock = None

    def agree(self, what: Mapping[str, Any]) -> None:
        """Record what the session is, or hold it against what was recorded.

        Raises:
            SessionError: something differs: which, and how.
        """
        fresh = json.loads(json.dumps(what))
        known = self._document.get("made_by")
        if known is None or (known != fresh and not self._document["steps"]):
            # Nothing has been taken yet: another setup is no contradiction.
            self._document.pop("exposures", None)
            self._document["made_by"] = fresh
            self._document["created"] = datetime.now(UTC).isoformat(timespec="seconds")
            self._save()
            return
        difference = _difference(known, fresh, "")
        if difference is not None:
            raise SessionError(f"{self.folder}: was begun with another setup, so it cannot go on: {difference}")

    def event(self, event: str, **facts: Any) -> None:
        """Append a line to the log, synced.

        Raises:
            OSError: no space, or another fault of the disk.
        """
        assert self._log is not None
        line = json.dumps({"at": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **facts})
        data = line.encode() + b"\n"
        while data:
            data = data[os.write(self._log, data) :]
        os.fsync(self._log)

    def step(self, name: str) -> dict[str, Any] | None:
        """The record of a step that is done and whose files are all as recorded; None: take it."""
        record = self._document["steps"].get(name)
        if record is None:
            return None
        for file, checksum in record["files"].items():
            path = inside(self.folder, file)
            if not path.is_file() or sha256(path) != checksum:
                self.event("damaged", step=name, file=file)
                return None
        return record

    def begin_step(self, name: str) -> Path:
        """Forget what an earlier try left; returns the empty folder for incoming files."""
        record = self._document["steps"].pop(name, None)
        if record is not None:
            self._save()
        shutil.rmtree(self.folder / INCOMING, ignore_errors=True)
        (self.folder / INCOMING).mkdir()
        self.event("begin", step=name)
        return self.folder / INCOMING

    def end_step(self, name: str, moves: Mapping[str, Path], facts: Mapping[str, Any]) -> None:
        """Put the files in their places and record the step as done.

        Args:
            name: Of the step.
            moves: Files in `incoming/` by their final name in the session.
            facts: For the record.
        """
        folders = {inside(self.folder, file).parent for file in moves}
        for folder in folders:
            if folder != self.folder:
                shutil.rmtree(folder, ignore_errors=True) if name.startswith("sweep") else None
                folder.mkdir(parents=True, exist_ok=True)
        files = {}
        for file, source in moves.items():
            target = inside(self.folder, file)
            files[file] = sha256(source)
            source.replace(target)
        for folder in folders:
            _sync_folder(folder)
        self._document["steps"][name] = {"files": files, **json.loads(json.dumps(facts))}
        self._save()
        shutil.rmtree(self.folder / INCOMING, ignore_errors=True)
        self.event("done", step=name, files=len(files))

    def remember(self, key: str, value: Any) -> None:
        """Record a fact of the whole session."""
        self._document[key] = value
        self._save()

    def recall(self, key: str) -> Any:
        """A fact recorded by `remember`; None where there is none."""
        return self._document.get(key)

    def _save(self) -> None:
        write_json(self.folder / MANIFEST, self._document)

    def _read(self) -> dict[str, Any]:
        document = read_json(self.folder / MANIFEST, SessionError)
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise SessionError(f"{self.folder / MANIFEST}: no {FORMAT} manifest")
        if not isinstance(document.get("steps"), dict):
            raise SessionError(f"{self.folder / MANIFEST}: has no steps")
        return document

    def _only_ours(self) -> bool:
        """Whether a session was killed in this folder before its first manifest."""
        names = {p.name for p in self.folder.iterdir() if not (p.name.startswith(".") and ".part" in p.name)}
        return names <= {EVENTS, LOCK}

    def _take_lock(self) -> None:
        import fcntl

        lock = open(self.folder / LOCK, "a+", encoding="utf-8")  # noqa: SIM115  (held as long as the session)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.seek(0)
            holder = lock.read().strip() or "?"
            lock.close()
            raise SessionError(f"{self.folder}: another session is running in it (process {holder})") from None
        lock.truncate(0)
        lock.write(f"{os.getpid()}\n")
        lock.flush()
        self._lock = lock

    def _open_log(self) -> None:
        path = self.folder / EVENTS
        self._log = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        size = os.fstat(self._log).st_size
        if size and os.pread(self._log, 1, size - 1) != b"\n":
            os.write(self._log, b"\n")  # a line that a crash cut off stays alone on its line
            self.event("torn line")


def unwritable(folder: Path, error: OSError) -> SessionError:
    """The error of a session whose folder cannot be written, or no longer."""
    return SessionError(f"{folder}: cannot be written: {error.strerror or error}")


def read_events(folder: Path | str) -> list[dict[str, Any]]:
    """The events of a session; lines that a crash cut off are left out."""
    events = []
    for line in (Path(folder) / EVENTS).read_bytes().splitlines():
        try:
            event = json.loads(line)
        except ValueError:
            continue
        if isinstance(event, dict):
            events.append(event)
    return events


def write_bytes(path: Path, data: bytes) -> None:
    """A whole file or none."""
    atomic_write(path, lambda temporary: temporary.write_bytes(data))


def _difference(old: Any, new: Any, where: str) -> str | None:
    """The first place in which two JSON values differ, in words."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(k for k in new if k not in old)]:
            place = f"{where}.{key}" if where else str(key)
            if key not in old or key not in new:
                return f"{place} was {'not there' if key not in old else json.dumps(old[key])[:60]} before"
            found = _difference(old[key], new[key], place)
            if found is not None:
                return found
        return None
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (a, b) in enumerate(zip(old, new, strict=True)):
            found = _difference(a, b, f"{where}[{index}]")
            if found is not None:
                return found
        return None
    return None if old == new else f"{where} was {json.dumps(old)[:60]}, is {json.dumps(new)[:60]}"


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
