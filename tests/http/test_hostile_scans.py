"""Scans that attack: each is uploaded to a real server and committed. What cannot be used is refused in less than a
second and 300 MB, every bad file named; what can be used means what it says; nothing is read or written elsewhere.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator

import httpx
import numpy as np
import pytest

from .hostile import ACCEPTED, COLS, REFUSED, ROWS, VIEWS, reaching
from .stack import Stack, scan_files, send

MOST_S, MOST_MB = 1.0, 300.0


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    stack = Stack(tmp_path_factory.mktemp("hostile"))
    stack.environment |= {"SPLATCT_CHECK": "measured_check", "SPLATCT_RATE_PER_S": "0"}
    with stack as running:
        for tenant in ("attacker", "victim"):
            running.http.headers[tenant] = running.new_key(tenant, "admin")[1]
        running.http.headers["Authorization"] = f"Bearer {running.http.headers.pop('attacker')}"
        yield running


@pytest.fixture(scope="module")
def victim(measured: Stack) -> Iterator[tuple[str, httpx.Client]]:
    """A scan of another tenant, all its pixels 0.625, and its owner."""
    with measured.client(measured.http.headers["victim"]) as owner:
        upload_id = send(owner, scan_files(pixels=np.full((VIEWS, ROWS, COLS), 0.625, "float32")))
        assert owner.post(f"/v1/uploads/{upload_id}/commit").status_code == 201
        yield upload_id, owner


def everything_but(stack: Stack, upload_id: str) -> dict[str, bytes]:
    """All files of the data folder that are not this upload's, nor the database's."""
    found = {}
    for path in sorted(stack.data.rglob("*")):
        own = upload_id in path.parts or path.name.startswith(("splatct.db", "."))
        if path.is_file() and not own:
            found[str(path)] = path.read_bytes()
    return found


def commit(http: httpx.Client, upload_id: str) -> tuple[httpx.Response, float]:
    """The fastest of three: the machine may be busy with something else."""
    fastest = float("inf")
    for _ in range(3):
        started = time.perf_counter()
        answer = http.post(f"/v1/uploads/{upload_id}/commit")
        fastest = min(fastest, time.perf_counter() - started)
        if fastest < MOST_S or answer.status_code == 201:
            break
    return answer, fastest


def require_cheap(cost: dict[str, float], seconds: float) -> None:
    """The processor's time is the check's own; how long it had to wait for a processor is the machine's."""
    assert cost["peak_mb"] < MOST_MB and cost["cpu_s"] < MOST_S and seconds < MOST_S * patience(), (cost, seconds)


def patience() -> float:
    """How many want each processor, this test's own processes aside."""
    return max(1.0, os.getloadavg()[0] * 3 / (os.cpu_count() or 1))


@pytest.mark.slow
@pytest.mark.parametrize("what", REFUSED)
def test_a_hostile_scan_is_refused(measured: Stack, what: str) -> None:
    make, words = REFUSED[what]
    upload_id = send(measured.http, make())
    before = everything_but(measured, upload_id)
    answer, seconds = commit(measured.http, upload_id)
    assert answer.status_code == 422, answer.text[:2000]
    *problems, cost = answer.json()["errors"]
    assert cost["where"] == "cost", f"the check did not end by itself: {answer.text[:2000]}"
    said = "\n".join(f"{problem['where']}: {problem['what']} {problem.get('hint', '')}" for problem in problems)
    assert all(word in said for word in words), said
    assert len(answer.content) < 50_000
    require_cheap(json.loads(cost["what"]), seconds)
    assert everything_but(measured, upload_id) == before
    assert measured.http.delete(f"/v1/uploads/{upload_id}").status_code == 204


@pytest.mark.slow
@pytest.mark.parametrize("what", ACCEPTED)
def test_a_strange_scan_means_what_it_says(measured: Stack, what: str) -> None:
    make, facts = ACCEPTED[what]
    answer, seconds = commit(measured.http, send(measured.http, make()))
    assert answer.status_code == 201, answer.text[:2000]
    found = answer.json()["facts"]
    assert facts.items() <= found.items(), found
    require_cheap(found["cost"], seconds)


@pytest.mark.slow
@pytest.mark.parametrize(
    "how", ["metadata, relative", "metadata, absolute", "scan.json, relative", "scan.json, absolute"]
)
def test_no_scan_reads_another_tenants_pixels(measured: Stack, victim: tuple[str, httpx.Client], how: str) -> None:
    scan_id, owner = victim
    assert owner.get(f"/v1/scans/{scan_id}").json()["facts"]["line_integral"]["max"] == 0.625
    upload_id = send(measured.http, reaching(how, scan_id, str(measured.data)))
    mine = measured.http
    with httpx.Client(base_url=mine.base_url, headers=mine.headers, trust_env=False, timeout=30) as plain:
        answer = plain.post(f"/v1/uploads/{upload_id}/commit")  # whose own words, a path, may come back to it
    assert answer.status_code == (201 if how.startswith("metadata") else 422)
    assert "0.625" not in answer.text
    if answer.status_code == 201:
        assert answer.json()["facts"]["line_integral"]["max"] == 1.0  # its own pixels
    for path in (f"/v1/scans/{scan_id}", f"/v1/uploads/{scan_id}"):
        assert measured.http.get(path).status_code == 404
    submitted = measured.http.post("/v1/jobs", json={"scan_id": scan_id})
    assert submitted.status_code in (404, 422) and "0.625" not in submitted.text
