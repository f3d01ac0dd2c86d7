"""The digest of a file that arrives in pieces: of what arrived, and never of what was only thought to be there."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from server.partial import Part, Running

DATA = bytes(range(256)) * 40


class Sender:
    """One file, of which every piece opens the part anew, as every request does."""

    def __init__(self, parts: Path) -> None:
        self.path, self.running, self.acknowledged = parts / "a.part", Running(), 0

    def part(self) -> Part:
        return Part(self.path, len(DATA), self.acknowledged, self.note, self.running)

    def note(self, offset: int) -> None:
        self.acknowledged = offset

    def send(self, data: bytes, acknowledge: bool = True) -> None:
        part = self.part()
        part.write(data)
        if acknowledge:
            part.acknowledge()
        part.close()

    def sha256(self) -> str:
        part = self.part()
        try:
            assert part.offset == len(DATA)
            return part.sha256()
        finally:
            part.close()


@pytest.fixture
def sender(tmp_path: Path) -> Sender:
    return Sender(tmp_path)


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """How often a file was read for its digest."""
    read: list[str] = []
    real = hashlib.file_digest

    def file_digest(file: object, algorithm: str) -> object:
        read.append(algorithm)
        return real(file, algorithm)  # type: ignore[arg-type]

    monkeypatch.setattr(hashlib, "file_digest", file_digest)
    return read


def test_no_file_is_read_again_at_its_end(sender: Sender, unread: list[str]) -> None:
    for start in range(0, len(DATA), 1000):
        sender.send(DATA[start : start + 1000])
    assert sender.sha256() == hashlib.sha256(DATA).hexdigest() and unread == []


def test_after_a_restart_it_is_read_once(sender: Sender, unread: list[str]) -> None:
    sender.send(DATA[:3000])
    sender.running = Running()
    sender.send(DATA[3000:])
    assert sender.sha256() == hashlib.sha256(DATA).hexdigest() and len(unread) == 1


def test_what_is_dropped_or_cut_off_does_not_count(sender: Sender) -> None:
    sender.send(DATA[:3000])
    part = sender.part()
    part.write(b"x" * 500)
    part.drop_chunk()
    part.write(DATA[3000:4000])
    part.acknowledge()
    part.close()
    sender.send(b"y" * 700, acknowledge=False)
    sender.send(DATA[4000:])
    assert sender.sha256() == hashlib.sha256(DATA).hexdigest()


def test_a_file_that_begins_again_has_the_digest_of_what_came_then(sender: Sender, unread: list[str]) -> None:
    sender.send(b"x" * len(DATA))
    part = sender.part()
    part.clear()
    part.close()
    sender.send(DATA)
    assert sender.sha256() == hashlib.sha256(DATA).hexdigest() and unread == []


def test_what_another_server_wrote_is_read(sender: Sender, unread: list[str]) -> None:
    """The same offset, and other bytes before it."""
    part = sender.part()
    part.write(b"x" * 3000)
    part.acknowledge()
    os.utime(sender.path, ns=(1, 1))  # long ago: the clock of a file system ticks slowly
    part.close()
    part = Part(sender.path, len(DATA), 0, sender.note)
    part.write(DATA[:3000])
    part.acknowledge()
    part.close()
    sender.send(DATA[3000:])
    assert sender.sha256() == hashlib.sha256(DATA).hexdigest() and len(unread) == 1


def test_what_a_full_disk_left_half_written_does_not_count(sender: Sender, monkeypatch: pytest.MonkeyPatch) -> None:
    part = sender.part()
    part.write(DATA[:1000])
    part.acknowledge()
    raw = part._file

    class Full:
        """Takes half of a block, then nothing."""

        def __init__(self) -> None:
            self.left = 100

        def write(self, data: memoryview) -> int:
            if not self.left:
                raise OSError(28, "No space left on device")
            self.left, taken = 0, raw.write(data[: self.left])
            return taken

    part._file = Full()  # type: ignore[assignment]
    with pytest.raises(OSError, match="No space"):
        part.write(DATA[1000:2000])
    part._file = raw
    assert part.offset == 1100
    part.drop_chunk()
    part.write(DATA[1000:])
    part.acknowledge()
    assert part.sha256() == hashlib.sha256(DATA).hexdigest()
    part.close()


def test_only_so_many_digests_are_kept(tmp_path: Path) -> None:
    running = Running(most=3)
    for number in range(5):
        path = tmp_path / str(number)
        path.write_bytes(b"x")
        with path.open("rb") as file:
            running.keep(path, file.fileno(), hashlib.sha256(b"x"))
    kept = []
    for number in range(5):
        with (tmp_path / str(number)).open("rb") as file:
            kept.append(running.take(tmp_path / str(number), file.fileno()) is not None)
    assert kept == [False, False, True, True, True]
