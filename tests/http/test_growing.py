"""A scan that is sent while the scanner still turns: its views are announced and sent one by one."""

from __future__ import annotations

import hashlib
import io
import json
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import uuid4

import httpx
import numpy as np
import pytest
import tifffile

from .stack import SCAN, Stack, announce, scan_files


@pytest.fixture
def http(shared: Stack) -> httpx.Client:
    return shared.http


def grow(http: httpx.Client) -> str:
    answer = http.post("/v1/uploads", json={"name": "turning", "files": [], "growing": True})
    assert answer.status_code == 201, answer.text
    return f"/v1/uploads/{answer.json()['id']}"


def add(http: httpx.Client, url: str, *files: dict[str, Any]) -> httpx.Response:
    return http.post(f"{url}/files", json={"files": list(files)})


def view(number: int) -> bytes:
    r, c = np.mgrid[:16, :16] - 7.5
    file = io.BytesIO()
    tifffile.imwrite(file, np.maximum(0, 1 - (r**2 + c**2) / (30 + number)).astype("float32"), photometric="minisblack")
    return file.getvalue()


def test_views_that_come_one_by_one_become_a_scan(http: httpx.Client) -> None:
    url = grow(http)
    names = [f"view-{number:03}.tif" for number in range(12)]
    for number, name in enumerate(names):
        data = view(number)
        told = add(http, url, {"name": name, "size": len(data), "sha256": hashlib.sha256(data).hexdigest()})
        assert told.status_code == 201
        expected = {"name": name, "size": len(data), "received": 0, "complete": False, "sha256": None}
        assert told.json() == {"files": [expected]}, "of what was announced now, and nothing else"
        http.put(f"{url}/files/{name}", content=data).raise_for_status()
    early = http.post(f"{url}/commit")
    assert early.status_code == 409 and [e["where"] for e in early.json()["errors"]] == ["scan.json"]
    scan = {**SCAN, "projections": {**SCAN["projections"], "files": names}}
    text = json.dumps(scan).encode()
    add(http, url, {"name": "scan.json", "size": len(text)}).raise_for_status()
    http.put(f"{url}/files/scan.json", content=text).raise_for_status()
    assert [file["name"] for file in http.get(url).json()["files"]] == [*names, "scan.json"], "as they were announced"
    done = http.post(f"{url}/commit")
    assert done.status_code == 201 and done.json()["facts"]["views"] == 12
    assert add(http, url, {"name": "late.tif", "size": 1}).status_code == 409


def test_an_announcement_may_be_repeated_and_not_changed(http: httpx.Client) -> None:
    url = grow(http)
    first = {"name": "a.tif", "size": 100, "sha256": "ab" * 32}
    assert add(http, url, first).json() == add(http, url, first, {"name": "b.tif", "size": 5}).json() | {
        "files": [{"name": "a.tif", "size": 100, "received": 0, "complete": False, "sha256": None}]
    }
    for changed in ({**first, "size": 101}, {**first, "sha256": None}, {**first, "name": "A.TIF"}):
        answer = add(http, url, {"name": "c.tif", "size": 5}, changed)
        assert answer.status_code == 409 and answer.json()["type"].endswith(":announced")
        assert answer.json()["errors"][0]["where"] == "files/1"
    assert [file["name"] for file in http.get(url).json()["files"]] == ["a.tif", "b.tif"], "all or nothing"


@pytest.mark.parametrize(
    "files",
    [[], [{"name": "../a.tif", "size": 1}], [{"name": "a.tif", "size": 0}], [{"name": "a", "size": 1, "more": 1}],
     [{"name": "a.tif", "size": 1}, {"name": "A.tif", "size": 1}]],
)  # fmt: skip
def test_what_cannot_be_announced_at_first_cannot_be_added(http: httpx.Client, files: list[dict[str, Any]]) -> None:
    url = grow(http)
    assert add(http, url, *files).status_code == 422
    assert http.get(url).json()["files"] == []


def test_only_a_growing_upload_begins_with_nothing(http: httpx.Client) -> None:
    empty = http.post("/v1/uploads", json={"name": "x", "files": []})
    assert empty.status_code == 422 and "growing" in empty.text
    unknown = add(http, f"/v1/uploads/{uuid4()}", {"name": "a.tif", "size": 1})
    assert (unknown.status_code, unknown.json()["status"]) == (404, 404)


def test_files_added_at_once_all_count_once(http: httpx.Client) -> None:
    url = f"/v1/uploads/{announce(http, scan_files())['id']}"  # any open upload may have more
    files = [{"name": f"{number % 8}.tif", "size": 10} for number in range(24)]
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda file: add(http, url, file).status_code, files))
    assert answers == [201] * 24
    names = [file["name"] for file in http.get(url).json()["files"]]
    assert len(names) == 10 and set(names) == {"scan.json", "projections.tif", *(f"{n}.tif" for n in range(8))}


def test_what_is_added_needs_room_on_the_disk(http: httpx.Client) -> None:
    url = grow(http)
    huge = add(http, url, {"name": "a.tif", "size": 1 << 50})
    assert huge.status_code == 507 and huge.json()["type"].endswith(":no-room")
    assert http.get(url).json()["files"] == []


def test_the_quota_counts_what_is_added(tmp_path: Any) -> None:
    stack = Stack(tmp_path)
    stack.environment["SPLATCT_TENANT_GIB"] = str(1000 / (1 << 30))
    with stack:
        url = grow(stack.http)
        assert add(stack.http, url, {"name": "a.tif", "size": 600}).status_code == 201
        full = add(stack.http, url, {"name": "b.tif", "size": 600})
        assert full.status_code == 507 and full.json()["type"].endswith(":quota-exceeded")
        assert add(stack.http, url, {"name": "a.tif", "size": 600}).status_code == 201, "a repetition takes nothing"
        assert stack.http.get("/v1/usage").json()["bytes"]["used"] == 600
