"""Taking scans in: what is refused, how it is said, and that it is said at once."""

from __future__ import annotations

import hashlib
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import uuid4

import httpx
import numpy as np
import pytest

from .stack import Stack, announce, commit, scan_files, send, submit


@pytest.fixture
def http(shared: Stack) -> httpx.Client:
    return shared.http


def problems(answer: httpx.Response) -> str:
    assert answer.headers["content-type"] == "application/problem+json"
    body = answer.json()
    assert body["status"] == answer.status_code and body["type"].startswith("urn:splatct:problem:")
    return " | ".join(f"{e['where']}: {e['what']}" for e in body.get("errors", []))


def test_a_good_scan_is_committed_with_its_facts(http: httpx.Client) -> None:
    files = scan_files()
    upload = announce(http, files)
    assert upload["state"] == "open" and not any(f["complete"] for f in upload["files"])
    url = f"/v1/uploads/{upload['id']}"
    early = http.post(f"{url}/commit")
    assert early.status_code == 409 and "projections.tif: is missing" in problems(early)
    for name, data in files.items():
        sent = http.put(f"{url}/files/{name}", content=data).json()
        assert sent == {
            "name": name,
            "size": len(data),
            "received": len(data),
            "complete": True,
            "sha256": hashlib.sha256(data).hexdigest(),
        }
    assert all(f["complete"] for f in http.get(url).json()["files"])
    first = http.post(f"{url}/commit")
    assert first.status_code == 201 and first.json()["facts"]["views"] == 12
    assert http.get(first.headers["location"]).json() == first.json()
    again = http.post(f"{url}/commit")
    assert (again.status_code, again.json()) == (201, first.json())
    assert http.get(url).json()["state"] == "committed"
    assert http.put(f"{url}/files/scan.json", content=files["scan.json"]).status_code == 409
    assert http.delete(url).status_code == 409
    assert first.json()["id"] in [scan["id"] for scan in http.get("/v1/scans").json()["scans"]]


def _without(key: str) -> Callable[[dict[str, Any]], None]:
    return lambda scan: scan["geometry"].pop(key)


def _nan() -> np.ndarray:
    pixels = np.ones((12, 16, 16), "float32")
    pixels[7, 3, 4] = np.nan
    return pixels


BAD: dict[str, tuple[dict[str, bytes], str]] = {
    "truncated TIFF": (
        {**(good := scan_files()), "projections.tif": good["projections.tif"][:-5000]},
        "projections.tif",
    ),
    "not a TIFF": ({**good, "projections.tif": b"PK\x03\x04 something else"}, "projections.tif"),
    "wrong view count": (scan_files(pixels=np.ones((11, 16, 16), "float32")), "11"),
    "not a number": (scan_files(pixels=_nan()), "projections.tif"),
    "missing key": (scan_files(_without("dso_mm")), "/geometry/dso_mm"),
    "not JSON": ({**good, "scan.json": b"{"}, "scan.json"),
    "a file that was not sent": (scan_files(lambda s: s["projections"].update(files=["other.tif"])), "other.tif"),
    "a file elsewhere": (scan_files(lambda s: s["projections"].update(files=["/etc/hostname"])), "files"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_scan_is_refused_at_once_naming_the_culprit(http: httpx.Client, what: str) -> None:
    files, culprit = BAD[what]
    upload_id = send(http, files)
    fastest = float("inf")
    for _ in range(3):  # the machine may be busy with something else; the best of three is ours
        started = time.perf_counter()
        answer = http.post(f"/v1/uploads/{upload_id}/commit")
        fastest = min(fastest, time.perf_counter() - started)
        if fastest < 1.0:
            break
    assert answer.status_code == 422 and culprit in problems(answer), answer.text
    assert fastest < 1.0
    assert http.get(f"/v1/uploads/{upload_id}").json()["state"] == "open"


def test_a_bad_file_can_be_sent_again(http: httpx.Client) -> None:
    files = scan_files()
    torn = {**files, "projections.tif": bytes(len(files["projections.tif"]))}
    upload_id = send(http, torn)
    assert http.post(f"/v1/uploads/{upload_id}/commit").status_code == 422
    http.put(f"/v1/uploads/{upload_id}/files/projections.tif", content=files["projections.tif"]).raise_for_status()
    assert http.post(f"/v1/uploads/{upload_id}/commit").status_code == 201


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("../scan.tif", "holds one of"),
        ("/etc/passwd", "holds one of"),
        ("a\\b.tif", "holds one of"),
        ("C:x.tif", "holds one of"),
        ("..", "folder"),
        ("a\u0000.tif", "control"),
        ("a\u202egnp.tif", "control"),
        ("e\u0301.tif", "normal form"),
        ("NUL.tif", "device"),
        ("com1", "device"),
        ("COM¹.tif", "device"),
        ("CONIN$", "device"),
        (".lock", "dot"),
        ("a.tif.", "dot"),
        ("é" * 128, "255 bytes"),
        ("SCAN.JSON", "taken"),
    ],
)
def test_hostile_names_are_refused(http: httpx.Client, name: str, words: str) -> None:
    listed = [{"name": "scan.json", "size": 10}, {"name": name, "size": 10}]
    answer = http.post("/v1/uploads", json={"name": "x", "files": listed})
    assert answer.status_code == 422 and words in problems(answer)
    assert name not in answer.text or len(name) < 3


