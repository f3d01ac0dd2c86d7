"""What a job would cost, and jobs made from earlier ones."""

from __future__ import annotations

from uuid import uuid4

import pytest

from .stack import Stack, commit, scan_files, submit


@pytest.fixture(scope="module")
def scan_id(shared: Stack) -> str:
    return commit(shared.http, scan_files())


def test_an_estimate_grows_with_what_is_asked_for_and_runs_nothing(shared: Stack, scan_id: str) -> None:
    before = len(shared.http.get("/v1/jobs").json()["jobs"])

    def cost(**options: object) -> dict[str, float]:
        answer = shared.http.post("/v1/jobs/validate", json={"scan_id": scan_id, "options": options})
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    plain, many = cost(), cost(splats=3_000_000)
    assert 0 < plain["memory_bytes"] < many["memory_bytes"] and plain["disk_bytes"] < many["disk_bytes"]
    assert cost(quality="fine")["seconds"] >= plain["seconds"] >= cost(quality="preview")["seconds"]
    assert plain["options"]["calibrate"] == "full"  # type: ignore[index]
    assert len(shared.http.get("/v1/jobs").json()["jobs"]) == before


def test_what_a_submission_would_refuse_is_refused(shared: Stack, scan_id: str) -> None:
    for body in ({"scan_id": scan_id, "options": {"quality": "divine"}}, {"scan_id": str(uuid4())}):
        answers = [shared.http.post(path, json=body) for path in ("/v1/jobs/validate", "/v1/jobs")]
        assert [answer.status_code for answer in answers] == [422, 422]
        assert answers[0].json()["errors"] == answers[1].json()["errors"]


def test_priority_is_kept_and_orders_the_queue(shared: Stack, scan_id: str) -> None:
    blocker = submit(shared.http, commit(shared.http, scan_files(steps=400, pause=0.05)))
    shared.wait(blocker, "running")
    ids = {}
    for priority in ("low", "normal", "high"):
        answer = shared.http.post("/v1/jobs", json={"scan_id": scan_id, "priority": priority})
        ids[priority] = answer.json()["id"]
    assert {p: shared.job(i)["queue_position"] for p, i in ids.items()} == {"high": 1, "normal": 2, "low": 3}
    assert shared.job(ids["high"])["priority"] == "high"
    shared.http.post(f"/v1/jobs/{blocker}/cancel")
    ends = {p: shared.wait(i, "succeeded")["finished_at"] for p, i in ids.items()}
    assert sorted(ends, key=ends.__getitem__) == ["high", "normal", "low"]
    assert shared.http.post("/v1/jobs", json={"scan_id": scan_id, "priority": "mine"}).status_code == 422


@pytest.mark.slow
def test_a_restart_goes_on_from_where_a_cancelled_job_was(shared: Stack) -> None:
    job_id = submit(shared.http, commit(shared.http, scan_files(steps=60, pause=0.05)), seed=3)
    shared.until(lambda: shared.job(job_id)["progress"] > 0.3, what="some progress")
    shared.http.post(f"/v1/jobs/{job_id}/cancel")
    cancelled = shared.wait(job_id, "cancelled")
    answer = shared.http.post(cancelled["links"]["restart"], json={})
    assert answer.status_code == 202 and answer.headers["Location"].endswith(answer.json()["id"])
    again = shared.wait(answer.json()["id"], "succeeded", "failed")
    assert (again["state"], again["restart_of"], again["options"]["seed"]) == ("succeeded", job_id, 3)
    events = shared.http.get(again["links"]["events"]).json()["events"]
    assert any("Going on from the checkpoint" in event["message"] for event in events)
    assert min(event["step"] for event in events if event["stage"] == "level") > 1


def test_a_restart_with_other_options_is_another_job(shared: Stack, scan_id: str) -> None:
    first = shared.wait(submit(shared.http, scan_id, seed=3), "succeeded")
    key = {"Idempotency-Key": str(uuid4())}
    answers = [
        shared.http.post(f"/v1/jobs/{first['id']}/restart", json={"options": {"quality": "preview"}}, headers=key)
        for _ in range(2)
    ]
    assert answers[0].json()["id"] == answers[1].json()["id"] != first["id"]
    again = shared.wait(answers[0].json()["id"], "succeeded")
    assert (again["options"]["quality"], again["options"]["seed"]) == ("preview", 3)
    manifest = shared.http.get(again["links"]["results"]).json()
    assert manifest["options"]["quality"] == "preview"
    bad = shared.http.post(f"/v1/jobs/{first['id']}/restart", json={"options": {"quality": "divine"}})
    assert bad.status_code == 422


def test_only_a_finished_job_is_restarted(shared: Stack) -> None:
    job_id = submit(shared.http, commit(shared.http, scan_files(steps=400, pause=0.05)))
    assert shared.http.post(f"/v1/jobs/{job_id}/restart", json={}).status_code == 409
    assert shared.http.post(f"/v1/jobs/{uuid4()}/restart", json={}).status_code == 404
    shared.http.post(f"/v1/jobs/{job_id}/cancel")
    shared.wait(job_id, "cancelled")
