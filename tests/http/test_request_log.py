"""One log line per request, in JSON or as text, under an id that the caller may choose."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import pytest
from fastapi import FastAPI
from prometheus_client import CollectorRegistry

from server import logs, problems
from server.metrics import Metrics
from server.observe import Observer

from .stack import Stack, commit, scan_files, submit


def lines(stack: Stack, request_id: str) -> list[dict[str, Any]]:
    """The server's lines that bear an id."""
    log = stack.data.parent / "log.txt"
    stack.until(lambda: request_id in log.read_text(), 5, f"{request_id} in the log")
    parsed = [json.loads(line) for line in log.read_text().splitlines() if line.startswith("{")]
    return [line for line in parsed if line.get("request_id") == request_id]


def test_a_request_is_one_line_under_the_id_that_it_gave(shared: Stack) -> None:
    job_id = submit(shared.http, commit(shared.http, scan_files()))
    answer = shared.http.get(f"/v1/jobs/{job_id}", headers={"X-Request-Id": "scanner-7:42"})
    assert answer.headers["x-request-id"] == "scanner-7:42"
    (line,) = lines(shared, "scanner-7:42")
    assert line.pop("ms") >= 0 and line.pop("at").endswith("+00:00")
    assert line == {
        "level": "info",
        "logger": "splatct.request",
        "message": "request",
        "request_id": "scanner-7:42",
        "method": "GET",
        "route": "/v1/jobs/{job_id}",
        "status": 200,
        "job_id": job_id,
    }


def test_a_submission_tells_the_job_it_made(shared: Stack) -> None:
    scan_id = commit(shared.http, scan_files())
    answer = shared.http.post("/v1/jobs", json={"scan_id": scan_id})
    (line,) = lines(shared, answer.headers["x-request-id"])
    assert (line["route"], line["status"], line["job_id"]) == ("/v1/jobs", 202, answer.json()["id"])


@pytest.mark.parametrize("given", ["", "a b", "x" * 129, "naïve", '"}{"', None])
def test_other_ids_are_replaced(shared: Stack, given: str | None) -> None:
    answers = [
        shared.http.get("/healthz", headers={} if given is None else {"X-Request-Id": given.encode()}) for _ in range(2)
    ]
    ids = [answer.headers["x-request-id"] for answer in answers]
    assert len(set(ids)) == 2 and all(len(made) == 32 and made.isalnum() for made in ids)


def test_refusals_have_an_id_and_a_line_too(shared: Stack) -> None:
    for method, path, headers, body, status in (
        ("GET", f"/v1/jobs/{uuid4()}", {}, b"", 404),
        ("GET", "/nowhere/at/all", {}, b"", 404),
        ("GET", "/healthz", {"host": "elsewhere.example"}, b"", 421),
        ("POST", "/v1/jobs", {}, b" " * (2 << 20), 413),
    ):
        made = f"refused-{uuid4()}"
        answer = shared.http.request(method, path, headers={"X-Request-Id": made, **headers}, content=body)
        assert answer.status_code == status and answer.headers["x-request-id"] == made
        (line,) = lines(shared, made)
        assert line["status"] == status and "nowhere" not in json.dumps(line)


def test_plain_text_by_setting(tmp_path: Path) -> None:
    stack = Stack(tmp_path)
    stack.environment["SPLATCT_LOG_FORMAT"] = "text"
    with stack:
        stack.http.get("/healthz", headers={"X-Request-Id": "plain-1"})
        log = stack.data.parent / "log.txt"
        stack.until(lambda: "plain-1" in log.read_text(), 5, "the line")
        (line,) = [line for line in log.read_text().splitlines() if "plain-1" in line]
    assert "splatct.request INFO request request_id=plain-1 method=GET route=/healthz status=200 ms=" in line
    assert "{" not in line


@pytest.fixture
def captured() -> Iterator[list[str]]:
    """What the server's loggers write, as JSON."""
    written: list[str] = []

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            written.append(self.format(record))

    handler, logger = Keep(), logging.getLogger("splatct")
    handler.setFormatter(logs.Json())
    logger.addHandler(handler)
    level = logger.level
    logger.setLevel(logging.INFO)
    yield written
    logger.removeHandler(handler)
    logger.setLevel(level)


def test_a_bug_is_logged_and_answered_under_the_requests_id(captured: list[str]) -> None:
    app = FastAPI()
    problems.install(app)
    app.add_middleware(Observer)

    app.state.metrics = Metrics(CollectorRegistry())  # an empty one: no jobs to count

    @app.get("/bug")
    def bug() -> None:
        logging.getLogger("splatct.server").info("on the way")
        raise ZeroDivisionError

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as http:
            return await http.get("/bug", headers={"X-Request-Id": "bug-1"})

    answer = asyncio.run(ask())
    assert answer.status_code == 500 and answer.headers["x-request-id"] == "bug-1"
    told = [json.loads(line) for line in captured]
    assert {line["request_id"] for line in told} == {"bug-1"}
    assert [line["message"] for line in told] == ["on the way", "request", "GET /bug failed"]
    assert (told[1]["status"], told[1]["level"]) == (500, "warning")
    assert "ZeroDivisionError" in told[2]["traceback"]
