"""What belongs to one tenant does not exist for another: every route of the app, with ids of somebody else's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import pytest
from fastapi.routing import iter_route_contexts

from server.app import create_app
from server.settings import Settings

from .stack import Stack, announce, commit, scan_files, submit

NO_IDS = {  # nothing in the request names a thing; what they list is tested below
    "GET /", "GET /healthz", "GET /readyz", "GET /metrics", "GET /openapi.json", "HEAD /openapi.json",
    "GET /v1/options", "GET /v1/jobs", "GET /v1/events", "GET /v1/scans", "POST /v1/uploads", "OPTIONS /v1/uploads",
    "GET /sign-in", "GET /v1/usage", "GET /v1/webhooks", "POST /v1/webhooks",
    "POST /v1/session", "GET /v1/session", "DELETE /v1/session",
    "GET /jobs/{job_id}",  # a shell that is the same for every id
    "OPTIONS /v1/uploads/{upload_id}/files/{name}",  # what the server can do, the same for every id
}  # fmt: skip

FOREIGN = [
    "GET /v1/uploads/{upload_id}",
    "PUT /v1/uploads/{upload_id}",
    "PUT /v1/uploads/{upload_id}/files/{name}",
    "PATCH /v1/uploads/{upload_id}/files/{name}",
    "HEAD /v1/uploads/{upload_id}/files/{name}",
    "DELETE /v1/uploads/{upload_id}",
    "POST /v1/uploads/{upload_id}/files",
    "POST /v1/uploads/{upload_id}/commit",
    "GET /v1/scans/{scan_id}",
    "DELETE /v1/scans/{scan_id}",
    "PUT /v1/jobs/{job_id}",
    "GET /v1/jobs/{job_id}",
    "PATCH /v1/jobs/{job_id}",
    "POST /v1/jobs/{job_id}/restart",
    "POST /v1/jobs/{job_id}/pin",
    "DELETE /v1/jobs/{job_id}/pin",
    "POST /v1/scans/{scan_id}/pin",
    "DELETE /v1/scans/{scan_id}/pin",
    "POST /v1/jobs/{job_id}/cancel",
    "DELETE /v1/jobs/{job_id}",
    "GET /v1/jobs/{job_id}/events",
    "GET /v1/jobs/{job_id}/events/stream",
    "GET /v1/jobs/{job_id}/log",
    "GET /v1/jobs/{job_id}/results",
    "GET /v1/jobs/{job_id}/partial",
    "GET /v1/jobs/{job_id}/partial/{file}",
    "GET /v1/jobs/{job_id}/report",
    "GET /v1/jobs/{job_id}/results/{file}",
    "GET /v1/jobs/{job_id}/slices/{axis}/{index}.png",
    "GET /v1/webhooks/{webhook_id}",
    "GET /v1/webhooks/{webhook_id}/deliveries",
    "DELETE /v1/webhooks/{webhook_id}",
]
MAKES_ONE = ("PUT /v1/jobs/{job_id}", "PUT /v1/uploads/{upload_id}")  # under an id that nobody has
IN_BODY = {
    "POST /v1/jobs", "POST /v1/jobs/validate",
    "POST /v1/imports",  # names a folder of the tenant's: see test_importing.py
}  # fmt: skip


@dataclass
class Two:
    """Two tenants of one server; the first has one of everything."""

    first: httpx.Client
    second: httpx.Client
    upload_id: str
    scan_id: str
    job_id: str
    webhook_id: str
    own_scan_id: str  # of the second

    @property
    def ids(self) -> dict[str, str]:
        names = ("upload_id", "scan_id", "job_id", "webhook_id")
        return {name: getattr(self, name) for name in names}

    def ask(self, http: httpx.Client, call: str, ids: dict[str, str]) -> httpx.Response:
        method, path = call.split()
        url = path.format(**ids, name="scan.json", file="volume.tif", axis="z", index=0)
        more: dict[str, Any] = {}
        if call == "PUT /v1/uploads/{upload_id}":
            more["json"] = {"name": "x", "files": [{"name": "scan.json", "size": 1}]}
        elif method == "PUT" and "uploads" in path:
            more["content"] = b"x"
        if method == "PATCH" and "jobs" in path:
            more["json"] = {"priority": "high"}
        elif method == "PATCH":
            more = {
                "content": b"x",
                "headers": {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"},
            }
        if path.endswith("/files"):
            more["json"] = {"files": [{"name": "more.tif", "size": 1}]}
        if path.endswith("/restart"):
            more["json"] = {}
        elif method in ("POST", "PUT") and "/jobs" in path and not path.endswith(("/cancel", "/pin")):
            more["json"] = {"scan_id": self.own_scan_id}
        return http.request(method, url, **more)


@pytest.fixture(scope="module")
def two(keyed: Stack) -> Iterator[Two]:
    with keyed.client(keyed.new_key("neighbour", "admin")[1]) as second:
        scan_id = commit(keyed.http, scan_files())
        upload_id = announce(keyed.http, scan_files())["id"]
        job_id = submit(keyed.http, scan_id)
        keyed.wait(job_id, "succeeded")
        webhook_id = keyed.http.post("/v1/webhooks", json={"url": "https://lab.example.org/done"}).json()["id"]
        yield Two(keyed.http, second, upload_id, scan_id, job_id, webhook_id, commit(second, scan_files()))


def test_no_route_is_left_out() -> None:
    """A new route fails here until it says, above, whether it takes an id."""
    app = create_app(Settings(data=Path("nowhere")))
    routes = {
        f"{method} {context.path}"
        for context in iter_route_contexts(app.routes)
        for method in getattr(context, "methods", None) or ()
    }
    assert routes == NO_IDS | set(FOREIGN) | IN_BODY


@pytest.mark.parametrize("call", FOREIGN)
def test_a_foreign_id_is_not_there(two: Two, call: str) -> None:
    foreign = two.ask(two.second, call, two.ids)
    assert foreign.status_code == 404, foreign.text
    if call not in MAKES_ONE:
        nobody = two.ask(two.second, call, dict.fromkeys(two.ids, str(uuid4())))
        assert (nobody.status_code, nobody.content) == (404, foreign.content), "no word betrays that there is one"
    if call.startswith("GET"):
        none = 409 if "/partial" in call else 200  # it succeeded, so there is nothing partial
        assert two.ask(two.first, call, two.ids).status_code == none, "its owner sees it"


def test_what_was_asked_for_is_still_whole(two: Two) -> None:
    """Of all the deletions and cancellations above, none did anything."""
    for call in FOREIGN:
        if not call.startswith("GET"):
            two.ask(two.second, call, two.ids)
    assert two.first.get(f"/v1/uploads/{two.upload_id}").json()["state"] == "open"
    assert two.first.get(f"/v1/scans/{two.scan_id}").status_code == 200
    assert two.first.get(f"/v1/jobs/{two.job_id}/results/volume.tif").status_code == 200
    files = two.first.get(f"/v1/uploads/{two.upload_id}").json()["files"]
    assert [file["received"] for file in files] == [0, 0]


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/jobs/validate"])
def test_a_foreign_scan_cannot_be_reconstructed(two: Two, path: str) -> None:
    answers = [two.second.post(path, json={"scan_id": scan}) for scan in (two.scan_id, str(uuid4()))]
    assert [answer.status_code for answer in answers] == [422, 422] and answers[0].content == answers[1].content


def test_lists_hold_one_s_own(two: Two) -> None:
    assert two.job_id in {job["id"] for job in two.first.get("/v1/jobs?limit=500").json()["jobs"]}
    assert two.job_id not in {job["id"] for job in two.second.get("/v1/jobs?limit=500").json()["jobs"]}
    assert two.second.get(f"/v1/jobs?before={two.job_id}").status_code == 404
    assert [scan["id"] for scan in two.second.get("/v1/scans").json()["scans"]] == [two.own_scan_id]
    assert two.second.get("/v1/webhooks").json() == {"webhooks": []}
    assert two.own_scan_id not in {scan["id"] for scan in two.first.get("/v1/scans").json()["scans"]}


def test_an_idempotency_key_is_a_tenant_s_own(two: Two) -> None:
    name = {"Idempotency-Key": f"same-{uuid4()}"}
    one = two.first.post("/v1/jobs", json={"scan_id": two.scan_id}, headers=name)
    other = two.second.post("/v1/jobs", json={"scan_id": two.own_scan_id}, headers=name)
    assert (one.status_code, other.status_code) == (202, 202)
    assert one.json()["id"] != other.json()["id"] and "idempotency-replayed" not in other.headers


def test_the_queue_shows_one_s_own_place(stack: Stack) -> None:
    """No worker runs here."""
    with stack.client(stack.new_key("a", "admin")[1]) as a, stack.client(stack.new_key("b", "admin")[1]) as b:
        scan_of_a, scan_of_b = commit(a, scan_files()), commit(b, scan_files())
        waiting = [submit(a, scan_of_a) for _ in range(3)]
        later = submit(b, scan_of_b)
        assert b.get(f"/v1/jobs/{later}").json()["queue_position"] == 1
        assert [a.get(f"/v1/jobs/{job}").json()["queue_position"] for job in waiting] == [1, 2, 3]
        changed = b.get(f"/v1/jobs/{later}?wait=1")  # as the watch tells it
        assert changed.json()["queue_position"] == 1


def test_a_foreign_head_ends_no_upload(two: Two) -> None:
    """HEAD takes a file over from the request that writes it: that must be its owner's alone."""
    import threading

    files = scan_files()
    upload = announce(two.first, files)["id"]
    url = f"/v1/uploads/{upload}/files/projections.tif"
    data, begun, go_on = files["projections.tif"], threading.Event(), threading.Event()

    def body() -> Iterator[bytes]:
        yield data[:100]
        begun.set()
        go_on.wait(10)
        yield data[100:]

    answers: list[httpx.Response] = []
    headers = {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    writer = threading.Thread(target=lambda: answers.append(two.first.patch(url, content=body(), headers=headers)))
    writer.start()
    assert begun.wait(10)
    assert two.second.head(url).status_code == 404
    go_on.set()
    writer.join()
    assert answers[0].status_code == 204 and answers[0].headers["upload-offset"] == str(len(data))
