"""The folder of one job: what lies where, and writes that survive a power cut.

JOBDIR/scan/          the scan, hard links of the committed one
JOBDIR/job.json       what the engine is to do (written at each claim)
JOBDIR/.lock          held (flock) by supervisor and engine as long as either lives
JOBDIR/cancel         exists: the engine is asked to stop
JOBDIR/events.jsonl   progress, one JSON object per line
JOBDIR/log.txt        the engine's stderr
JOBDIR/attempt-N/     results in the making
JOBDIR/run.checkpoint the engine's state, from which the next attempt goes on
JOBDIR/draft.tif      the volume as it stood at the end of a level, to be seen while the run goes on
JOBDIR/partial/       what a run had when it was cancelled or its time was up; complete like results/
JOBDIR/results/       published; complete from the moment it exists
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def write_atomically(path: Path, data: bytes) -> None:
    """Replace `path` by `data`: a reader, or a crash, sees the old or the new, never a part."""
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in `folder` durable, as fsync of a file does for its bytes."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_file(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def link_or_copy(source: Path, target: Path) -> None:
    """A hard link, or a copy where the file system has none."""
    try:
        target.hardlink_to(source)
    except OSError:
        shutil.copyfile(source, target)


class JobFolder:
    """Paths and the few operations on one job's folder."""

    def __init__(self, data: Path, job_id: str) -> None:
        self.path = data / "jobs" / job_id
        self.scan = self.path / "scan"
        self.spec = self.path / "job.json"
        self.lock_file = self.path / ".lock"
        self.cancel = self.path / "cancel"
        self.events = self.path / "events.jsonl"
        self.log = self.path / "log.txt"
        self.scratch = self.path / "tmp"
        self.results = self.path / "results"
        self.partial = self.path / "partial"
        self.checkpoint = self.path / "run.checkpoint"
        self.draft = self.path / "draft.tif"

    def create(self, scan: Path) -> None:
        """Lay out the folder with the files of the committed scan in it."""
        self.scan.mkdir(parents=True)
        for file in sorted(scan.iterdir()):
            link_or_copy(file, self.scan / file.name)
        self.lock_file.touch()
        for folder in (self.scan, self.path, self.path.parent):
            sync_folder(folder)

    def go_on_from(self, earlier: JobFolder) -> None:
        """Begin with the state that an earlier job of the same scan was left in, if there is one. The engine uses it
        where the options are the same too."""
        with contextlib.suppress(FileNotFoundError):
            link_or_copy(earlier.checkpoint, self.checkpoint)

    def become(self, other: JobFolder) -> None:
        """Take the place of `other`, where only a request that was cut short may have left something."""
        other.remove()
        self.path.rename(other.path)
        sync_folder(other.path.parent)

    def attempt(self, number: int) -> Path:
        return self.path / f"attempt-{number}"

    @contextlib.contextmanager
    def lock(self, wait_s: float = 0.0) -> Iterator[int | None]:
        """Hold the job's lock; yields its descriptor, or None if another process has it."""
        try:
            descriptor = os.open(self.lock_file, os.O_RDWR | os.O_CREAT, 0o600)
        except FileNotFoundError:
            yield None
            return
        try:
            yield descriptor if _flock(descriptor, wait_s) else None
        finally:
            os.close(descriptor)

    def prepare(self, spec: dict[str, Any], number: int) -> Path:
        """Clear what earlier attempts left and make the folder of this one."""
        self.discard_attempts()
        self.cancel.unlink(missing_ok=True)
        shutil.rmtree(self.scratch, ignore_errors=True)
        self.scratch.mkdir()
        self.attempt(number).mkdir()
        spec = {**spec, "began_with": _stamp(self.checkpoint)}
        write_atomically(self.spec, json.dumps(spec, indent=1).encode())
        return self.attempt(number)

    def advanced(self) -> bool:
        """Whether the present attempt has kept a state of its own: the next one will begin further on."""
        try:
            began_with = json.loads(self.spec.read_bytes()).get("began_with")
        except (FileNotFoundError, ValueError):
            return False
        return _stamp(self.checkpoint) not in (None, began_with)

    def published(self) -> bool:
        """Whether results stand. The folder appears by one rename, its manifest inside."""
        return (self.results / "manifest.json").is_file()

    def publish(self, number: int) -> None:
        """Make attempt `number` the job's results, durably and in one step."""
        self._publish(self.attempt(number), self.results)

    def publish_partial(self, number: int) -> bool:
        """Keep what attempt `number` had made when it was asked to end; False if it had made nothing whole."""
        made = self.results if self.published() else self.attempt(number)
        if not (made / "manifest.json").is_file():
            return False
        shutil.rmtree(self.partial, ignore_errors=True)
        self._publish(made, self.partial)
        return True

    def _publish(self, made: Path, goal: Path) -> None:
        for file in made.iterdir():
            sync_file(file)
        sync_folder(made)
        made.rename(goal)
        sync_folder(self.path)

    def discard_attempts(self) -> None:
        for left in self.path.glob("attempt-*"):
            shutil.rmtree(left, ignore_errors=True)
        for unfinished in self.path.glob(f".{self.spec.name}.*.part"):  # its writer was killed
            unfinished.unlink(missing_ok=True)

    def tidy(self) -> None:
        """After the end: drop what only a running job needs. The scan is kept by the scan store; the state, without
        which a restart would begin anew, where there are no results."""
        self.discard_attempts()
        shutil.rmtree(self.scratch, ignore_errors=True)
        shutil.rmtree(self.scan, ignore_errors=True)
        for file in (self.cancel, self.draft, self.draft.with_suffix(".part")):
            file.unlink(missing_ok=True)
        if self.published():
            self.checkpoint.unlink(missing_ok=True)
        self.checkpoint.with_name(f".{self.checkpoint.name}.part").unlink(missing_ok=True)

    def kept_bytes(self) -> int:
        """Of what stays of a job that has ended. The scan is its store's."""
        kept = [self.events, self.log, *self.results.glob("*"), *self.partial.glob("*")]
        sizes = map(_size, kept if self.published() else [*kept, self.checkpoint])
        return sum(sizes)

    def remove(self) -> None:
        """Delete everything. Renamed first, so that a half-deleted folder is never taken for a job."""
        doomed = self.path.with_name(f".deleted-{self.path.name}")
        with contextlib.suppress(FileNotFoundError):
            self.path.rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except FileNotFoundError:
        return 0


def _stamp(file: Path) -> list[int] | None:
    """Another for every file that takes the name; None where there is none."""
    try:
        found = file.stat()
    except FileNotFoundError:
        return None
    return [found.st_ino, found.st_mtime_ns, found.st_size]


def _flock(descriptor: int, wait_s: float) -> bool:
    deadline = time.monotonic() + wait_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() >= deadline:
                return False
            time.sleep(0.1)
