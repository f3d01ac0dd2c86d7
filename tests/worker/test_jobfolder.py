"""Job folders: links, locks, publication; and the journal of events in them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from worker import jobfolder
from worker.jobfolder import JobFolder, write_atomically
from worker.journal import EventWriter, read_events
from worker.ledger import Job


@pytest.fixture
def folder(new_job: Callable[..., Job], tmp_path: Path) -> JobFolder:
    return JobFolder(tmp_path, new_job().id)


def test_the_scan_is_linked_not_copied(folder: JobFolder) -> None:
    assert (folder.scan / "scan.json").stat().st_nlink == 2


def test_the_scan_is_copied_where_links_are_impossible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, target: Path) -> None:
        raise PermissionError(1, "no hard links here")

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    source = tmp_path / "a"
    source.write_bytes(b"bytes")
    jobfolder.link_or_copy(source, tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == b"bytes"


def test_the_lock_is_exclusive(folder: JobFolder) -> None:
    with folder.lock() as first:
        assert first is not None
        with folder.lock() as second:
            assert second is None
    with folder.lock() as third:
        assert third is not None


def test_a_deleted_folder_has_no_lock(folder: JobFolder) -> None:
    folder.remove()
    assert not folder.path.exists()
    with folder.lock() as lock:
        assert lock is None


def test_results_appear_whole(folder: JobFolder) -> None:
    made = folder.prepare({"options": {}}, 1)
    (made / "volume.tif").write_bytes(b"half")
    assert not folder.published()
    (made / "manifest.json").write_text("{}")
    assert not folder.published()
    folder.publish(1)
    assert folder.published() and not made.exists()


def test_a_new_attempt_clears_what_the_last_one_left(folder: JobFolder) -> None:
    (folder.prepare({}, 1) / "volume.tif").write_bytes(b"half")
    folder.cancel.touch()
    assert list(folder.prepare({}, 2).iterdir()) == []
    assert not folder.attempt(1).exists() and not folder.cancel.exists()


def test_an_atomic_write_that_fails_leaves_the_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def fail(_descriptor: int) -> None:
        raise OSError(5, "I/O error")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="I/O error"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


_DIES_WRITING = """
import os, sys
from pathlib import Path
from worker.jobfolder import JobFolder

os.fsync = lambda descriptor: os._exit(9)
JobFolder(Path(sys.argv[1]), sys.argv[2]).prepare({}, 1)
"""


@pytest.mark.parametrize("go_on", [lambda folder: folder.prepare({}, 2), JobFolder.tidy], ids=["again", "given up"])
def test_a_worker_that_dies_writing_the_job_leaves_nothing_for_good(
    folder: JobFolder, tmp_path: Path, go_on: Callable[[JobFolder], object]
) -> None:
    died = subprocess.run([sys.executable, "-c", _DIES_WRITING, str(tmp_path), folder.path.name])
    assert died.returncode == 9
    assert len(list(folder.path.glob(".job.json.*.part"))) == 1
    go_on(folder)
    assert list(folder.path.glob(".job.json.*.part")) == []


def test_events_are_numbered_across_writers_and_a_torn_line_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    with EventWriter(path) as events:
        events.append({"stage": "read"})
        events.append({"stage": "level"})
    with path.open("ab") as file:
        file.write(b'{"number": 3, "sta')  # the writer was killed here
    assert [event["number"] for event in read_events(path, 0, 10)] == [1, 2]
    with EventWriter(path) as events:
        events.append({"stage": "start"})
    assert [(e["number"], e["stage"]) for e in read_events(path, 1, 10)] == [(2, "level"), (3, "start")]
    assert len(read_events(path, 0, 2)) == 2
    assert all(json.loads(line) for line in path.read_text().splitlines())


def test_a_full_disk_leaves_whole_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes a part of a line. The disk is pretended: tests/http/test_full_disk.py has a real one."""
    path = tmp_path / "events.jsonl"
    with EventWriter(path) as events:
        events.append({"stage": "read"})
        file = events._file

        class Full:
            fileno, room = file.fileno, 5

            def write(self, data: memoryview) -> int:
                if not self.room:
                    raise OSError(28, "No space left on device")
                taken, self.room = file.write(data[: self.room]), 0
                return int(taken)

        monkeypatch.setattr(events, "_file", Full())
        with pytest.raises(OSError, match="No space left"):
            events.append({"stage": "level"})
        monkeypatch.undo()
        assert path.read_bytes().endswith(b"\n")
        events.append({"stage": "done"})
    assert [(e["number"], e["stage"]) for e in read_events(path, 0, 10)] == [(1, "read"), (2, "done")]


def test_no_events_yet(tmp_path: Path) -> None:
    assert read_events(tmp_path / "events.jsonl", 0, 10) == []
