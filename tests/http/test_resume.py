"""Files sent in pieces: offsets, digests, takeover, and what a killed server still knows."""

from __future__ import annotations

import base64
import hashlib
import io
import os
import socket
import warnings
from typing import Any

import httpx
import pytest

from .stack import Stack, announce, commit, kill, scan_files

MIB = 1 << 20
CHUNK = {"Content-Type": "application/offset+octet-stream"}


@pytest.fixture
def http(shared: Stack) -> httpx.Client:
    return shared.http


def file_url(http: httpx.Client, data: bytes, name: str = "scan.json", sha256: str | None = None) -> str:
    files: list[dict[str, Any]] = [{"name": name, "size": len(data), "sha256": sha256}]
    if name != "scan.json":
        files.append({"name": "scan.json", "size": 10})
    upload = http.post("/v1/uploads", json={"name": "x", "files": files}).raise_for_status().json()
    return f"/v1/uploads/{upload['id']}/files/{name}"


def patch(http: httpx.Client, url: str, at: int, data: Any, **headers: str) -> httpx.Response:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return http.patch(url, content=data, headers=CHUNK | {"Upload-Offset": str(at)} | named)


def offset(http: httpx.Client, url: str) -> int:
    answer = http.head(url)
    assert answer.status_code == 200 and answer.headers["cache-control"] == "no-store"
    return int(answer.headers["upload-offset"])


def sha256_of(data: bytes) -> str:
    return f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"


def open_patch(stack: Stack, url: str, at: int, announced: int, data: bytes, *more: str) -> socket.socket:
    """A PATCH that has sent only `data` of what it announced."""
    head = [f"PATCH {url} HTTP/1.1", f"Host: 127.0.0.1:{stack.port}", f"Content-Length: {announced}"]
    head += ["Content-Type: application/offset+octet-stream", f"Upload-Offset: {at}", *more]
    connection = socket.create_connection(("127.0.0.1", stack.port), timeout=20)
    connection.sendall("\r\n".join(head).encode() + b"\r\n\r\n" + data)
    return connection


def test_a_scan_sent_in_pieces_is_committed(http: httpx.Client) -> None:
    files = scan_files()
    upload = announce(http, files)
    for name, data in files.items():
        url = f"/v1/uploads/{upload['id']}/files/{name}"
        assert offset(http, url) == 0
        for start in range(0, len(data), 1000):
            answer = patch(http, url, start, data[start : start + 1000], Tus_Resumable="1.0.0")
            assert answer.status_code == 204 and answer.headers["tus-resumable"] == "1.0.0"
            assert int(answer.headers["upload-offset"]) == min(start + 1000, len(data))
        assert answer.headers["repr-digest"] == sha256_of(data)
        assert http.head(url).headers["upload-length"] == str(len(data))
    assert http.post(f"/v1/uploads/{upload['id']}/commit").status_code == 201
    assert offset(http, url) == len(data)
    late = patch(http, url, len(data), b"")
    assert late.status_code == 409 and late.json()["type"].endswith(":committed")


def test_a_wrong_offset_is_refused_with_the_right_one(http: httpx.Client) -> None:
    url = file_url(http, b"x" * 100)
    assert patch(http, url, 0, b"x" * 40).status_code == 204
    for wrong in (0, 39, 41, 100, 10**18):
        answer = patch(http, url, wrong, b"y" * 10)
        assert answer.status_code == 409 and answer.headers["upload-offset"] == "40"
        assert answer.json()["type"] == "urn:splatct:problem:offset-mismatch"
        assert "40" in answer.json()["errors"][0]["hint"]
    assert patch(http, url, 40, b"x" * 61).status_code == 422
    assert patch(http, url, 40, iter([b"x" * 50, b"x" * 11])).status_code == 422  # no length to judge by beforehand
    assert offset(http, url) == 40
    upload = http.get(url.split("/files/")[0]).json()
    assert (upload["files"][0]["received"], upload["files"][0]["complete"]) == (40, False)


@pytest.mark.parametrize(
    ("header", "status"),
    [
        ({"Content-Digest": sha256_of(b"other")}, 400),
        ({"Upload-Checksum": "sha1 " + base64.b64encode(hashlib.sha1(b"other").digest()).decode()}, 460),
        ({"Content-Digest": "sha-256=nonsense"}, 400),
        ({"Upload-Checksum": "crc32 AAAA"}, 400),
        ({"Content-Digest": "sha-256=:AAAA:"}, 400),
    ],
)
def test_a_damaged_chunk_is_dropped(http: httpx.Client, header: dict[str, str], status: int) -> None:
    url = file_url(http, b"abcdef")
    assert patch(http, url, 0, b"abc", **{"Content-Digest": sha256_of(b"abc")}).status_code == 204
    answer = patch(http, url, 3, b"dex", **header)
    assert answer.status_code == status and answer.headers["content-type"] == "application/problem+json"
    assert offset(http, url) == 3
    assert patch(http, url, 3, b"def").headers["repr-digest"] == sha256_of(b"abcdef")


def test_a_whole_file_of_the_wrong_digest_starts_again(http: httpx.Client) -> None:
    data = b"x" * 3000
    url = file_url(http, data, sha256=hashlib.sha256(data).hexdigest())
    assert patch(http, url, 0, b"y" * 1000).status_code == 204
    answer = patch(http, url, 1000, data[1000:])
    assert answer.status_code == 422 and "sha256" in answer.text
    assert offset(http, url) == 0
    assert patch(http, url, 0, data).status_code == 204