@pytest.mark.parametrize(
    "body",
    [
        {"name": "x", "files": [{"name": "a.tif", "size": 1}]},
        {"name": "x", "files": []},
        {"name": "x", "files": [{"name": "scan.json", "size": 0}]},
        {"name": "x", "files": [{"name": "scan.json", "size": -1}]},
        {"name": "x", "files": [{"name": "scan.json", "size": 1, "sha256": "abc"}]},
        {"name": "x", "files": [{"name": "scan.json", "size": 1, "more": 1}]},
        {"name": "", "files": [{"name": "scan.json", "size": 1}]},
        {"files": [{"name": "scan.json", "size": 1}]},
    ],
)
def test_bad_announcements_are_refused(http: httpx.Client, body: dict[str, Any]) -> None:
    answer = http.post("/v1/uploads", json=body)
    assert answer.status_code == 422 and problems(answer)


def test_sizes_and_digests_are_held_to(http: httpx.Client, shared: Stack) -> None:
    data = b"x" * 3000
    files = [{"name": "scan.json", "size": 3000, "sha256": hashlib.sha256(data).hexdigest()}]
    upload_id = http.post("/v1/uploads", json={"name": "x", "files": files}).json()["id"]
    url = f"/v1/uploads/{upload_id}/files/scan.json"
    wrong = [
        http.put(url, content=data[:-1]),
        http.put(url, content=data + b"x"),
        http.put(url, content=iter([data, b"x"])),  # chunked: the size is not known beforehand
        http.put(url, content=iter([data[:-1]])),
        http.put(url, content=b"y" * 3000),
    ]
    assert [answer.status_code for answer in wrong] == [422] * 5
    assert "sha256" in wrong[-1].text
    assert http.get(f"/v1/uploads/{upload_id}").json()["files"][0]["complete"] is False
    assert not list((shared.data / "uploads" / upload_id / "parts").iterdir())
    assert http.put(url, content=data).status_code == 200


def test_a_connection_cut_mid_way_leaves_nothing_behind(http: httpx.Client, shared: Stack) -> None:
    upload_id = announce(http, {"scan.json": b"x" * 100_000})["id"]
    folder = shared.data / "uploads" / upload_id / "parts"

    def body() -> Any:
        yield b"x" * 50_000
        shared.until(lambda: bool(list(folder.iterdir())), what="the file is being written")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        http.put(f"/v1/uploads/{upload_id}/files/scan.json", content=body(), headers={"Content-Length": "100000"})
    shared.until(lambda: not list(folder.iterdir()), what="the part is removed")
    assert http.get(f"/v1/uploads/{upload_id}").json()["files"][0]["received"] == 0


def test_unannounced_files_and_unknown_uploads(http: httpx.Client) -> None:
    upload_id = announce(http, scan_files())["id"]
    assert http.put(f"/v1/uploads/{upload_id}/files/other.tif", content=b"x").status_code == 404
    assert http.put(f"/v1/uploads/{uuid4()}/files/scan.json", content=b"x").status_code == 404
    assert http.post(f"/v1/uploads/{uuid4()}/commit").status_code == 404


def test_giving_up_an_upload(http: httpx.Client, shared: Stack) -> None:
    upload_id = send(http, scan_files())
    assert http.delete(f"/v1/uploads/{upload_id}").status_code == 204
    assert http.get(f"/v1/uploads/{upload_id}").status_code == 404
    assert not (shared.data / "uploads" / upload_id).exists()


def test_more_than_the_disk_holds_is_refused_before_it_is_sent(http: httpx.Client) -> None:
    files = [{"name": "scan.json", "size": 1 << 50}]
    answer = http.post("/v1/uploads", json={"name": "x", "files": files})
    assert answer.status_code == 507 and answer.json()["type"] == "urn:splatct:problem:no-room"


