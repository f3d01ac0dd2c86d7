"""Webhooks against a real receiver: told once a job has ended, signed, again until taken, and led nowhere private."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import ipaddress
import json
import socket
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
import sqlalchemy as sa

from server import addresses
from server.addresses import Forbidden, checked, networks
from server.deliveries import PAUSES, Due, Outbox, Outcome, purge_deliveries, send
from server.migrations import prepare
from server.store import File, NewJob, Store
from worker.contract import ErrorKind, State
from worker.database import Database
from worker.outbox import announce, deliveries, webhooks

from .stack import Stack, commit, kill, scan_files, submit


class Receiver:
    """Keeps what it is sent; answers from `answers`, then 200."""

    def __init__(self) -> None:
        self.got: list[tuple[str, dict[str, str], bytes]] = []
        self.answers: list[tuple[int, dict[str, str]]] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                outer.got.append((self.path, {k.lower(): v for k, v in self.headers.items()}, body))
                status, headers = outer.answers.pop(0) if outer.answers else (200, {})
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Quiet."""

        self.httpd = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.httpd.server_port}/done?lab=1"
        threading.Thread(target=self.httpd.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()
    yield made
    made.httpd.shutdown()
    made.httpd.server_close()


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Stack]:
    """A stack that may send to this machine, with short pauses."""
    running = Stack(tmp_path)
    running.environment |= {"SPLATCT_WEBHOOK_ALLOW": "127.0.0.0/8", "SPLATCT_WEBHOOK_RETRY_S": "0.2"}
    with running:
        yield running


def add(stack: Stack, url: str, **more: Any) -> dict[str, Any]:
    answer = stack.http.post("/v1/webhooks", json={"url": url, **more})
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def log_of(stack: Stack, hook: dict[str, Any]) -> list[dict[str, Any]]:
    return list(stack.http.get(f"/v1/webhooks/{hook['id']}/deliveries").json()["deliveries"])


def verify(secret: str, headers: dict[str, str], body: bytes) -> None:
    """As a receiver does, after the Standard Webhooks text and not after our code."""
    assert abs(int(headers["webhook-timestamp"]) - time.time()) < 60
    key = base64.b64decode(secret.split("_", 1)[1])
    signed = b".".join([headers["webhook-id"].encode(), headers["webhook-timestamp"].encode(), body])
    expected = base64.b64encode(hmac.digest(key, signed, hashlib.sha256)).decode()
    assert headers["webhook-signature"] == f"v1,{expected}"


def test_the_end_of_a_job_is_told_signed_and_on_record(told: Stack, receiver: Receiver) -> None:
    hook = add(told, receiver.url)
    told.start_worker()
    job_id = submit(told.http, commit(told.http, scan_files()))
    told.until(lambda: bool(receiver.got), what="the receiver is told")
    ((path, headers, body),) = receiver.got
    assert path == "/done?lab=1" and headers["content-type"] == "application/json"
    verify(hook["secret"], headers, body)
    said = json.loads(body)
    assert said["type"] == "job.succeeded" and said["data"]["id"] == job_id and said["data"]["error"] is None
    assert told.job(job_id)["state"] == "succeeded"
    told.until(lambda: log_of(told, hook)[0]["state"] == "delivered", what="the log says so")
    (entry,) = log_of(told, hook)
    assert (entry["id"], entry["attempts"], entry["status"]) == (headers["webhook-id"], 1, 200)
    log = (told.data.parent / "log.txt").read_text()
    assert "lab=1" not in log and hook["secret"] not in log, "what an address holds may be a secret"


def test_only_what_was_asked_for_is_told(told: Stack, receiver: Receiver) -> None:
    hook = add(told, receiver.url, events=["job.cancelled"])
    scan_id = commit(told.http, scan_files())
    told.http.post(f"/v1/jobs/{submit(told.http, scan_id)}/cancel")
    told.start_worker()
    told.wait(submit(told.http, scan_id), "succeeded")
    told.until(lambda: bool(receiver.got), what="the receiver is told")
    time.sleep(1.5)
    assert [json.loads(body)["type"] for _, _, body in receiver.got] == ["job.cancelled"]
    assert len(log_of(told, hook)) == 1


