"""Text that databases choke on: NUL, halves of surrogate pairs. On either database it is the caller's fault, told
clearly, or harmless; never a failure of the server."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any
from uuid import uuid4

import httpx
import pytest

from server.audit import AuditLog, Wanted
from worker.database import Database

from ..postgres import running_postgres
from .stack import Stack, announce, commit, scan_files

BAD = {"nul": r"a\u0000b", "high": r"a\ud800b", "low": r"a\udfffb"}
JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.system)])
def either(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    with ExitStack() as open_things:
        stack = Stack(tmp_path_factory.mktemp(request.param))
        if request.param == "postgresql":
            stack.environment["SPLATCT_DATABASE_URL"] = open_things.enter_context(running_postgres())
        yield open_things.enter_context(stack)


@pytest.fixture(scope="module")
def scan_id(either: Stack) -> str:
    return commit(either.http, scan_files())


def refused(answer: httpx.Response, where: str) -> None:
    assert answer.status_code in (400, 422), answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert where in {error["where"] for error in answer.json()["errors"]}


@pytest.mark.parametrize("text", list(BAD.values()), ids=list(BAD))
def test_names_in_bodies(either: Stack, scan_id: str, text: str) -> None:
    file = '{"name": "scan.json", "size": 1}'
    for path, body, where in (
        ("/v1/uploads", f'{{"name": "{text}", "files": [{file}]}}', "body/name"),
        ("/v1/uploads", f'{{"name": "s", "files": [{file}, {{"name": "{text}", "size": 1}}]}}', "files/1/name"),
        ("/v1/jobs", f'{{"scan_id": "{scan_id}", "name": "{text}"}}', "body/name"),
        ("/v1/jobs", f'{{"scan_id": "{scan_id}", "options": {{"calibrate": "{text}"}}}}', "options"),
        ("/v1/jobs", f'{{"scan_id": "{scan_id}", "options": {{"{text}": 1}}}}', "options"),
        ("/v1/jobs/validate", f'{{"scan_id": "{scan_id}", "options": {{"{text}": 1}}}}', "options"),
        ("/v1/webhooks", f'{{"url": "http://a.example/{text}"}}', "url"),
    ):
        answer = either.http.post(path, content=body, headers=JSON)
        assert answer.status_code in (400, 422), (body, answer.text)
        named = {error["where"] for error in answer.json()["errors"]}
        assert any(where in name or name in f"body/{where}" for name in named), (body, named)


@pytest.mark.parametrize("text", list(BAD.values()), ids=list(BAD))
def test_a_folder_to_import(either: Stack, text: str) -> None:
    answer = either.http.post("/v1/imports", content=f'{{"folder": "{text}"}}', headers=JSON)
    assert answer.status_code in (404, 422), answer.text


@pytest.mark.parametrize("text", list(BAD.values()), ids=list(BAD))
def test_a_name_inside_scan_json(either: Stack, text: str) -> None:
    """It is never a column's; what the check says of it is."""

    def named(scan: dict[str, Any]) -> None:
        scan["name"] = json.loads(f'"{text}"')

    files = scan_files(named)
    upload = announce(either.http, files)["id"]
    for file, data in files.items():
        either.http.put(f"/v1/uploads/{upload}/files/{file}", content=data)
    answer = either.http.post(f"/v1/uploads/{upload}/commit")
    assert answer.status_code in (201, 422), answer.text


@pytest.mark.parametrize("name", ["%00", "a%00b", "%ED%A0%80", "%FF"], ids=["nul", "inside", "half", "byte"])
def test_names_in_paths(either: Stack, name: str) -> None:
    upload = announce(either.http, scan_files())["id"]
    url = f"/v1/uploads/{upload}/files/{name}"
    assert either.http.put(url, content=b"x").status_code == 404
    assert either.http.head(url).status_code == 404
    patch = {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    assert either.http.patch(url, content=b"x", headers=patch).status_code == 404
    assert either.http.get(f"/v1/jobs/{name}").status_code == 422


@pytest.mark.parametrize("key", [b"\xff", b"x" * 256, b"\xed\xa0\x80", b"a b"], ids=["byte", "long", "half", "space"])
def test_idempotency_keys(either: Stack, scan_id: str, key: bytes) -> None:
    answer = either.http.post("/v1/jobs", json={"scan_id": scan_id}, headers=[(b"Idempotency-Key", key)])
    refused(answer, "header/idempotency-key")


@pytest.mark.parametrize("control", ["\0", "\x01", "\x7f"], ids=["nul", "one", "del"])
def test_a_control_in_a_header_goes_no_further_than_the_parser(either: Stack, scan_id: str, control: str) -> None:

    body = json.dumps({"scan_id": scan_id}).encode()
    head = (
        f"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        f"Content-Length: {len(body)}\r\nIdempotency-Key: a{control}b\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", either.port), 10) as wire:
        wire.sendall(head.encode() + body)
        assert wire.recv(12) == b"HTTP/1.1 400"


@pytest.mark.parametrize("address", ["1" * 65, "2001:db8::1%" + "x" * 300, "ä" * 64], ids=["digits", "zone", "letters"])
def test_an_address_that_a_proxy_passed_on_loses_no_audit_entry(either: Stack, address: str) -> None:
    url = either.environment.get("SPLATCT_DATABASE_URL") or f"sqlite:///{either.data / 'splatct.db'}"
    made = f"forwarded-{uuid4()}"
    body = {"name": "s", "files": [{"name": "scan.json", "size": 1}]}
    headers = [(b"X-Forwarded-For", address.encode()), (b"X-Request-Id", made.encode())]
    assert either.http.post("/v1/uploads", json=body, headers=headers).status_code == 201
    database = Database(url)
    found = [entry for entry in AuditLog(database).entries(Wanted(action="upload")) if entry["request_id"] == made]
    database.close()
    assert len(found) == 1 and 0 < len(found[0]["address"]) <= 64
