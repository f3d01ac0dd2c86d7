"""What the janitor takes away, and what it must leave."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from server.intake import Intake
from server.janitor import Janitor
from server.migrations import prepare
from server.partial import Part, part_path
from server.reserve import Reserve
from server.retention import Rules, freed
from server.store import File, NewJob, Scan, Store
from worker.contract import ErrorKind
from worker.database import Database
from worker.ledger import jobs

from .stack import Stack, commit, scan_files, submit
from .test_backup import splatct

HOUR = 3600.0


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    database = Database(f"sqlite:///{tmp_path / 'test.db'}")
    prepare(database)
    (tmp_path / "jobs").mkdir()
    yield Store(database)
    database.close()


def janitor(store: Store, data: Path, **rules: float) -> Janitor:
    kept = Rules(**{"results": None, "failed": None, "scans": None, "uploads": 48 * HOUR, **rules})
    return Janitor(store, Intake(data), data, kept, Reserve(data, 0))


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

    janitor(store, tmp_path).sweep(now=time.time() + 1)
    assert not any(folder.exists() for folder in orphans) and all(folder.exists() for folder in new)
    assert store.upload(stale.id) is not None and intake.scan_folder(committed.id).is_dir()

    with intake.writing(stale.id):
        janitor(store, tmp_path).sweep(now=time.time() + 49 * HOUR)
        assert store.upload(stale.id) is not None  # something is still arriving
    janitor(store, tmp_path).sweep(now=time.time() + 49 * HOUR)
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
        part = Part(part_path(parts, "a.tif"), 1000, 0, lambda offset: store.acknowledge(upload.id, "a.tif", offset))
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
    janitor(store, tmp_path).sweep(now=time.time() + 49 * HOUR)
    assert store.upload(upload.id) is None and not (tmp_path / "uploads" / upload.id).exists()
    assert store.outstanding_bytes() == 0


DAY = 24 * HOUR


def add_scan(store: Store, data: Path, name: str, pixels: bytes = b"x" * 1000) -> Scan:
    upload = store.add_upload(name, [File("scan.json", 1000, None, "0" * 64)])
    scan = store.commit(upload, {})
    (data / "scans" / scan.id).mkdir(parents=True)
    (data / "scans" / scan.id / "scan.json").write_bytes(pixels)
    return scan


def add_job(store: Store, data: Path, scan: Scan, number: int, end: str) -> str:
    job_id = f"{end}-{number}"
    assert store.add_job(NewJob(job_id, end, {}), scan, lambda: None)
    (data / "jobs" / job_id / "results").mkdir(parents=True)
    (data / "jobs" / job_id / "results" / "volume.tif").write_bytes(b"x" * 500)
    if end == "queued":
        return job_id
    assert store.jobs.claim(job_id, 1, "here")
    if end == "failed":
        store.jobs.fail(job_id, 1, ErrorKind.BAD_INPUT, "bad")
    elif end == "succeeded":
        store.jobs.succeed(job_id, 1)
    elif end == "cancelled":
        store.jobs.ask_cancel(job_id)
        store.jobs.end_cancel(job_id, 1)
    return job_id


def test_each_class_goes_at_its_own_age_and_what_is_pinned_or_at_work_stays(store: Store, tmp_path: Path) -> None:
    scan, lonely, pinned = (add_scan(store, tmp_path, name) for name in ("used", "lonely", "pinned"))
    ends = ("succeeded", "failed", "cancelled", "running", "queued")
    made = {end: [add_job(store, tmp_path, scan, number, end) for number in range(2)] for end in ends}
    for end in ("succeeded", "failed"):
        assert store.jobs.pin(made[end][1], True)
    store.pin_scan(pinned.id, True)
    now = time.time()
    clean = janitor(store, tmp_path, results=10 * DAY, failed=5 * DAY, scans=20 * DAY)

    def goes(days: float) -> set[str]:
        listed = {one.id for one in clean.plan(now + days * DAY)}
        assert {one.id for one in clean.sweep(now + days * DAY)} == listed, "what was said is what was done"
        for one in listed:
            assert store.jobs.get(one) is None and store.scan(one) is None
            assert not (tmp_path / "jobs" / one).exists() and not (tmp_path / "scans" / one).exists()
        return listed

    assert goes(4.9) == set()
    assert goes(5.1) == {made["failed"][0], made["cancelled"][0], made["cancelled"][1]}
    assert goes(10.1) == {made["succeeded"][0]}
    assert goes(20.1) == {lonely.id}
    assert goes(1000) == set(), "pinned, at work, or the scan of a job that is kept"
    left = {job.name for job in store.jobs.page(None, 100, None)}
    assert left == {"succeeded", "failed", "running", "queued"} and store.scan(scan.id) and store.scan(pinned.id)
    store.jobs.pin(made["succeeded"][1], False)
    store.pin_scan(pinned.id, False)
    assert goes(1000) == {made["succeeded"][1], pinned.id}


def test_a_scan_is_unused_from_the_end_of_its_last_job_on(store: Store, tmp_path: Path) -> None:
    scan = add_scan(store, tmp_path, "old")
    job_id = add_job(store, tmp_path, scan, 0, "succeeded")
    clean = janitor(store, tmp_path, results=DAY, scans=DAY)
    with store.database.writing() as write:  # both are a year old
        write.execute(sa.text("UPDATE scans SET created_at = created_at - 31536000, used_at = used_at - 31536000"))
        write.execute(jobs.update().values(finished_at=jobs.c.finished_at - 365 * DAY))
    assert [one.id for one in clean.sweep(time.time())] == [job_id]
    assert clean.plan(time.time()) == [], "its owner has a day to reconstruct it again"
    assert [one.id for one in clean.plan(time.time() + 1.1 * DAY)] == [scan.id]


def test_by_default_nothing_goes_but_stale_uploads(store: Store, tmp_path: Path) -> None:
    scan = add_scan(store, tmp_path, "old")
    add_job(store, tmp_path, scan, 0, "succeeded")
    add_scan(store, tmp_path, "older")
    assert janitor(store, tmp_path).plan(time.time() + 100 * 365 * DAY) == []


def test_what_happens_after_the_list_was_made_counts(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pin, or a job, between the look and the leap."""
    scans = [add_scan(store, tmp_path, str(number)) for number in range(3)]
    job_id = add_job(store, tmp_path, add_scan(store, tmp_path, "of the job"), 0, "succeeded")
    clean, later = janitor(store, tmp_path, results=DAY, scans=DAY), time.time() + 2 * DAY
    listed = clean.plan(later)
    assert len(listed) == 4
    store.pin_scan(scans[0].id, True)
    add_job(store, tmp_path, scans[1], 1, "queued")
    store.jobs.pin(job_id, True)
    monkeypatch.setattr(clean, "plan", lambda _: listed)
    assert [one.id for one in clean.sweep(later)] == [scans[2].id]
    assert (tmp_path / "scans" / scans[1].id / "scan.json").exists() and (tmp_path / "jobs" / job_id).exists()