def test_a_scan_is_kept_while_a_job_needs_it(stack: Stack) -> None:
    scan_id = commit(stack.http, scan_files())
    job_id = submit(stack.http, scan_id)  # no worker: it stays queued
    answer = stack.http.delete(f"/v1/scans/{scan_id}")
    assert answer.status_code == 409
    stack.http.post(f"/v1/jobs/{job_id}/cancel")
    assert stack.http.delete(f"/v1/scans/{scan_id}").status_code == 204
    answer = stack.http.post("/v1/jobs", json={"scan_id": scan_id})
    assert answer.status_code == 422


def test_commits_at_the_same_time_give_one_scan(http: httpx.Client, shared: Stack) -> None:
    upload_id = send(http, scan_files())

    def commit_once(_: int) -> httpx.Response:
        return httpx.post(f"{http.base_url}/v1/uploads/{upload_id}/commit", trust_env=False, timeout=30)

    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(commit_once, range(4)))
    assert [answer.status_code for answer in answers] == [201] * 4
    assert len({answer.text for answer in answers}) == 1
    listed = [scan["id"] for scan in http.get("/v1/scans").json()["scans"]]
    assert listed.count(upload_id) == 1


def test_an_upload_under_an_id_of_the_client_s_own_is_made_once(stack: Stack) -> None:
    http, url = stack.http, f"/v1/uploads/{uuid4()}"
    body = {"name": "x", "files": [{"name": "scan.json", "size": 3}, {"name": "a.tif", "size": 5, "sha256": "A" * 64}]}
    made = http.put(url, json=body)
    assert (made.status_code, made.headers["location"], made.json()["state"]) == (201, url, "open")
    assert "idempotency-replayed" not in made.headers
    http.put(f"{url}/files/scan.json", content=b"abc").raise_for_status()
    http.post(f"{url}/files", json={"files": [{"name": "more.tif", "size": 1}]}).raise_for_status()
    again = http.put(url, json=body)
    assert (again.status_code, again.headers["idempotency-replayed"]) == (201, "true")
    assert [file["received"] for file in again.json()["files"]] == [3, 0, 0], "as it is now"
    for other in (body | {"name": "y"}, body | {"files": body["files"][::-1]}, body | {"files": body["files"] * 2}):
        refused = http.put(url, json=other)
        assert refused.status_code in (409, 422) and http.get(url).json() == again.json()
    assert http.put(url, json=body | {"name": "y"}).json()["type"] == "urn:splatct:problem:upload-exists"
    assert http.get("/v1/usage").json()["open_uploads"]["used"] == 1
    assert http.put("/v1/uploads/nonsense", json=body).status_code == 422
    http.delete(url).raise_for_status()
    assert "idempotency-replayed" not in http.put(url, json=body).headers, "what was given up can begin anew"


def test_many_requests_at_once_make_one_upload(stack: Stack) -> None:
    url, body = f"/v1/uploads/{uuid4()}", {"name": "x", "files": [{"name": "scan.json", "size": 3}]}
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: stack.http.put(url, json=body), range(16)))
    assert {answer.status_code for answer in answers} == {201}
    assert sum("idempotency-replayed" not in answer.headers for answer in answers) == 1
    assert len(list((stack.data / "uploads").iterdir())) == 1
    stack.http.put(f"{url}/files/scan.json", content=b"abc").raise_for_status()


def test_a_server_that_died_before_it_made_the_folder_makes_it_when_asked_again(stack: Stack) -> None:
    upload_id, body = str(uuid4()), {"name": "x", "files": [{"name": "scan.json", "size": 3}]}
    stack.http.put(f"/v1/uploads/{upload_id}", json=body).raise_for_status()
    shutil.rmtree(stack.data / "uploads" / upload_id)
    stack.http.put(f"/v1/uploads/{upload_id}", json=body).raise_for_status()
    stack.http.put(f"/v1/uploads/{upload_id}/files/scan.json", content=b"abc").raise_for_status()


def test_a_committed_upload_asked_for_again_is_the_committed_one(stack: Stack) -> None:
    files = scan_files()
    body = {"name": "x", "files": [{"name": name, "size": len(data)} for name, data in files.items()]}
    upload_id = str(uuid4())
    stack.http.put(f"/v1/uploads/{upload_id}", json=body).raise_for_status()
    for name, data in files.items():
        stack.http.put(f"/v1/uploads/{upload_id}/files/{name}", content=data).raise_for_status()
    stack.http.post(f"/v1/uploads/{upload_id}/commit").raise_for_status()
    again = stack.http.put(f"/v1/uploads/{upload_id}", json=body).raise_for_status().json()
    assert (again["state"], again["scan_id"]) == ("committed", upload_id)
    assert not list((stack.data / "uploads").iterdir())