@pytest.mark.slow
def test_it_is_told_again_until_it_is_taken_under_one_id(told: Stack, receiver: Receiver) -> None:
    receiver.answers = [(500, {}), (503, {}), (302, {"Location": "http://127.0.0.1:1/elsewhere"})]
    hook = add(told, receiver.url)
    told.http.post(f"/v1/jobs/{submit(told.http, commit(told.http, scan_files()))}/cancel")
    told.until(lambda: log_of(told, hook)[0]["state"] == "delivered", 60, "it is taken")
    assert len(receiver.got) == 4 and len({headers["webhook-id"] for _, headers, _ in receiver.got}) == 1
    assert log_of(told, hook)[0]["attempts"] == 4, "a redirect was an answer like any other, and not followed"
    for _, headers, body in receiver.got:
        verify(hook["secret"], headers, body)


@pytest.mark.slow
def test_nothing_is_lost_with_the_server(told: Stack, receiver: Receiver) -> None:
    """A job ends while no server runs; the worker alone writes the outbox."""
    add(told, receiver.url)
    told.start_worker()
    job_id = submit(told.http, commit(told.http, scan_files(steps=40, pause=0.05)))
    told.until(lambda: told.job(job_id)["stage"] == "level", what="the engine is at work")
    kill(told.server)
    database = Database(f"sqlite:///{told.data / 'splatct.db'}")

    def written() -> bool:
        with database.reading() as read:
            return read.execute(sa.select(deliveries.c.id)).first() is not None

    told.until(written, what="the worker has ended the job")
    database.close()
    assert receiver.got == []
    told.start_server()
    told.until(lambda: len(receiver.got) == 1, what="the receiver is told")


@pytest.mark.parametrize(
    "url",
    ["http://127.0.0.1:{port}/", "http://localhost:{port}/", "http://[::1]:{port}/", "http://[::ffff:127.0.0.1]:{port}/",
     "http://2130706433:{port}/", "http://0.0.0.0:{port}/", "http://[64:ff9b::7f00:1]:{port}/"],
)  # fmt: skip
def test_this_machine_is_not_told_unless_allowed(stack: Stack, receiver: Receiver, url: str) -> None:
    hook = add(stack, url.format(port=receiver.httpd.server_port))
    stack.http.post(f"/v1/jobs/{submit(stack.http, commit(stack.http, scan_files()))}/cancel")
    stack.until(lambda: log_of(stack, hook)[0]["attempts"] == 1, what="it was tried")
    (entry,) = log_of(stack, hook)
    assert entry["status"] is None and "private or local address" in entry["error"] and entry["state"] == "waiting"
    assert receiver.got == []


@pytest.mark.parametrize(
    "url",
    [
        "ftp://lab.example.org/",
        "lab.example.org",
        "https://",
        "https://u:p@lab.example.org/",
        "http://x/#y",
        "file:///etc/x",
    ],
)
def test_an_address_that_is_none_is_refused(shared: Stack, url: str) -> None:
    answer = shared.http.post("/v1/webhooks", json={"url": url})
    assert answer.status_code == 422 and answer.json()["errors"][0]["where"] == "url"


def test_a_webhook_can_be_seen_and_deleted_but_its_secret_no_more(shared: Stack) -> None:
    hook = add(shared, "https://lab.example.org/done", events=["job.failed"])
    assert hook["secret"].startswith("whsec_")
    assert shared.http.get(f"/v1/webhooks/{hook['id']}").json() == {**hook, "secret": None}
    assert hook["id"] in [listed["id"] for listed in shared.http.get("/v1/webhooks").json()["webhooks"]]
    assert hook["secret"] not in shared.http.get("/v1/webhooks").text
    assert shared.http.delete(f"/v1/webhooks/{hook['id']}").status_code == 204
    assert shared.http.get(f"/v1/webhooks/{hook['id']}").status_code == 404
    assert shared.http.post("/v1/webhooks", json={"url": "https://x.example/", "events": []}).status_code == 422
    assert shared.http.post("/v1/webhooks", json={"url": "https://x.example/", "events": ["all"]}).status_code == 422


