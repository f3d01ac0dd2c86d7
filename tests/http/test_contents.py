"""Bytes that a tenant has already are not sent again, and nobody learns what others have."""

from __future__ import annotations

import errno
import hashlib
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import pytest

from server.contents import find
from server.intake import Intake
from server.store import File, Store
from worker.database import Database

from .stack import Stack, commit, scan_files, submit


def announcement(files: dict[str, bytes]) -> dict[str, Any]:
    listed = [{"name": n, "size": len(d), "sha256": hashlib.sha256(d).hexdigest()} for n, d in files.items()]
    return {"name": "again", "files": listed}


def complete(upload: dict[str, Any]) -> dict[str, bool]:
    return {file["name"]: file["complete"] for file in upload["files"]}


@pytest.fixture
def tenant(keyed: Stack) -> Iterator[httpx.Client]:
    with keyed.client(keyed.new_key(f"t-{uuid4().hex[:8]}", "admin")[1]) as http:
        yield http


def unique() -> dict[str, bytes]:
    """A scan whose every file is new to the server: its name differs, and its TIFF has a tail of its own."""
    files = scan_files(tag=uuid4().hex)
    return {**files, "projections.tif": files["projections.tif"] + uuid4().bytes}


def test_a_file_that_is_there_is_complete_at_once(keyed: Stack, tenant: httpx.Client) -> None:
    files = unique()
    first = commit(tenant, files)
    changed = {**files, "scan.json": files["scan.json"] + b"\n"}
    upload = tenant.post("/v1/uploads", json=announcement(changed)).json()
    assert complete(upload) == {"scan.json": False, "projections.tif": True}
    url = f"/v1/uploads/{upload['id']}"
    assert tenant.get(url).json()["files"] == upload["files"]
    head = tenant.head(f"{url}/files/projections.tif").headers
    assert head["upload-offset"] == str(len(files["projections.tif"])) and "repr-digest" in head
    assert tenant.post(f"{url}/commit").status_code == 409, "the other file is still missing"
    tenant.put(f"{url}/files/scan.json", content=changed["scan.json"]).raise_for_status()
    second = tenant.post(f"{url}/commit").json()["id"]
    inodes = {(keyed.data / "scans" / scan / "projections.tif").stat().st_ino for scan in (first, second)}
    assert len(inodes) == 1, "one file under two names"
    assert tenant.delete(f"/v1/scans/{first}").status_code == 204
    job = submit(tenant, second)
    keyed.until(lambda: tenant.get(f"/v1/jobs/{job}").json()["state"] == "succeeded", what="the other scan is whole")


def test_a_new_file_of_the_name_does_not_change_the_old_one(keyed: Stack, tenant: httpx.Client) -> None:
    files = unique()
    scan = commit(tenant, files)
    body = announcement(files)
    upload = tenant.post("/v1/uploads", json=body).json()
    assert all(complete(upload).values())
    url = f"/v1/uploads/{upload['id']}/files/projections.tif"
    other = bytes(len(files["projections.tif"]))
    assert tenant.put(url, content=other).status_code == 422, "the digest was announced"
    assert tenant.put(url, content=files["projections.tif"]).status_code == 200
    stored = keyed.data / "scans" / scan / "projections.tif"
    assert stored.read_bytes() == files["projections.tif"] and stored.stat().st_nlink == 1


def test_only_digest_and_size_together_count(tenant: httpx.Client) -> None:
    files = unique()
    commit(tenant, files)
    body = announcement(files)
    body["files"][1]["size"] += 1
    assert complete(tenant.post("/v1/uploads", json=body).json()) == {"scan.json": True, "projections.tif": False}
    for file in body["files"]:
        file["sha256"] = None
    assert not any(complete(tenant.post("/v1/uploads", json=body).json()).values())
    body = announcement(files)
    body["files"][1] |= {"name": "other.tif", "sha256": body["files"][1]["sha256"].upper()}
    assert all(complete(tenant.post("/v1/uploads", json=body).json()).values()), "under any name"


def test_open_uploads_and_deleted_scans_give_nothing(tenant: httpx.Client) -> None:
    files = unique()
    upload = tenant.post("/v1/uploads", json=announcement(files)).json()
    for name, data in files.items():
        tenant.put(f"/v1/uploads/{upload['id']}/files/{name}", content=data).raise_for_status()
    assert not any(complete(tenant.post("/v1/uploads", json=announcement(files)).json()).values())
    scan = tenant.post(f"/v1/uploads/{upload['id']}/commit").json()["id"]
    assert all(complete(tenant.post("/v1/uploads", json=announcement(files)).json()).values())
    tenant.delete(f"/v1/scans/{scan}")
    assert not any(complete(tenant.post("/v1/uploads", json=announcement(files)).json()).values())


def test_what_another_tenant_has_is_answered_like_what_nobody_has(keyed: Stack, tenant: httpx.Client) -> None:
    theirs, nobodys = unique(), unique()
    commit(keyed.http, theirs)
    taken: dict[str, list[float]] = {"theirs": [], "nobody's": []}
    for _ in range(15):
        for whose, files in (("theirs", theirs), ("nobody's", nobodys)):
            started = time.perf_counter()
            answer = tenant.post("/v1/uploads", json=announcement(files))
            taken[whose].append(time.perf_counter() - started)
            assert answer.status_code == 201 and not any(complete(answer.json()).values())
            assert [file["received"] for file in answer.json()["files"]] == [0, 0]
    medians = [statistics.median(times) for times in taken.values()]
    assert max(medians) < 3 * min(medians) + 0.02, f"told apart by the clock: {taken}"


def test_the_look_needs_a_tenant() -> None:
    database = Database("sqlite://")
    with pytest.raises(AssertionError, match="no other's to find"):
        find(Store(database), [File("a", 1, "0" * 64, None)])
    database.close()


def test_where_there_are_no_links_it_is_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    intake = Intake(tmp_path)
    (tmp_path / "scans" / "old").mkdir()
    source = tmp_path / "scans" / "old" / "a.tif"
    source.write_bytes(b"pixels")

    def refuse(_self: Path, _target: Path) -> None:
        raise OSError(errno.EMLINK, "Too many links")

    intake.create("new")
    monkeypatch.setattr(Path, "hardlink_to", refuse)
    intake.adopt("new", "b.tif", "old", "a.tif")
    copy = intake.settled("new", "b.tif")
    assert copy.read_bytes() == b"pixels" and copy.stat().st_ino != source.stat().st_ino
    with pytest.raises(FileNotFoundError):
        intake.adopt("new", "c.tif", "gone", "a.tif")


def test_what_is_there_takes_no_room_on_the_disk_but_counts_for_the_quota(tmp_path: Path) -> None:
    files = unique()
    size = sum(map(len, files.values()))
    stack = Stack(tmp_path)
    stack.environment["SPLATCT_TENANT_GIB"] = str(2.5 * size / (1 << 30))
    with stack:
        commit(stack.http, files)
        upload = stack.http.post("/v1/uploads", json=announcement(files))
        assert all(complete(upload.json()).values())
        assert stack.http.get("/v1/usage").json()["bytes"]["used"] == 2 * size
        assert stack.http.post("/v1/uploads", json=announcement(files)).status_code == 507
