"""Uploaded bytes on disk: a file counts once all of it is durable under its final name.

uploads/ID/parts/   files on their way: each PUT with a name of its own, pieces as server.partial says
uploads/ID/scan/    complete files; becomes scans/ID by one rename at commit
uploads/ID/.lock    shared by writers, exclusive for a commit
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from worker.jobfolder import link_or_copy, sync_file, sync_folder


class Busy(Exception):
    """The upload is being committed, or its files are still being written."""


class Gone(Exception):
    """The upload's folder is no longer there."""


class Mismatch(Exception):
    """The bytes are not the announced ones; the text says how."""


class Intake:
    def __init__(self, data: Path) -> None:
        self._uploads = data / "uploads"
        self._scans = data / "scans"
        for folder in (self._uploads, self._scans):
            folder.mkdir(parents=True, exist_ok=True)
        self._settling = threading.Lock()  # keeps file and database row of one name in step

    def scan_folder(self, scan_id: str) -> Path:
        return self._scans / scan_id

    def open_folder(self, upload_id: str) -> Path:
        """Where the complete files of an open upload lie; the scan's own folder if a commit was cut short."""
        folder = self._uploads / upload_id / "scan"
        return folder if folder.is_dir() else self._scans / upload_id

    def create(self, upload_id: str) -> None:
        """Harmless when that has been done."""
        for name in ("parts", "scan"):
            (self._uploads / upload_id / name).mkdir(parents=True, exist_ok=True)
        (self._uploads / upload_id / ".lock").touch()

    @contextlib.contextmanager
    def writing(self, upload_id: str) -> Iterator[Path]:
        """For receiving a file; yields the folder for parts."""
        with self._locked(upload_id, fcntl.LOCK_SH, 0.0):
            yield self._uploads / upload_id / "parts"

    @contextlib.contextmanager
    def alone(self, upload_id: str, wait_s: float) -> Iterator[None]:
        """For committing or deleting: nobody writes meanwhile."""
        with self._locked(upload_id, fcntl.LOCK_EX, wait_s):
            yield

    def settle(self, upload_id: str, name: str, move_to: Callable[[Path], None], record: Callable[[], None]) -> None:
        """Give a complete file its name and record it, as one step towards other writers of that name."""
        with self._settling:
            move_to(self.settled(upload_id, name))
            record()

    def adopt(self, upload_id: str, name: str, scan_id: str, source: str) -> None:
        """Give an upload a file that a scan has: another name of it, or a copy where the file system has no links. Both
        are only ever replaced, never written to. Raises FileNotFoundError if the scan is gone."""
        target = self.settled(upload_id, name)
        target.unlink(missing_ok=True)  # a copy would write into what is there, under whatever other names
        link_or_copy(self._scans / scan_id / source, target)
        sync_file(target)

    def sync(self, upload_id: str) -> None:
        sync_folder(self._uploads / upload_id / "scan")

    def settled(self, upload_id: str, name: str) -> Path:
        return self._uploads / upload_id / "scan" / name

    def promote(self, upload_id: str) -> None:
        """Turn the files of an upload into a scan. Harmless when that has been done."""
        source, target = self._uploads / upload_id / "scan", self._scans / upload_id
        if source.is_dir():
            source.rename(target)
            sync_folder(target.parent)
            sync_folder(source.parent)

    def remove_upload(self, upload_id: str) -> None:
        shutil.rmtree(self._uploads / upload_id, ignore_errors=True)

    def remove_scan(self, scan_id: str) -> None:
        doomed = self._scans / f".deleted-{scan_id}"
        with contextlib.suppress(FileNotFoundError):
            (self._scans / scan_id).rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)

    @contextlib.contextmanager
    def _locked(self, upload_id: str, how: int, wait_s: float) -> Iterator[None]:
        try:
            descriptor = os.open(self._uploads / upload_id / ".lock", os.O_RDWR)
        except FileNotFoundError:
            raise Gone from None
        deadline = time.monotonic() + wait_s
        try:
            while True:
                try:
                    fcntl.flock(descriptor, how | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if time.monotonic() >= deadline:
                        raise Busy from None
                    time.sleep(0.05)
            yield
        finally:
            os.close(descriptor)
