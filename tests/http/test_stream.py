"""Following a job's events over a real connection: replay, the end, readers that are slow or leave."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from server.migrations import prepare
from server.tail import KEPT, Tail
from server.watch import Watch
from worker.database import Database
from worker.journal import Cursor, EventWriter
from worker.ledger import Ledger

from .stack import Stack, commit, scan_files, submit


def sse(http: httpx.Client, job_id: str, query: str = "", **headers: str) -> Iterator[dict[str, str]]:
    """The fields of each event until the server ends the stream."""
    with http.stream("GET", f"/v1/jobs/{job_id}/events/stream{query}", headers=headers) as answer:
        assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/event-stream")
        fields: dict[str, str] = {}
        for line in answer.iter_lines():
            if line.startswith(":"):
                continue
            if line:
                name, _, value = line.partition(": ")
                fields[name] = value
            elif fields:
                yield fields
                fields = {}


def finished_job(stack: Stack, **plan: Any) -> str:
    job_id = submit(stack.http, commit(stack.http, scan_files(**plan)))
    stack.wait(job_id, "succeeded", "failed")
    return job_id


def test_the_stream_follows_a_job_to_its_end(shared: Stack) -> None:
    job_id = submit(shared.http, commit(shared.http, scan_files(steps=8, pause=0.1)))
    arrived = [(time.monotonic(), event) for event in sse(shared.http, job_id)]
    *progress, end = [event for _, event in arrived]
    assert [int(event["id"]) for event in progress] == list(range(1, len(progress) + 1)) and len(progress) >= 9
    told = shared.http.get(f"/v1/jobs/{job_id}/events").json()["events"]
    assert [json.loads(event["data"]) for event in progress] == told
    assert end["event"] == "end" and end["id"] == progress[-1]["id"]
    assert json.loads(end["data"])["state"] == "succeeded"
    assert arrived[-1][0] - arrived[0][0] > 0.3, "the events came as they happened, not all at the end"


def test_a_reader_that_comes_back_gets_what_it_missed(shared: Stack) -> None:
    job_id = finished_job(shared)
    everything = list(sse(shared.http, job_id))
    for number in (0, 2, int(everything[-1]["id"])):
        again = list(sse(shared.http, job_id, **{"Last-Event-ID": str(number)}))
        assert again == [event for event in everything if "event" in event or int(event["id"]) > number]


def test_the_job_itself_is_told_where_it_is_asked_for(shared: Stack) -> None:
    """Its state as it is, then each change; without a number, so that no event is missed by who comes back."""
    job_id = submit(shared.http, commit(shared.http, scan_files(steps=4, pause=0.4)))
    told = list(sse(shared.http, job_id, query="?job=true"))
    rows = [event for event in told if event.get("event") == "job"]
    jobs = [json.loads(event["data"]) for event in rows]
    assert all("id" not in event for event in rows) and {job["id"] for job in jobs} == {job_id}
    assert jobs[-1]["state"] == "running" and len({job["progress"] for job in jobs}) >= 2
    assert all(one != other for one, other in pairwise(jobs)), "each is news"
    events = [event for event in told if event.get("event") != "job"]
    assert events == list(sse(shared.http, job_id)), "all else is as without"


@pytest.mark.parametrize("value", ["x", "-1", "1.5"])
def test_a_bad_last_event_id_is_refused(shared: Stack, value: str) -> None:
    job_id = finished_job(shared)
    answer = shared.http.get(f"/v1/jobs/{job_id}/events/stream", headers={"Last-Event-ID": value})
    assert answer.status_code == 422 and answer.headers["content-type"] == "application/problem+json"


def test_a_failed_and_a_cancelled_job_end_the_stream_too(shared: Stack) -> None:
    failed = finished_job(shared, end="diverged")
    assert json.loads(list(sse(shared.http, failed))[-1]["data"])["error"]["kind"] == "cannot_reconstruct"
    running = submit(shared.http, commit(shared.http, scan_files(steps=200, pause=0.1)))
    waiting = submit(shared.http, commit(shared.http, scan_files()))
    with ThreadPoolExecutor(1) as pool:
        reader = pool.submit(lambda: list(sse(shared.http, waiting)))
        time.sleep(0.7)
        shared.http.post(f"/v1/jobs/{waiting}/cancel")
        (end,) = reader.result(10)
    assert json.loads(end["data"])["state"] == "cancelled" and "id" not in end
    shared.http.post(f"/v1/jobs/{running}/cancel")
    shared.wait(running, "cancelled")


@pytest.mark.slow
def test_readers_that_stall_or_vanish_hold_up_nobody(stack: Stack) -> None:
    """A journal of 30,000 events does not fit into the socket of a reader that never reads."""
    job_id = submit(stack.http, commit(stack.http, scan_files()))
    with EventWriter(stack.data / "jobs" / job_id / "events.jsonl") as events:
        for step in range(30_000):
            events.append({"stage": "level", "fraction": 0.1, "attempt": 1, "step": step, "message": "x" * 200})
    request = f"GET /v1/jobs/{job_id}/events/stream HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
    stalled = []
    for _ in range(60):  # more than the pool has threads
        connection = socket.create_connection(("127.0.0.1", stack.port))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.sendall(request)
        stalled.append(connection)
    for connection in stalled[:20]:
        connection.close()
    time.sleep(1)
    began = time.monotonic()
    assert stack.http.get(f"/v1/jobs/{job_id}").json()["state"] == "queued"
    assert time.monotonic() - began < 5
    seen = 0
    for event in sse(stack.http, job_id):
        seen += 1
        assert int(event["id"]) == seen
        if seen == 30_000:
            break
    for connection in stalled[20:]:
        connection.close()


def test_a_stopping_server_sends_its_readers_away(stack: Stack) -> None:
    job_id = submit(stack.http, commit(stack.http, scan_files()))
    with ThreadPoolExecutor(2) as pool:
        reader = pool.submit(lambda: list(sse(stack.http, job_id)))
        url = f"http://127.0.0.1:{stack.port}/v1/jobs/{job_id}?wait=30"
        poll = pool.submit(lambda: httpx.get(url, trust_env=False, timeout=40).status_code)
        time.sleep(1)
        began = time.monotonic()
        stack.server.terminate()
        stack.server.wait(10)
        assert time.monotonic() - began < 3, "open streams did not hold the server for its grace period"
        assert reader.result(5) == [] and poll.result(5) == 200


@pytest.mark.slow
def test_a_silent_stream_is_pinged_every_15_seconds(stack: Stack) -> None:
    job_id = submit(stack.http, commit(stack.http, scan_files()))
    with stack.http.stream("GET", f"/v1/jobs/{job_id}/events/stream") as answer:
        began = time.monotonic()
        assert next(answer.iter_lines()).startswith(":")
        assert 14 < time.monotonic() - began < 20


def test_many_readers_share_one_reading_of_the_journal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = tmp_path / "events.jsonl"
    tail = Tail(journal)
    tail.keep(tail.fetch())
    assert tail.last == 0 and tail.since(0) == []
    with EventWriter(journal) as events:
        for step in range(KEPT + 500):
            events.append({"step": step})
        tail.keep(tail.fetch())
        assert tail.last == KEPT + 500
        assert tail.since(499) is None, "older than what is kept: the reader's own business"
        assert [line.number for line in tail.since(500) or []] == list(range(501, KEPT + 501))
        events.append({"step": -1})
        monkeypatch.setattr(Cursor, "read", lambda *_: pytest.fail("a reader that keeps up touches no disk"))
        assert tail.since(KEPT + 500) == []
        assert len(tail.since(KEPT + 300) or []) == 200


def test_a_cursor_takes_whole_lines_only_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    journal = tmp_path / "events.jsonl"
    cursor = Cursor(journal)
    assert cursor.read(10) == []
    journal.write_bytes(b'{"a": 1}\n{"a": 2}\n{"a"')
    assert [(line.number, line.text) for line in cursor.read(1)] == [(1, '{"a": 1}')]
    assert [line.number for line in cursor.read(10)] == [2]
    with journal.open("ab") as file:
        file.write(b": 3}\n")
    assert [(line.number, line.text) for line in cursor.read(10)] == [(3, '{"a": 3}')]
    assert [line.number for line in Cursor(journal).read(10, after=2)] == [3]


def news(answer: httpx.Response) -> Iterator[dict[str, Any]]:
    """What `jobs` tells, again and again."""
    for line in answer.iter_lines():
        if line.startswith("data: "):
            yield json.loads(line.removeprefix("data: "))


def test_the_list_is_told_whole_and_then_what_changed(stack: Stack) -> None:
    """No worker runs here."""
    scan_id = commit(stack.http, scan_files())
    with stack.http.stream("GET", "/v1/events") as answer:
        assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/event-stream")
        told = news(answer)
        assert next(told) == {"ids": [], "jobs": [], "more": False}
        first = submit(stack.http, scan_id)
        assert [job["id"] for job in next(told)["jobs"]] == [first]
        second = submit(stack.http, scan_id)
        after = next(told)
        assert after["ids"] == [second, first] and [job["id"] for job in after["jobs"]] == [second]
        stack.http.post(f"/v1/jobs/{first}/cancel").raise_for_status()
        moved = {job["id"]: (job["state"], job["queue_position"]) for job in next(told)["jobs"]}
        assert moved == {first: ("cancelled", None), second: ("queued", 1)}
        stack.http.delete(f"/v1/jobs/{first}").raise_for_status()
        assert next(told) == {"ids": [second], "jobs": [], "more": False}


def test_the_list_is_the_newest_fifty_and_says_that_there_are_more(stack: Stack) -> None:
    scan_id = commit(stack.http, scan_files())
    jobs = [submit(stack.http, scan_id) for _ in range(51)]
    with stack.http.stream("GET", "/v1/events") as answer:
        first = next(news(answer))
    assert first["ids"] == jobs[:0:-1] and first["more"]
    listed = stack.http.get("/v1/jobs").json()["jobs"]
    assert [job["id"] for job in first["jobs"]] == first["ids"]
    assert first["jobs"] == listed


def test_each_tenant_s_list_is_its_own(stack: Stack) -> None:
    """What another tenant does is no news: not its jobs, and no silence broken by them."""
    keys = [stack.new_key(tenant, "admin")[1] for tenant in ("a", "b")]
    with stack.client(keys[0]) as a, stack.client(keys[1]) as b:
        mine = submit(a, commit(a, scan_files()))
        theirs = commit(b, scan_files())
        with a.stream("GET", "/v1/events") as of_a, b.stream("GET", "/v1/events") as of_b:
            told_a, told_b = news(of_a), news(of_b)
            assert next(told_a)["ids"] == [mine] and next(told_b)["ids"] == []
            other = submit(b, theirs)
            assert next(told_b)["ids"] == [other]
            time.sleep(1.5)
            a.post(f"/v1/jobs/{mine}/cancel").raise_for_status()
            after = next(told_a)
            assert after["ids"] == [mine] and [job["state"] for job in after["jobs"]] == ["cancelled"]


@pytest.mark.slow
def test_a_list_that_nobody_watches_costs_nothing_and_one_that_many_watch_is_looked_at_once(tmp_path: Path) -> None:
    database = Database(f"sqlite:///{tmp_path / 'db'}")
    prepare(database)
    asked: list[str] = []

    @sa.event.listens_for(database.engine, "before_cursor_execute")
    def note(_connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        if statement.startswith("SELECT"):
            asked.append(statement)

    async def run() -> None:
        watch = Watch(Ledger(database), tmp_path)
        looking = asyncio.create_task(watch.keep_looking())
        await asyncio.sleep(1.2)
        assert asked == []
        with contextlib.ExitStack() as eyes:
            watching = [eyes.enter_context(watch.on_list("a")) for _ in range(20)]
            for eye in watching:
                assert await eye.news(5) is not None
            begun = len(asked)
            await asyncio.sleep(2.2)
            assert begun <= 2 and 3 <= len(asked) - begun <= 6
        left = len(asked)
        await asyncio.sleep(1.2)
        assert len(asked) - left <= 1
        looking.cancel()

    asyncio.run(run())
    database.close()
