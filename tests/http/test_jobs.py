"""Jobs over HTTP without a worker: order, cancelling, and how errors are told."""

from __future__ import annotations

from typing import Any
from uuid import uuid4

import httpx
import pytest

from splatcore.options import describe

from .stack import Stack, commit, scan_files, submit


@pytest.fixture(scope="module")
def idle(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A service without a worker."""
    with Stack(tmp_path_factory.mktemp("idle")) as running:
        yield running


@pytest.fixture
def http(idle: Stack) -> httpx.Client:
    return idle.http


def test_the_queue_and_its_list(http: httpx.Client) -> None:
    scan_id = commit(http, scan_files())
    ids = [submit(http, scan_id) for _ in range(5)]
    jobs = [http.get(f"/v1/jobs/{job_id}") for job_id in ids]
    assert [job.json()["queue_position"] for job in jobs] == [1, 2, 3, 4, 5]
    assert int(jobs[0].headers["retry-after"]) >= 1
    page = http.get("/v1/jobs?state=queued&limit=2").json()
    assert [job["id"] for job in page["jobs"]] == ids[:2:-1]
    rest = http.get(f"/v1/jobs?state=queued&limit=50&before={page['next']}").json()
    assert [job["id"] for job in rest["jobs"]] == ids[2::-1] and rest["next"] is None
    for job_id in ids:
        assert http.post(f"/v1/jobs/{job_id}/cancel").json()["state"] == "cancelled"
    assert http.get("/v1/jobs?state=queued").json()["jobs"] == []


def test_a_waiting_job_gets_another_place(http: httpx.Client) -> None:
    scan_id = commit(http, scan_files())
    first, second = submit(http, scan_id), submit(http, scan_id)
    changed = http.patch(f"/v1/jobs/{second}", json={"priority": "high"})
    assert changed.status_code == 200
    assert (changed.json()["priority"], changed.json()["queue_position"]) == ("high", 1)
    assert http.get(f"/v1/jobs/{first}").json()["queue_position"] == 2
    assert http.patch(f"/v1/jobs/{second}", json={"priority": "highest"}).status_code == 422
    assert http.patch(f"/v1/jobs/{uuid4()}", json={"priority": "low"}).status_code == 404
    for job_id in (first, second):
        http.post(f"/v1/jobs/{job_id}/cancel")
    finished = http.patch(f"/v1/jobs/{first}", json={"priority": "low"})
    assert finished.status_code == 409 and finished.json()["type"] == "urn:splatct:problem:finished"


def test_a_queued_job_cannot_be_deleted_a_cancelled_one_can(http: httpx.Client, idle: Stack) -> None:
    job_id = submit(http, commit(http, scan_files()))
    assert http.delete(f"/v1/jobs/{job_id}").status_code == 409
    http.post(f"/v1/jobs/{job_id}/cancel")
    assert http.delete(f"/v1/jobs/{job_id}").status_code == 204
    assert not (idle.data / "jobs" / job_id).exists()


def test_options_are_those_of_the_engine(http: httpx.Client) -> None:
    assert http.get("/v1/options").json() == {"options": describe()}


@pytest.mark.parametrize(
    "options", [{"calibrate": "maybe"}, {"colour": 1}, {"splats": 5}, {"seed": 1.5}, {"dssim": "x"}, {"splats": [1]}]
)
def test_bad_options_are_refused(http: httpx.Client, options: dict[str, Any]) -> None:
    scan_id = commit(http, scan_files())
    answer = http.post("/v1/jobs", json={"scan_id": scan_id, "options": options})
    assert answer.status_code == 422 and answer.json()["errors"][0]["where"] == "options"


UNKNOWN = [
    ("GET", "/v1/uploads/{}"),
    ("PUT", "/v1/uploads/{}/files/scan.json"),
    ("DELETE", "/v1/uploads/{}"),
    ("POST", "/v1/uploads/{}/commit"),
    ("GET", "/v1/scans/{}"),
    ("DELETE", "/v1/scans/{}"),
    ("GET", "/v1/webhooks/{}"),
    ("DELETE", "/v1/webhooks/{}"),
    ("GET", "/v1/webhooks/{}/deliveries"),
    ("GET", "/v1/jobs/{}"),
    ("DELETE", "/v1/jobs/{}"),
    ("POST", "/v1/jobs/{}/cancel"),
    ("GET", "/v1/jobs/{}/events"),
    ("GET", "/v1/jobs/{}/events/stream"),
    ("GET", "/v1/jobs/{}/log"),
    ("GET", "/v1/jobs/{}/results"),
    ("GET", "/v1/jobs/{}/results/volume.tif"),
    ("GET", "/v1/jobs/{}/slices/x/0.png"),
    ("GET", "/v1/jobs/{}/report"),
    ("POST", "/v1/jobs/{}/restart"),
    ("POST", "/v1/jobs/{}/pin"),
    ("DELETE", "/v1/jobs/{}/pin"),
    ("POST", "/v1/scans/{}/pin"),
    ("DELETE", "/v1/scans/{}/pin"),
    ("GET", "/v1/jobs/{}/partial"),
    ("GET", "/v1/jobs/{}/partial/volume.tif"),
]


def test_unknown_ids_cover_every_route(http: httpx.Client) -> None:
    paths = http.get("/openapi.json").json()["paths"]
    with_id = {(method.upper(), path) for path, methods in paths.items() for method in methods if "{" in path}
    makes_one = {("PUT", "/v1/jobs/{job_id}"), ("PUT", "/v1/uploads/{upload_id}")}
    file = "/v1/uploads/{upload_id}/files/{name}"
    elsewhere = {(method, file) for method in ("HEAD", "PATCH", "OPTIONS")}  # test_resume.py: no JSON, other headers
    elsewhere |= {("POST", "/v1/uploads/{upload_id}/files")}  # test_growing.py: needs a body
    elsewhere |= {("PATCH", "/v1/jobs/{job_id}")}  # below, likewise
    assert with_id >= makes_one | elsewhere
    assert len(with_id - makes_one - elsewhere) == len(UNKNOWN)


@pytest.mark.parametrize(("method", "path"), UNKNOWN)
def test_unknown_ids_are_404_and_malformed_ones_422(http: httpx.Client, method: str, path: str) -> None:
    missing = http.request(method, path.format(uuid4()))
    assert (missing.status_code, missing.json()["status"]) == (404, 404)
    malformed = http.request(method, path.format("' OR 1=1"))
    assert malformed.status_code == 422 and "OR 1=1" not in malformed.text


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (("GET", "/nowhere", {}), 404),
        (("PATCH", "/v1/jobs", {}), 405),
        (("POST", "/v1/jobs", {"content": b"{", "headers": {"content-type": "application/json"}}), 422),
        (("POST", "/v1/jobs", {"json": {"scan_id": "secret-value"}}), 422),
        (("POST", "/v1/jobs", {"json": {"scan_id": str(uuid4()), "colour": "secret-value"}}), 422),
        (("POST", "/v1/jobs", {"content": b" " * (2 << 20)}), 413),
        (("POST", "/v1/jobs", {"content": iter([b" " * (1 << 20)] * 3)}), 413),
        (("GET", "/v1/jobs?limit=0", {}), 422),
        (("GET", "/healthz", {"headers": {"host": "attacker.example"}}), 421),
        (("POST", "/v1/jobs", {"json": {}, "headers": {"sec-fetch-site": "cross-site"}}), 403),
    ],
)
def test_errors_are_problems_and_echo_nothing(
    http: httpx.Client, request_: tuple[str, str, dict[str, Any]], status: int
) -> None:
    method, path, more = request_
    answer = http.request(method, path, **more)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["status"] == status and answer.json()["type"].startswith("urn:splatct:problem:")
    assert "secret-value" not in answer.text and "attacker" not in answer.text
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_not_ready_without_a_worker(http: httpx.Client) -> None:
    answer = http.get("/readyz")
    assert answer.status_code == 503
    assert answer.json() == {"ready": False, "database": True, "redis": True, "disk": True, "workers": 0}
    assert http.get("/healthz").json() == {"status": "alive"}


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost:8080", 200),
        ("127.0.0.1", 200),
        ("[::1]:8080", 200),
        ("127.1.2.3:1", 200),
        ("127.0.0.1.attacker.example", 421),
        ("[::2]:8080", 421),
        ("10.0.0.1:8080", 421),
        ("", 421),
    ],
)
def test_only_loopback_names_are_answered(http: httpx.Client, host: str, status: int) -> None:
    assert http.get("/healthz", headers={"host": host}).status_code == status
