"""What a backup is: a folder of files, and a manifest that names each with its size and SHA-256.

BACKUP/splatct.db      the database as it was at one moment (only where it is SQLite)
BACKUP/scans/ID/       committed scans
BACKUP/jobs/ID/        results, partial results, events, log, and the state that a run goes on from
BACKUP/manifest.json   written last: a folder without it is no backup
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from splatcore.errors import SplatCTError
from worker.jobfolder import sync_folder, write_atomically

FORMAT = "splatct-backup/1"
MANIFEST = "manifest.json"
DATABASE = "splatct.db"
_BLOCK = 1 << 20


class BackupError(SplatCTError):
    """A backup cannot be made, is damaged, or cannot be used."""

    exit_code = 1


@dataclass(frozen=True)
class Entry:
    path: str  # relative, with /
    size: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    made_at: str
    software: str
    database: bool  # whether splatct.db is among the files; else it is the database server's to keep
    scans: tuple[str, ...]
    jobs: tuple[str, ...]
    files: tuple[Entry, ...]
    damaged: tuple[str, ...] = field(default=())  # what was not as recorded when it was copied

    def write(self, folder: Path) -> None:
        text = json.dumps({"format": FORMAT, **asdict(self)}, indent=1)
        write_atomically(folder / MANIFEST, text.encode())

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Raises BackupError where there is none that can be used; its paths lead nowhere else."""
        file = folder / MANIFEST
        try:
            data: Any = json.loads(file.read_bytes())
        except FileNotFoundError:
            raise BackupError(
                f"{folder} has no {MANIFEST}; expected the folder that `splatct backup` made. One without a manifest "
                "was not finished: make another"
            ) from None
        except ValueError as error:
            raise BackupError(f"{file} is not valid JSON: {error}; restore from another backup") from None
        if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
            raise BackupError(f"{file} is not of the form {FORMAT}; was it made by a newer SplatCT? Restore with that")
        try:
            files = tuple(Entry(**entry) for entry in data.pop("files"))
            data |= {name: tuple(map(str, data[name])) for name in ("scans", "jobs", "damaged")}
            manifest = cls(files=files, **data)
        except (KeyError, TypeError) as error:
            raise BackupError(f"{file} is incomplete ({error}); restore from another backup") from None
        for entry in files:
            parts = PurePosixPath(entry.path).parts
            if not parts or parts[0] == "/" or ".." in parts:
                raise BackupError(f"{file}: the path {entry.path!r} leads out of the backup; it was tampered with")
        return manifest

    def verify(self, folder: Path) -> Iterator[str]:
        """What of the files is not as it was written, one sentence each."""
        for entry in self.files:
            try:
                size, sha256 = digest(folder / entry.path)
            except OSError as error:
                yield f"{entry.path}: cannot be read ({error.strerror or error})"
                continue
            if size != entry.size:
                yield f"{entry.path}: has {size} bytes, {entry.size} were written"
            elif sha256 != entry.sha256:
                yield f"{entry.path}: its sha256 is {sha256}, that of what was written {entry.sha256}"


class Copier:
    """Copies files durably, hashing on the way. Names of one file (hard links) stay names of one file."""

    def __init__(self) -> None:
        self._seen: dict[tuple[int, int], tuple[Path, Entry]] = {}
        self._folders: set[Path] = set()

    def copy(self, source: Path, folder: Path, path: str) -> Entry:
        """`source` to `folder`/`path`. A link is followed nowhere: OSError."""
        target = folder / path
        if target.parent not in self._folders:
            target.parent.mkdir(parents=True, exist_ok=True)
            self._folders.add(target.parent)
        descriptor = os.open(source, os.O_RDONLY | os.O_NOFOLLOW)
        with os.fdopen(descriptor, "rb", buffering=0) as reading:
            status = os.fstat(descriptor)
            known = self._seen.get((status.st_dev, status.st_ino)) if status.st_nlink > 1 else None
            if known is not None:
                target.hardlink_to(known[0])
                return Entry(path, known[1].size, known[1].sha256)
            with target.open("xb") as writing:
                sha256, size = hashlib.sha256(), 0
                while block := reading.read(_BLOCK):
                    sha256.update(block)
                    writing.write(block)
                    size += len(block)
                writing.flush()
                os.fsync(writing.fileno())
        entry = Entry(path, size, sha256.hexdigest())
        if status.st_nlink > 1:
            self._seen[status.st_dev, status.st_ino] = (target, entry)
        return entry

    def sync(self) -> None:
        for folder in self._folders:
            if folder.is_dir():
                sync_folder(folder)


def digest(path: Path) -> tuple[int, str]:
    """Size and SHA-256 of a file; a link is not followed."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW), "rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        return file.tell(), sha256
