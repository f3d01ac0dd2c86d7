"""How often and how large: rates of a key, sizes of a request. Quotas are in test_quotas.py."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import pytest

from server.limits import HEAD_BYTES
from server.rates import Buckets, neighbourhood

from .stack import Stack, scan_files, send

NOBODY_S = "5f0c1d9e-0000-4000-8000-000000000000"  # id of nothing

FILES = scan_files()


def test_a_key_that_asks_too_often_is_told_when_to_come_back(stack: Stack) -> None:
    stack.server.terminate()
    stack.server.wait()
    stack.environment |= {"SPLATCT_RATE_PER_S": "1", "SPLATCT_RATE_BURST": "5"}
    stack.start_server()
    with stack.client(stack.new_key("a", "read")[1]) as fast, stack.client(stack.new_key("a", "read")[1]) as other:
        answers = [fast.get("/v1/jobs") for _ in range(7)]
        assert [answer.status_code for answer in answers] == [200] * 5 + [429] * 2
        assert [answer.headers["ratelimit-remaining"] for answer in answers] == ["4", "3", "2", "1", "0", "0", "0"]
        assert answers[0].headers["ratelimit-limit"] == "5" and int(answers[4].headers["ratelimit-reset"]) in (4, 5)
        assert answers[6].json()["type"] == "urn:splatct:problem:too-many-requests"
        assert other.get("/v1/jobs").status_code == 200
        assert fast.get("/healthz").status_code == 200
        time.sleep(int(answers[6].headers["retry-after"]))
        assert fast.get("/v1/jobs").status_code == 200


def test_trying_keys_is_slowed_down_and_locks_nobody_out(tmp_path: Path) -> None:
    running = Stack(tmp_path)
    running.environment["SPLATCT_FAILURES_PER_MIN"] = "6"
    with running, running.client() as http:
        _, good = running.new_key("a", "read")
        tried = [http.post("/v1/session", json={"key": f"splatct_aaaaaaaaaa_{n}"}) for n in range(8)]
        assert [answer.status_code for answer in tried] == [401] * 6 + [429] * 2
        assert 0 < int(tried[7].headers["retry-after"]) <= 10
        assert http.post("/v1/session", json={"key": good}).status_code == 429, "the right one is not told apart"
        bad = http.get("/v1/jobs", headers={"Authorization": "Bearer splatct_aaaaaaaaaa_x"})
        assert bad.status_code == 429 and "retry-after" in bad.headers
        assert http.get("/v1/jobs", headers={"Authorization": f"Bearer {good}"}).status_code == 200
        assert http.get("/v1/jobs").status_code == 401, "who shows no key tries none"


def test_buckets_fill_again_and_are_forgotten() -> None:
    now = [0.0]
    buckets = Buckets(2.0, 3, lambda: now[0])
    taken = [buckets.take("a") for _ in range(4)]
    assert [drawn.wait_s for drawn in taken if drawn] == [0.0, 0.0, 0.0, 0.5]
    assert buckets.wait_s("a") == 0.5 and buckets.wait_s("b") == 0.0
    now[0] = 0.5
    again = buckets.take("a")
    assert again is not None and again.wait_s == 0.0 and again.left == 0
    for number in range(10_050):
        buckets.take(str(number))
        now[0] += 0.01
    assert len(buckets._level) < 10_001, "addresses without end do not fill the memory"
    assert Buckets(0.0, 1).take("a") is None


def test_a_subscriber_is_one_however_many_addresses_it_has() -> None:
    assert neighbourhood("2001:db8:1:2:3:4:5:6") == neighbourhood("2001:db8:1:2::9") != neighbourhood("2001:db8:1:3::9")
    assert neighbourhood("192.0.2.1") != neighbourhood("192.0.2.2") and neighbourhood(None) == "unknown"


@pytest.mark.parametrize(
    ("method", "path", "limit"),
    [
        ("POST", "/v1/session", 8 << 10),
        ("POST", "/v1/jobs", 256 << 10),
        ("PUT", f"/v1/jobs/{NOBODY_S}", 256 << 10),
        ("POST", f"/v1/jobs/{NOBODY_S}/cancel", 256 << 10),
        ("POST", "/v1/uploads", 16 << 20),
        ("PUT", f"/v1/uploads/{NOBODY_S}", 16 << 20),
        ("POST", f"/v1/uploads/{NOBODY_S}/commit", 16 << 10),
        ("DELETE", f"/v1/scans/{NOBODY_S}", 16 << 10),
        ("POST", "/healthz", 16 << 10),
    ],
)
def test_every_body_has_an_end(shared: Stack, method: str, path: str, limit: int) -> None:
    under = shared.http.request(method, path, content=b" " * limit).status_code
    over = shared.http.request(method, path, content=b" " * (limit + 1))
    assert under != 413 and over.status_code == 413 and over.headers["content-type"] == "application/problem+json"
    assert str(limit) in over.json()["detail"]


@pytest.mark.parametrize("body", [b"[" * 200_000, b'{"a":' * 40_000, b'{"scan_id": 1e999}', b"\xff\xfe", b"NaN"])
def test_json_that_attacks_is_a_bad_request(shared: Stack, body: bytes) -> None:
    answer = shared.http.post("/v1/jobs", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in (400, 422) and answer.headers["content-type"] == "application/problem+json"


def test_a_head_that_is_too_large(shared: Stack) -> None:
    small = shared.http.get("/healthz", headers={"X-Long": "x" * (HEAD_BYTES - 1000)})
    large = shared.http.get("/healthz", headers={"X-Long": "x" * HEAD_BYTES})
    many = shared.http.get("/healthz", headers={f"X-{n}": "x" * 20 for n in range(1500)})
    address = shared.http.get(f"/healthz?{'x' * HEAD_BYTES}")
    assert [a.status_code for a in (small, large, many, address)] == [200, 431, 431, 431]
    assert str(HEAD_BYTES) in large.json()["detail"]


@pytest.mark.parametrize("start", [b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-Long: ", b"GET /"])
def test_a_head_that_never_ends_is_cut_off(shared: Stack, start: bytes) -> None:
    before = resident(shared.server.pid)
    with socket.create_connection(("127.0.0.1", shared.port), 10) as wire:
        wire.sendall(start)
        sent = 0
        try:
            while sent < 200 << 20:
                wire.sendall(b"x" * (1 << 20))
                sent += 1 << 20
        except (BrokenPipeError, ConnectionResetError):
            pass
    assert sent < 20 << 20 and resident(shared.server.pid) - before < 20 << 20
    assert shared.http.get("/healthz").status_code == 200


def test_bodies_may_be_longer_than_heads(shared: Stack) -> None:
    """On one connection, one after the other: the limit is on heads alone."""
    for _ in range(3):
        assert send(shared.http, FILES | {"more.bin": b"x" * (3 << 20)})


def resident(pid: int) -> int:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * 4096