def test_put_replaces_what_came_in_pieces(http: httpx.Client, shared: Stack) -> None:
    url = file_url(http, b"x" * 100)
    patch(http, url, 0, b"y" * 40)
    assert http.put(url, content=b"x" * 100).json()["sha256"] == hashlib.sha256(b"x" * 100).hexdigest()
    assert offset(http, url) == 100
    assert patch(http, url, 40, b"y" * 60).status_code == 409
    assert not list((shared.data / "uploads" / url.split("/")[3] / "parts").iterdir())


def test_names_in_other_scripts_and_requests_that_are_not_chunks(http: httpx.Client) -> None:
    url = file_url(http, b"abc", name="Schädel_頭蓋骨 1.tif")
    assert patch(http, url, 0, b"ab").status_code == 204 and offset(http, url) == 2
    assert patch(http, url + "x", 0, b"ab").status_code == 404 and http.head(url + "x").status_code == 404
    assert http.patch(url, content=b"c", headers={"Upload-Offset": "2"}).status_code == 415
    assert http.patch(url, content=b"c", headers=CHUNK).status_code == 400
    assert patch(http, url, 2, b"c", Tus_Resumable="0.2.2").status_code == 412
    offered = http.options(url)
    assert offered.status_code == 204 and offered.headers["tus-version"] == "1.0.0"
    assert "checksum" in offered.headers["tus-extension"]
    assert patch(http, url, 2, b"c").headers["repr-digest"] == sha256_of(b"abc")


def test_a_cut_chunk_keeps_its_bytes_only_without_a_digest(http: httpx.Client, shared: Stack) -> None:
    data = os.urandom(3 * MIB)
    for header in ((), (f"Content-Digest: {sha256_of(data)}",)):
        url = file_url(http, data)
        part = shared.data / "uploads" / url.split("/")[3] / "parts"
        connection = open_patch(shared, url, 0, len(data), data[: 2 * MIB], *header)
        shared.until(lambda at=part: sum(f.stat().st_size for f in at.iterdir()) >= MIB, what="bytes on disk")
        connection.close()
        kept = offset(http, url)
        assert kept == 0 if header else MIB <= kept <= 2 * MIB
        assert patch(http, url, kept, data[kept:]).headers["repr-digest"] == sha256_of(data)


def test_a_newer_request_takes_over_from_a_stalled_one(http: httpx.Client, shared: Stack) -> None:
    data = os.urandom(3 * MIB)
    url = file_url(http, data)
    part = shared.data / "uploads" / url.split("/")[3] / "parts"
    with open_patch(shared, url, 0, len(data), data[:MIB]) as stalled:
        shared.until(lambda: sum(f.stat().st_size for f in part.iterdir()) == MIB, what="bytes on disk")
        assert offset(http, url) == MIB
        answered = stalled.recv(1 << 16)
        assert b" 409 " in answered.split(b"\r\n")[0] and b"taken-over" in answered
        assert patch(http, url, MIB, data[MIB:]).headers["repr-digest"] == sha256_of(data)


def test_a_tus_client_that_is_given_the_url_resumes(http: httpx.Client, shared: Stack) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it imports is not ours to judge
        from tusclient.client import TusClient
    data = os.urandom(300_000)
    url = file_url(http, data)
    address = f"http://127.0.0.1:{shared.port}{url}"
    tus = TusClient(address)

    def uploader() -> Any:
        return tus.uploader(file_stream=io.BytesIO(data), url=address, chunk_size=100_000, upload_checksum=True)

    first = uploader()
    first.upload_chunk()
    assert first.offset == offset(http, url) == 100_000
    again = uploader()
    assert again.offset == 100_000
    again.upload()
    assert http.head(url).headers["repr-digest"] == sha256_of(data)


@pytest.mark.slow
def test_a_killed_server_knows_what_it_acknowledged(stack: Stack) -> None:
    data = os.urandom(40 * MIB)
    url = file_url(stack.http, data)
    assert patch(stack.http, url, 0, data[:1000]).status_code == 204
    part = stack.data / "uploads" / url.split("/")[3] / "parts"
    for header in ((), (f"Content-Digest: {sha256_of(data[1000:])}",)):
        at = offset(stack.http, url)
        with open_patch(stack, url, at, len(data) - at, data[at : at + 18 * MIB], *header):
            wanted = at + 17 * MIB
            stack.until(lambda n=wanted: next(part.iterdir()).stat().st_size >= n, what="bytes on disk")
            kill(stack.server)
        stack.server = stack.start_server()
        stands = offset(stack.http, url)
        assert stands == at if header else stands >= at + 16 * MIB
        on_disk = next(part.iterdir()).read_bytes()
        assert len(on_disk) == stands and on_disk == data[:stands]
    assert patch(stack.http, url, stands, data[stands:]).headers["repr-digest"] == sha256_of(data)


def test_a_committed_scan_is_not_written_to(http: httpx.Client, shared: Stack) -> None:
    files = scan_files()
    scan_id = commit(http, files)
    url = f"/v1/uploads/{scan_id}/files/scan.json"
    assert patch(http, url, 0, files["scan.json"]).status_code == 409
    assert (shared.data / "scans" / scan_id / "scan.json").read_bytes() == files["scan.json"]