def test_a_tenant_has_ten_at_most(keyed: Stack) -> None:
    with keyed.client(keyed.new_key(f"t-{uuid4().hex[:8]}", "admin")[1]) as http:
        answers = [http.post("/v1/webhooks", json={"url": "https://x.example/"}).status_code for _ in range(11)]
    assert answers == [201] * 10 + [409]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    database = Database(f"sqlite:///{tmp_path / 'splatct.db'}")
    prepare(database)
    yield Store(database, "a")
    database.close()


def hook(store: Store, tenant: str, url: str = "http://x.example/") -> None:
    row = {"id": str(uuid4()), "tenant": tenant, "url": url, "secret": "whsec_AAAA", "created_at": 0.0}
    with store.database.writing() as write:
        write.execute(webhooks.insert().values(**row, events="job.succeeded job.failed job.cancelled"))


def test_a_move_that_did_not_happen_is_not_told_and_others_hear_nothing(store: Store) -> None:
    hook(store, "a")
    hook(store, "b")
    scan = store.commit(store.add_upload("scan", [File("scan.json", 1, None, None)]), {})
    assert store.add_job(NewJob("j", "job", {}), scan, lambda: None)
    assert not store.jobs.succeed("j", 1), "it does not run"
    assert store.jobs.claim("j", 1, "here") is not None
    assert store.jobs.fail("j", 1, ErrorKind.BAD_INPUT, "bad") and not store.jobs.fail("j", 1, ErrorKind.BAD_INPUT, "x")
    (due,) = Outbox(store.database, 1.0).claim(10)
    said = json.loads(due.body)
    assert said["type"] == "job.failed" and said["data"]["error"] == {"kind": "bad_input", "message": "bad"}
    assert said["data"]["state"] == State.FAILED


def test_a_delivery_is_one_server_s_at_a_time_and_given_up_in_the_end(store: Store) -> None:
    hook(store, "a")
    with store.database.writing() as write:
        announce(write, "a", "job.failed", {"id": "j"})
    one, other = Outbox(store.database, 0.001), Outbox(store.database, 0.001)
    (due,) = one.claim(10)
    assert other.claim(10) == [], "it is the first's for a while"
    for attempt in range(len(PAUSES) + 1):
        one.record(due, Outcome(500, "it answered 500"))
        if attempt < len(PAUSES):
            with store.database.writing() as write:  # time passes
                write.execute(deliveries.update().values(due_at=time.time() - 1))
            (due,) = other.claim(10)
    with store.database.reading() as read:
        row = read.execute(sa.select(deliveries)).one()
    assert (row.attempts, row.due_at, row.delivered_at) == (len(PAUSES) + 1, None, None)
    purge_deliveries(store.database)
    with store.database.writing() as write:
        assert write.execute(sa.select(deliveries.c.id)).first() is not None, "a month is not over"
        write.execute(deliveries.update().values(created_at=0.0))
    purge_deliveries(store.database)
    with store.database.reading() as read:
        assert read.execute(sa.select(deliveries.c.id)).first() is None


def test_turns_go_round_among_tenants(store: Store) -> None:
    hook(store, "a")
    hook(store, "b")
    with store.database.writing() as write:
        for number in range(20):
            announce(write, "a", "job.failed", {"id": f"a{number}"})
        announce(write, "b", "job.failed", {"id": "b"})
    claimed = [json.loads(due.body)["data"]["id"] for due in Outbox(store.database, 1.0).claim(8)]
    assert "b" in claimed and len(claimed) == 8


def test_a_receiver_that_is_gone_is_not_asked_again(store: Store) -> None:
    hook(store, "a")
    with store.database.writing() as write:
        announce(write, "a", "job.failed", {"id": "j"})
    outbox = Outbox(store.database, 0.001)
    outbox.record(outbox.claim(1)[0], Outcome(410, "it answered 410"))
    with store.database.reading() as read:
        assert read.execute(sa.select(deliveries.c.due_at)).scalar_one() is None


