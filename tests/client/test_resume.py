"""Large files from the client, against a server in memory that fails when told to."""

from __future__ import annotations

import base64
import hashlib
import os
from pathlib import Path

import httpx
import pytest
from splatct_client import Client, IntegrityError, ServerProblem
from splatct_client.resume import send_in_chunks
from splatct_client.retry import Patience

CHUNK = 2 << 20
DATA = os.urandom(5 * (1 << 20) + 7)


class Server:
    def __init__(self) -> None:
        self.stored = b""
        self.faults: list[str] = []
        self.patched: list[int] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        body = request.read()
        if request.method == "PATCH":
            start = int(request.headers["Upload-Offset"])
            self.patched.append(start)
            fault = self.faults.pop(0) if self.faults else ""
            if fault == "refuse":
                return self.problem(404, "not-found")
            if fault == "cut":  # half of it arrived
                self.stored += body[: len(body) // 2]
                raise httpx.WriteError("cut")
            if fault == "damage":
                return self.problem(400, "digest-mismatch")
            if start != len(self.stored):
                return self.problem(409, "offset-mismatch")
            digest = base64.b64encode(hashlib.sha256(body).digest()).decode()
            assert request.headers["Content-Digest"] == f"sha-256=:{digest}:"
            self.stored += body
            if fault == "unheard":  # it arrived; the answer did not
                raise httpx.ReadError("cut")
        whole = base64.b64encode(hashlib.sha256(self.stored).digest()).decode()
        done = {"Repr-Digest": f"sha-256=:{whole}:"} if len(self.stored) == len(DATA) else {}
        return httpx.Response(200, headers={"Upload-Offset": str(len(self.stored)), **done})

    def problem(self, status: int, kind: str) -> httpx.Response:
        return httpx.Response(status, json={"type": f"urn:splatct:problem:{kind}", "title": kind, "status": status})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "big.tif").write_bytes(DATA)
    return tmp_path / "big.tif"


def send(server: Server, path: Path, seen: list[int] | None = None) -> str:
    slept: list[float] = []
    patience = Patience(sleep=slept.append, clock=lambda: sum(slept))
    with Client("http://ct.example", patience=patience, transport=httpx.MockTransport(server)) as client:
        return send_in_chunks(client, "/file", path, (seen if seen is not None else []).append, CHUNK)


@pytest.mark.parametrize("faults", [[], ["cut"], ["unheard"], ["damage"], ["", "cut", "unheard", "damage", "cut"]])
def test_it_goes_on_where_the_server_stands(path: Path, faults: list[str]) -> None:
    server, seen = Server(), []
    server.faults = list(faults)
    assert send(server, path, seen) == hashlib.sha256(DATA).hexdigest()
    assert server.stored == DATA and seen[-1] == len(DATA)
    assert server.patched.count(0) == 1 + (faults == ["damage"])


def test_what_is_there_already_is_not_sent(path: Path) -> None:
    server = Server()
    server.stored = DATA[:CHUNK]
    send(server, path)
    assert server.patched[0] == CHUNK and server.stored == DATA


def test_a_refusal_is_final_and_endless_damage_ends(path: Path) -> None:
    server = Server()
    server.faults = ["refuse"]
    with pytest.raises(ServerProblem, match="404"):
        send(server, path)
    assert server.patched == [0]
    server.faults = ["damage"] * 1000
    with pytest.raises(ServerProblem, match="digest-mismatch"):
        send(server, path)
    assert server.faults


def test_another_file_on_the_server_is_told(path: Path) -> None:
    server = Server()
    server.stored = b"x" * CHUNK
    with pytest.raises(IntegrityError, match="sha256"):
        send(server, path)
