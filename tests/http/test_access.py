"""Keys over HTTP: who is let in, and to do what."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import pytest

from server.keys import KeyRing, Scope, keys
from server.migrations import prepare
from worker.database import Database

from .stack import PYTHONPATH, Stack, announce, scan_files

NOBODY_S = "5f0c1d9e-0000-4000-8000-000000000000"  # id of nothing


def status(stack: Stack, key: str | None, method: str = "GET", path: str = "/v1/jobs", **more: Any) -> int:
    with stack.client(key) as http:
        return http.request(method, path, **more).status_code


def test_without_keys_all_is_open_and_with_the_first_key_it_closes(stack: Stack) -> None:
    assert stack.http.get("/v1/jobs").status_code == 200
    assert stack.http.get("/metrics").status_code == 200
    assert status(stack, "splatct_unknown_secret") == 200, "a client that has a key for elsewhere"
    key, text = stack.new_key("local", "read")
    assert stack.http.get("/v1/jobs").status_code == 401
    assert status(stack, text) == 200
    stack.revoke(key.id)
    assert status(stack, text) == 401
    assert stack.http.get("/v1/jobs").status_code == 401, "a server whose last key was revoked stays closed"


def test_a_refusal_says_what_to_do(keyed: Stack) -> None:
    with keyed.client() as http:
        answer = http.get("/v1/jobs")
    assert answer.status_code == 401 and answer.headers["www-authenticate"] == "Bearer"
    assert answer.headers["content-type"] == "application/problem+json"
    assert "splatct keys add" in answer.json()["errors"][0]["hint"]
    assert answer.headers["x-content-type-options"] == "nosniff" and answer.headers["x-request-id"]


def test_pages_and_health_need_no_key_and_say_nothing(keyed: Stack) -> None:
    with keyed.client() as http:
        keyed.until(lambda: http.get("/readyz").status_code == 200, what="the worker is there")
        for path in ("/", f"/jobs/{uuid4()}", "/static/api.js", "/healthz", "/readyz", "/openapi.json"):
            assert http.get(path).status_code == 200, path
        assert http.get("/v1/options").status_code == 401
        assert http.get("/no/such/page").status_code == 401
        assert http.post("/").status_code == 401


@pytest.mark.parametrize("mangle", ["", "Bearer", "Basic {}", "{}", "Bearer {}x", "Bearer x{}", "Bearer {} {}"])
def test_a_key_that_is_not_quite_one(keyed: Stack, mangle: str) -> None:
    _, text = keyed.new_key("first", "read")
    assert status(keyed, None, headers={"Authorization": f"bearer {text}"}) == 200
    assert status(keyed, None, headers={"Authorization": mangle.format(text, text)}) == 401


def test_the_secret_of_one_key_does_not_open_another(keyed: Stack) -> None:
    first, second = (keyed.new_key("first", "read")[1].split("_", 2) for _ in range(2))
    assert status(keyed, "_".join([*first[:2], second[2]])) == 401
    assert status(keyed, f"splatct_{first[1]}_") == 401


def test_a_key_in_the_address_is_no_key(keyed: Stack) -> None:
    _, text = keyed.new_key("first", "read")
    assert status(keyed, None, path=f"/v1/jobs?key={text}&access_token={text}") == 401


def test_an_expired_key_is_refused(keyed: Stack) -> None:
    _, text = keyed.new_key("first", "read", expires_at=time.time() + 0.5)
    assert status(keyed, text) == 200
    keyed.until(lambda: status(keyed, text) == 401, 5, "the key expires")


CALLS = [
    ("GET", "/v1/jobs", "read"),
    ("GET", f"/v1/jobs/{NOBODY_S}/results", "read"),
    ("GET", "/v1/scans", "read"),
    ("POST", "/v1/uploads", "submit"),
    ("GET", f"/v1/uploads/{NOBODY_S}", "submit"),
    ("HEAD", f"/v1/uploads/{NOBODY_S}/files/a", "submit"),
    ("DELETE", f"/v1/uploads/{NOBODY_S}", "submit"),
    ("POST", "/v1/jobs", "submit"),
    ("PUT", f"/v1/jobs/{NOBODY_S}", "submit"),
    ("POST", f"/v1/jobs/{NOBODY_S}/cancel", "submit"),
    ("DELETE", f"/v1/jobs/{NOBODY_S}", "delete"),
    ("DELETE", f"/v1/scans/{NOBODY_S}", "delete"),
    ("GET", "/metrics", "admin"),
]


@pytest.mark.parametrize(("method", "path", "scope"), CALLS)
def test_a_scope_opens_its_calls_and_no_others(keyed: Stack, method: str, path: str, scope: str) -> None:
    for has in Scope:
        _, text = keyed.new_key("first", has)
        answer = status(keyed, text, method, path)
        assert (answer == 403) == (has not in (scope, "admin")), has


def test_any_key_may_read_the_options(keyed: Stack) -> None:
    for has in Scope:
        assert status(keyed, keyed.new_key("first", has)[1], path="/v1/options") == 200


def test_a_stranger_s_body_is_not_read(keyed: Stack) -> None:
    """The refusal comes before the first byte of the body is asked for."""
    import socket

    with socket.create_connection(("127.0.0.1", keyed.port), 10) as wire:
        head = "POST /v1/uploads HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10000000\r\n\r\n"
        wire.sendall(head.encode())
        assert wire.recv(100).startswith(b"HTTP/1.1 401")


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[KeyRing]:
    database = Database(f"sqlite:///{tmp_path / 'splatct.db'}")
    prepare(database)
    yield KeyRing(database)
    database.close()


def test_only_a_digest_is_kept(ring: KeyRing, tmp_path: Path) -> None:
    _, text = ring.add("lab", "scanner", [Scope.READ], None)
    secret = text.split("_", 2)[2].encode()
    assert len(secret) >= 43
    kept = b"".join(path.read_bytes() for path in tmp_path.glob("splatct.db*"))
    assert b"scanner" in kept and secret not in kept


def test_the_last_use_is_noted(ring: KeyRing) -> None:
    _, text = ring.add("lab", "", [Scope.READ], None)
    assert ring.all()[0].last_used_at is None
    assert ring.find(text) is not None
    first = ring.all()[0].last_used_at
    assert first is not None and abs(first - time.time()) < 5
    assert ring.find(text) is not None
    assert ring.all()[0].last_used_at == first, "no write for every request"


def splatct(data: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SPLATCT_")}
    command = [sys.executable, "-m", "splatct_client", "keys", *arguments, "--data", str(data)]
    return subprocess.run(
        command, env=environment | {"PYTHONPATH": PYTHONPATH}, capture_output=True, text=True, timeout=60, check=False
    )


def test_the_command_adds_lists_and_revokes(tmp_path: Path) -> None:
    data = tmp_path / "data"
    missing = splatct(data, "list")
    assert missing.returncode == 2 and "there is no database" in missing.stderr and not data.exists()
    made = splatct(data, "add", "--tenant", "lab-1", "--name", "scanner", "--scopes", "submit, read", "--expires", "2d")
    text = made.stdout.strip()
    assert made.returncode == 0 and text.startswith("splatct_") and text not in made.stderr
    listed = json.loads(splatct(data, "list", "--json").stdout)["keys"]
    assert [(k["tenant"], k["scopes"], k["state"], k["name"]) for k in listed] == [
        ("lab-1", ["read", "submit"], "valid", "scanner")
    ]
    assert text not in json.dumps(listed)
    assert "lab-1" in splatct(data, "list").stdout and "lab-1" not in splatct(data, "list", "--tenant", "lab").stdout
    gone = splatct(data, "revoke", listed[0]["id"], "--json")
    assert gone.returncode == 0 and json.loads(gone.stdout)["state"] == "revoked"
    again = splatct(data, "revoke", "nobody")
    assert again.returncode == 2 and "got 'nobody'" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["add", "--scopes", "read,all"], "got 'read,all'"),
        (["add", "--scopes", ""], "got ''"),
        (["add", "--tenant", "../up"], "got '../up'"),
        (["add", "--expires", "soon"], "got 'soon'"),
        (["add", "--expires", "2001-01-01"], "which is over"),
        (["revoke"], "required: ID"),
    ],
)
def test_the_command_refuses_in_a_sentence(tmp_path: Path, arguments: list[str], says: str) -> None:
    done = splatct(tmp_path, *arguments)
    assert done.returncode == 2 and says in done.stderr and "Traceback" not in done.stderr


def serve(data: Path, **settings: str) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SPLATCT_")}
    environment |= {"PYTHONPATH": PYTHONPATH, **{f"SPLATCT_{name.upper()}": value for name, value in settings.items()}}
    command = [sys.executable, "-m", "splatct_client", "server", "--data", str(data)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)


def test_a_server_without_keys_refuses_to_be_reached(tmp_path: Path) -> None:
    done = serve(tmp_path, host="0.0.0.0", allowed_hosts="ct.example.org")
    assert done.returncode == 2 and "there are no keys" in done.stderr


def test_beyond_loopback_with_keys(stack: Stack) -> None:
    """It answers to the names that it was given, and to no others; it never opens without a key."""
    _, text = stack.new_key("first", "read")
    stack.server.terminate()
    stack.server.wait()
    stack.environment |= {"SPLATCT_HOST": "0.0.0.0", "SPLATCT_ALLOWED_HOSTS": "ct.example.org"}
    stack.start_server()
    for host, expected in [("ct.example.org:80", 200), ("CT.example.org", 200), ("other.example.org", 421)]:
        assert status(stack, text, headers={"Host": host}) == expected
    database = Database(f"sqlite:///{stack.data / 'splatct.db'}")
    with database.writing() as write:
        write.execute(keys.delete())
    database.close()
    assert status(stack, None) == 401


def test_the_log_names_the_key_and_never_tells_it(keyed: Stack) -> None:
    key, text = keyed.new_key("first", "submit")
    with keyed.client(text) as http:
        announce(http, scan_files())
    log = keyed.data.parent / "log.txt"
    keyed.until(lambda: f'"tenant": "first", "key_id": "{key.id}"' in log.read_text(), 5, "the request is in the log")
    assert text.split("_", 2)[2] not in log.read_text()


def test_health_checks_of_a_container_work_by_loopback_name(keyed: Stack) -> None:
    assert httpx.get(f"http://localhost:{keyed.port}/healthz", trust_env=False).status_code == 200