PRIVATE = ["10.0.0.1", "172.16.0.1", "192.168.1.1", "127.0.0.1", "169.254.169.254", "100.64.0.1", "0.0.0.0",
           "224.0.0.1",
           "255.255.255.255", "::1", "::", "fe80::1", "fd00::1", "ff02::1", "::ffff:10.0.0.1", "64:ff9b::a00:1",
           "2002:a00:1::"]  # fmt: skip


@pytest.mark.parametrize("address", PRIVATE)
def test_private_addresses_are_refused(address: str) -> None:
    with pytest.raises(Forbidden):
        asyncio.run(checked(address, 80, ()))
    allowed = asyncio.run(checked(address, 80, networks("0.0.0.0/0, ::/0")))
    assert ipaddress.ip_address(allowed) == ipaddress.ip_address(address)


def test_public_addresses_and_allowed_ones_are_fine() -> None:
    for address in ("8.8.8.8", "2606:4700::1111"):
        assert asyncio.run(checked(address, 443, ())) == address
    assert asyncio.run(checked("10.1.2.3", 80, networks("10.1.0.0/16"))) == "10.1.2.3"
    with pytest.raises(Forbidden):
        asyncio.run(checked("10.2.2.3", 80, networks("10.1.0.0/16")))


class Names:
    """A resolver whose names change their meaning from one question to the next."""

    def __init__(self, *answers: list[str]) -> None:
        self.answers, self.asked = list(answers), 0

    async def __call__(self, host: str, port: int) -> list[str]:
        self.asked += 1
        return self.answers[min(self.asked, len(self.answers)) - 1]


def test_of_a_name_with_several_addresses_all_must_be_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(addresses, "resolved", Names(["8.8.8.8", "10.0.0.1"]))
    with pytest.raises(Forbidden):
        asyncio.run(checked("lab.example.org", 80, ()))


def test_the_connection_goes_to_the_address_that_was_judged(
    receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The name is resolved once; that it would lead elsewhere a moment later does not matter."""
    names = Names(["127.0.0.1"], ["127.0.0.2"])
    monkeypatch.setattr(addresses, "resolved", names)
    port = receiver.httpd.server_port
    due = Due("id", f"http://lab.example.org:{port}/x", "whsec_AAAA", "{}", 0)
    outcome = asyncio.run(send(due, networks("127.0.0.1/32")))
    assert outcome == Outcome(200, None) and names.asked == 1
    assert receiver.got[0][1]["host"] == f"lab.example.org:{port}"


def test_a_receiver_that_talks_without_end_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.deliveries._PATIENCE_S", 1.0)
    listening = socket.create_server(("127.0.0.1", 0))

    def drip() -> None:
        wire, _ = listening.accept()
        with wire:
            try:
                for _ in range(100):
                    wire.sendall(b"H")
                    time.sleep(0.1)
            except OSError:
                return

    threading.Thread(target=drip, daemon=True).start()
    due = Due("id", f"http://127.0.0.1:{listening.getsockname()[1]}/", "whsec_AAAA", "{}", 0)
    began = time.monotonic()
    outcome = asyncio.run(send(due, networks("127.0.0.1/32")))
    listening.close()
    assert outcome.status is None and outcome.error and time.monotonic() - began < 5


def test_a_name_that_nobody_has_is_told_so() -> None:
    due = Due("id", "http://no-such-host.invalid/", "whsec_AAAA", "{}", 0)
    assert asyncio.run(send(due, ())) == Outcome(None, "its name cannot be resolved")


def test_what_a_webhook_url_may_hold_is_no_key_to_our_own_server(told: Stack) -> None:
    """Sent to ourselves, where it is allowed, a delivery is a stranger's request."""
    hook_ = add(told, f"{told.http.base_url}/v1/uploads")
    _, text = told.new_key("local", "admin")
    with told.client(text) as http:
        http.post(f"/v1/jobs/{submit(http, commit(http, scan_files()))}/cancel")
        told.until(
            lambda: http.get(f"/v1/webhooks/{hook_['id']}/deliveries").json()["deliveries"][0]["status"] == 401,
            what="it was refused",
        )
