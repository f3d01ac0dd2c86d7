"""The job's ETag, and waiting for it to change: over real connections, more of them than there are threads."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest
from splatct_client.client import Client

from server.watch import MOST_OF_ONE

from .stack import Stack, commit, scan_files, submit


@pytest.fixture(scope="module")
def idle(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """A service without a worker."""
    with Stack(tmp_path_factory.mktemp("idle")) as running:
        yield running


def queued(stack: Stack) -> str:
    return submit(stack.http, commit(stack.http, scan_files()))


def test_an_unchanged_job_is_304_and_a_changed_one_is_told(idle: Stack) -> None:
    url = f"/v1/jobs/{queued(idle)}"
    first = idle.http.get(url)
    tag = first.headers["etag"]
    assert tag.startswith('W/"') and first.headers["cache-control"] == "no-cache"
    for named in (tag, tag.removeprefix("W/"), f'"other", {tag}', "*"):
        answer = idle.http.get(url, headers={"If-None-Match": named})
        assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", tag)
        assert answer.headers["retry-after"] == "5"
    assert idle.http.get(url, headers={"If-None-Match": 'W/"other"'}).json() == first.json()
    idle.http.post(f"{url}/cancel")
    changed = idle.http.get(url, headers={"If-None-Match": tag})
    assert changed.status_code == 200 and changed.headers["etag"] != tag and changed.json()["state"] == "cancelled"


@pytest.mark.parametrize("wait", ["-1", "61", "nan", "inf", "soon"])
def test_waits_out_of_range_are_refused(idle: Stack, wait: str) -> None:
    assert idle.http.get(f"/v1/jobs/{queued(idle)}?wait={wait}").status_code == 422


def test_a_wait_ends_with_its_time(idle: Stack) -> None:
    url = f"/v1/jobs/{queued(idle)}?wait=1.5"
    tag = idle.http.get(url.partition("?")[0]).headers["etag"]
    for headers, status in (({"If-None-Match": tag}, 304), ({}, 200)):
        began = time.monotonic()
        assert idle.http.get(url, headers=headers).status_code == status
        assert 1.4 < time.monotonic() - began < 5
    began = time.monotonic()
    assert idle.http.get(url, headers={"If-None-Match": 'W/"old"'}).status_code == 200
    assert time.monotonic() - began < 1, "what is news already is not waited for"


def test_a_wait_ends_with_a_change_and_a_finished_job_is_not_waited_for(idle: Stack) -> None:
    job_id = queued(idle)
    url = f"/v1/jobs/{job_id}"
    tag = idle.http.get(url).headers["etag"]
    with ThreadPoolExecutor(1) as pool:
        poll = pool.submit(idle.http.get, f"{url}?wait=20", headers={"If-None-Match": tag})
        time.sleep(1)
        assert not poll.done()
        began = time.monotonic()
        idle.http.post(f"{url}/cancel")
        answer = poll.result(10)
    assert answer.status_code == 200 and answer.json()["state"] == "cancelled" and time.monotonic() - began < 3
    assert "retry-after" not in answer.headers
    began = time.monotonic()
    again = idle.http.get(f"{url}?wait=20", headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304 and time.monotonic() - began < 2


@pytest.mark.slow
def test_a_hundred_who_wait_occupy_no_thread(idle: Stack) -> None:
    """The pool has 40 threads; with 100 requests asleep in it nothing else would be answered."""
    job_id = queued(idle)
    url = f"http://127.0.0.1:{idle.port}/v1/jobs/{job_id}?wait=30"
    limits = httpx.Limits(max_connections=None)
    with httpx.Client(trust_env=False, timeout=40, limits=limits) as http, ThreadPoolExecutor(100) as pool:
        polls = [pool.submit(http.get, url) for _ in range(100)]
        time.sleep(2)
        began = time.monotonic()
        assert idle.http.get("/v1/jobs").status_code == 200
        assert time.monotonic() - began < 2 and not any(poll.done() for poll in polls)
        idle.http.post(f"/v1/jobs/{job_id}/cancel")
        assert {poll.result(20).json()["state"] for poll in polls} == {"cancelled"}


@pytest.mark.slow
def test_more_than_the_server_can_hold_are_told_to_come_back(stack: Stack) -> None:
    url = f"/v1/jobs/{queued(stack)}"
    request = f"GET {url}?wait=60 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
    waiting: list[socket.socket] = []

    def one_more() -> None:
        waiting.append(socket.create_connection(("127.0.0.1", stack.port)))
        waiting[-1].sendall(request)

    def full() -> bool:
        one_more()  # an earlier look may have taken the place of one of them
        return stack.http.get(f"{url}?wait=0.1").status_code == 503

    for _ in range(MOST_OF_ONE):
        one_more()
    stack.until(full, what="all places are taken")
    for more in (f"{url}?wait=5", f"{url}/events/stream"):
        answer = stack.http.get(more)
        assert answer.status_code == 503 and answer.headers["retry-after"] == "15"
        assert answer.headers["content-type"] == "application/problem+json"
    assert stack.http.get(url).status_code == 200, "who does not wait is answered"
    for connection in waiting:
        connection.close()
    stack.until(lambda: stack.http.get(f"{url}?wait=0.1").status_code == 200, what="their places are free again")


def test_the_client_waits_with_few_requests(shared: Stack) -> None:
    job_id = submit(shared.http, commit(shared.http, scan_files(steps=6, pause=0.3)))
    requests: list[str] = []

    class Counting(httpx.HTTPTransport):
        def handle_request(self, request: httpx.Request) -> httpx.Response:
            requests.append(str(request.url))
            return super().handle_request(request)

    messages: list[str | None] = []
    with Client(f"http://127.0.0.1:{shared.port}", transport=Counting()) as client:
        job = client.wait(job_id, lambda job: messages.append(job.message))
    assert job.state == "succeeded" and len(set(messages)) >= 4
    assert len(requests) == len(messages), "each answer was news"
    assert all("wait=" in url for url in requests[1:])
