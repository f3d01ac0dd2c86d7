"""What the janitor takes away, and what it must leave."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from server import janitor
from server.intake import Intake
from server.migrations import prepare
from server.partial import Partial
from server.store import File, Store
from worker.database import Database

HOUR = 3600.0


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    database = Database(f"sqlite:///{tmp_path / 'test.db'}")
    prepare(database)
    (tmp_path / "jobs").mkdir()
    yield Store(database)
    database.close()


def age(folder: Path, seconds: float) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    os.utime(folder, times=(time.time() - seconds,) * 2)
    return folder


def test_only_the_old_and_ownerless_goes(store: Store, tmp_path: Path) -> None:
    intake = Intake(tmp_path)
    stale = store.add_upload("stale", [File("scan.json", 1, None, None)])
    committed = store.add_upload("committed", [File("scan.json", 1, None, "0" * 64)])
    for upload in (stale, committed):
        intake.create(upload.id)
    intake.promote(committed.id)
    store.commit(committed, {})
    orphans = [age(tmp_path / kind / "orphan", 2 * HOUR) for kind in ("uploads", "scans", "jobs")]
    new = [age(tmp_path / kind / "new", 10) for kind in ("uploads", "scans", "jobs")]

    janitor.sweep(store, intake, tmp_path, stale_upload_s=48 * HOUR, now=time.time() + 1)
    assert not any(folder.exists() for folder in orphans) and all(folder.exists() for folder in new)
    assert store.upload(stale.id) is not None and intake.scan_folder(committed.id).is_dir()

    with intake.writing(stale.id):
        janitor.sweep(store, intake, tmp_path, stale_upload_s=48 * HOUR, now=time.time() + 49 * HOUR)
        assert store.upload(stale.id) is not None  # something is still arriving
    janitor.sweep(store, intake, tmp_path, stale_upload_s=48 * HOUR, now=time.time() + 49 * HOUR)
    assert store.upload(stale.id) is None and not (tmp_path / "uploads" / stale.id).exists()
    assert store.scan(committed.id) is not None and intake.scan_folder(committed.id).is_dir()


def test_the_received_part_of_a_file_is_no_longer_reserved_and_goes_with_its_upload(
    store: Store, tmp_path: Path
) -> None:
    intake = Intake(tmp_path)
    upload = store.add_upload("half", [File("scan.json", 10, None, None), File("a.tif", 1000, None, None)])
    intake.create(upload.id)
    assert store.outstanding_bytes() == 1010

    with intake.writing(upload.id) as parts:
        part = Partial(parts, "a.tif", 1000, 0, lambda offset: store.acknowledge(upload.id, "a.tif", offset))
        part.write(bytes(600))
        assert store.outstanding_bytes() == 1010  # not yet durable
        part.acknowledge()
        assert store.outstanding_bytes() == 410
        part.clear()
        assert store.outstanding_bytes() == 1010
        part.write(bytes(300))
        part.acknowledge()
        part.close()
    assert store.outstanding_bytes() == 710
    janitor.sweep(store, intake, tmp_path, stale_upload_s=48 * HOUR, now=time.time() + 49 * HOUR)
    assert store.upload(upload.id) is None and not (tmp_path / "uploads" / upload.id).exists()
    assert store.outstanding_bytes() == 0
