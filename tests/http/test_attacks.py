"""What fresh eyes found when they attacked the service; each was a defect once."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import select
import socket
from pathlib import Path

import pytest

from server import deliveries
from server.addresses import Forbidden, checked
from server.audit import AuditLog, Wanted
from server.deliveries import Due, Outcome, keep_delivering
from server.keys import KeyRing
from server.logs import Text
from server.problems import ApiProblem
from server.store import Store
from server.watch import MOST_EYES, MOST_OF_ONE, Watch
from worker.database import Database
from worker.ledger import Ledger

from .stack import Stack, announce, commit, scan_files


@pytest.fixture(scope="module")
def scan_id(keyed: Stack) -> str:
    return commit(keyed.http, scan_files())


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/jobs/validate"])
def test_a_number_beyond_all_floats_is_refused(keyed: Stack, scan_id: str, path: str) -> None:
    body = f'{{"scan_id": "{scan_id}", "options": {{"seed": {"9" * 400}}}}}'
    answer = keyed.http.post(path, content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422 and "seed: got a number far beyond" in answer.text


@pytest.mark.parametrize("character", ["\x9b", "\x85", "\u2028", "\u202e", "\u2066", "\u200f"])
def test_names_hold_nothing_that_a_terminal_obeys(keyed: Stack, scan_id: str, character: str) -> None:
    answer = keyed.http.post("/v1/jobs/validate", json={"scan_id": scan_id, "name": f"a{character}b"})
    assert answer.status_code == 422 and answer.json()["errors"][0]["where"] == "body/name"
    assert keyed.http.post("/v1/jobs/validate", json={"scan_id": scan_id, "name": "Zähne 牙 №1"}).status_code == 200


@pytest.mark.parametrize(
    "url",
    ["http://xn--a/", "http://a.example:99999/", "http://a.example:0/", "http://a%00b/", "http://[fe80::1%25lo]/"],
)
def test_addresses_that_cannot_be_called_are_no_webhooks(keyed: Stack, url: str) -> None:
    answer = keyed.http.post("/v1/webhooks", json={"url": url})
    assert answer.status_code == 422 and answer.json()["errors"][0]["where"] == "url"


@pytest.mark.parametrize("address", ["::7f00:1", "::ffff:0:7f00:1", "fec0::1", "64:ff9b:1::7f00:1", "5f00::1"])
def test_webhooks_go_to_no_special_ipv6_address(address: str) -> None:
    with pytest.raises(Forbidden):
        asyncio.run(checked(address, 80, ()))


def test_a_delivery_that_breaks_the_sender_counts_as_an_attempt(monkeypatch: pytest.MonkeyPatch) -> None:
    class Once:
        def __init__(self) -> None:
            self.left = [Due("one", "http://a.example/", "whsec_", "{}", 0)]
            self.recorded: list[Outcome] = []

        def claim(self, most: int) -> list[Due]:
            return [self.left.pop()] if self.left else []

        def record(self, due: Due, outcome: Outcome) -> None:
            self.recorded.append(outcome)

    async def broken(due: Due, allowed: object) -> Outcome:
        raise ValueError("embedded null byte")

    monkeypatch.setattr(deliveries, "send", broken)
    outbox = Once()

    async def a_while() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(keep_delivering(outbox, ()), 0.5)  # type: ignore[arg-type]

    asyncio.run(a_while())
    assert [outcome.taken for outcome in outbox.recorded] == [False]
    assert "embedded null" not in (outbox.recorded[0].error or "")


def resident_mb(pid: int) -> float:
    found = re.search(r"VmRSS:\s*(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1]) * 1024 / 1e6


@pytest.mark.parametrize("many", [True, False])
def test_trailers_without_end_fill_no_memory(keyed: Stack, many: bool) -> None:
    """No key is needed to send them."""
    before = resident_mb(keyed.server.pid)
    line = b"y" * 8000
    with socket.create_connection(("127.0.0.1", keyed.port), timeout=10) as connection:
        connection.sendall(b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n0\r\nx: ")
        with pytest.raises(OSError):
            for number in range(10_000):
                connection.sendall(line + (b"\r\nx%d: " % number if many else b""))
    assert resident_mb(keyed.server.pid) - before < 20
    assert keyed.http.get("/v1/jobs").status_code == 200


def test_a_body_in_many_small_chunks_is_still_taken(keyed: Stack, scan_id: str) -> None:
    body = f'{{"scan_id": "{scan_id}"{" " * 9000}}}'.encode()
    answer = keyed.http.post(
        "/v1/jobs/validate",
        content=iter([body[n : n + 1] for n in range(len(body))]),
        headers={"Content-Type": "application/json"},
    )
    assert answer.status_code == 200, answer.text


def test_one_file_sent_many_times_at_once_takes_its_size_once(keyed: Stack) -> None:
    """It was given room once; each sender would take as much again."""
    size = 4 << 20
    upload_id = announce(keyed.http, {"scan.json": b"x" * size})["id"]
    parts = keyed.data / "uploads" / upload_id / "parts"
    head = f"PUT /v1/uploads/{upload_id}/files/scan.json HTTP/1.1\r\nHost: localhost\r\n"
    head += f"Authorization: {keyed.http.headers['Authorization']}\r\nContent-Length: {size}\r\n\r\n"
    with contextlib.ExitStack() as stack:
        senders = []
        for _ in range(5):
            senders.append(stack.enter_context(socket.create_connection(("127.0.0.1", keyed.port), timeout=20)))
            senders[-1].sendall(head.encode() + b"y" * (size // 2))
        waiting = list(senders)  # the newest is whichever the server began with last
        while len(waiting) > 1:
            answered = select.select(waiting, [], [], 20)[0]
            assert answered, f"{len(waiting)} still send"
            for sender in answered:
                assert b" 409 " in sender.recv(100)
                waiting.remove(sender)
        keyed.until(lambda: len(list(parts.iterdir())) == 1, what="the newest alone is left")
        waiting[0].sendall(b"y" * (size // 2))
        assert b" 200 " in waiting[0].recv(100)
    assert keyed.http.delete(f"/v1/uploads/{upload_id}").status_code == 204


def test_one_tenant_cannot_take_all_places_of_those_who_wait(tmp_path: Path) -> None:
    async def crowd() -> None:
        database = Database(f"sqlite:///{tmp_path / 'empty.db'}")
        watch = Watch(Ledger(database), tmp_path)
        with contextlib.ExitStack() as stack:
            for _ in range(MOST_OF_ONE):
                stack.enter_context(watch.on("a job", "first"))
            with pytest.raises(ApiProblem, match="of this tenant") as refused:
                stack.enter_context(watch.on("another job", "first"))
            assert refused.value.status == 503
            for _ in range(MOST_EYES - MOST_OF_ONE):
                stack.enter_context(watch.on("their job", "second"))
            with pytest.raises(ApiProblem, match=f"{MOST_EYES} requests wait"):
                stack.enter_context(watch.on("their job", "third"))
        with watch.on("a job", "first"):
            database.close()

    asyncio.run(crowd())


def test_plain_log_lines_stay_lines() -> None:
    record = logging.LogRecord("splatct", logging.ERROR, "", 0, "GET /a\n2026 splatct INFO\x1b[2J\u2028b", None, None)
    line = Text().format(record)
    assert line.isprintable() and "\\n2026" in line and "\\x1b" in line


def test_nul_never_reaches_the_database(tmp_path: Path) -> None:
    """SQLite takes it, PostgreSQL fails: so nobody asks either."""
    database = Database(f"sqlite:///{tmp_path / 'empty.db'}")  # it has no tables, and would fail, too
    assert KeyRing(database).find("splatct_\0_secret") is None
    assert Store(database, "first").upload_file("any", "a\0b") is None
    database.close()


def test_a_long_address_from_a_proxy_is_on_record(keyed: Stack) -> None:
    """PostgreSQL would refuse the entry, and what was done would be on no record."""
    long = "x" * 300
    answer = keyed.http.post("/v1/webhooks", json={"url": "https://a.example/"}, headers={"X-Forwarded-For": long})
    assert answer.status_code == 201
    database = Database(f"sqlite:///{keyed.data / 'splatct.db'}")
    kept = list(AuditLog(database).entries(Wanted(thing=answer.json()["id"])))
    database.close()
    assert [entry["address"] for entry in kept] == [long[:64]]
    assert keyed.http.delete(f"/v1/webhooks/{answer.json()['id']}").status_code == 204