def test_bytes_are_those_that_come_free(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
    (tmp_path / "a" / "file").write_bytes(b"x" * 1000)
    (tmp_path / "b" / "file").hardlink_to(tmp_path / "a" / "file")
    (tmp_path / "c" / "file").write_bytes(b"x" * 10)
    assert freed([tmp_path / "a"]) == 0, "it has another name"
    assert freed([tmp_path / "a", tmp_path / "b", tmp_path / "c"]) == 1010


@pytest.mark.slow
def test_pins_and_the_command(stack: Stack) -> None:
    stack.start_worker()
    first, second = (commit(stack.http, scan_files()) for _ in range(2))
    kept, gone = submit(stack.http, first), submit(stack.http, first)
    for job in (kept, gone):
        assert stack.wait(job, "succeeded")["pinned"] is False
    assert stack.http.post(f"/v1/jobs/{kept}/pin").json()["pinned"] is True
    assert stack.http.post(f"/v1/jobs/{kept}/pin").json() == stack.job(kept), "twice is once"
    assert stack.http.post(f"/v1/scans/{second}/pin").json()["pinned"] is True
    assert stack.http.get(f"/v1/scans/{second}").json()["pinned"] is True
    size = sum(file.stat().st_size for file in (stack.data / "jobs" / gone).rglob("*") if file.is_file())

    def run(*more: str, **days: str) -> dict[str, object]:
        done = splatct("janitor", "--data", str(stack.data), "--json", *more, **days)
        assert done.returncode == 0, done.stderr
        return dict(json.loads(done.stdout))

    soon = {"SPLATCT_KEEP_RESULTS_DAYS": "0.0000001", "SPLATCT_KEEP_SCANS_DAYS": "0.0000001"}
    assert run("--dry-run") == {"dry_run": True, "bytes": 0, "items": []}
    dry = run("--dry-run", **soon)
    assert [(item["kind"], item["id"], item["bytes"]) for item in dry["items"]] == [("results", gone, size)]  # type: ignore[attr-defined]
    assert dry["bytes"] == size and stack.http.get(f"/v1/jobs/{gone}").status_code == 200, "a dry run removes nothing"
    assert run(**soon)["items"] == dry["items"]
    assert stack.http.get(f"/v1/jobs/{gone}").status_code == 404 and not (stack.data / "jobs" / gone).exists()
    assert stack.http.delete(f"/v1/jobs/{kept}/pin").json()["pinned"] is False
    assert stack.http.delete(f"/v1/scans/{second}/pin").json()["pinned"] is False
    assert {item["id"] for item in run(**soon)["items"]} >= {kept, second}  # type: ignore[attr-defined]
    audit = splatct("audit", "--data", str(stack.data), "--id", kept).stdout
    assert " pin " in audit and " unpin " in audit and " janitor " in audit and "delete-job" in audit
    readable = splatct("janitor", "--data", str(stack.data), "--dry-run").stdout
    assert readable.endswith("would go, 0 bytes\n")
