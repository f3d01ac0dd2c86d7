"""What a tenant may take: bytes, jobs at a time, open uploads, sessions; by the settings, or of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from uuid import uuid4

import httpx
import pytest

from splatcore.estimate import estimate
from splatcore.options import Options

from .stack import PYTHONPATH, SCAN, Stack, announce, commit, scan_files, send, submit

FILES = scan_files()
SIZE = sum(map(len, FILES.values()))
BODY = {"name": "s", "files": [{"name": name, "size": len(data)} for name, data in FILES.items()]}
JOB = estimate(12, 16, 16, SCAN["volume"]["shape"], Options()).disk_bytes


@pytest.fixture(scope="module")
def narrow(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """Room for three scans and two jobs a tenant, and three sessions a key. No worker."""
    running = Stack(tmp_path_factory.mktemp("narrow"))
    running.environment |= {
        "SPLATCT_TENANT_GIB": str(3.5 * SIZE / (1 << 30)),
        "SPLATCT_TENANT_JOBS": "2",
        "SPLATCT_RATE_PER_S": "0",
        "SPLATCT_KEY_SESSIONS": "3",
    }
    with running:
        yield running


@pytest.fixture
def name() -> str:
    return f"t-{uuid4().hex[:8]}"


@pytest.fixture
def tenant(narrow: Stack, name: str) -> Iterator[httpx.Client]:
    """A client of a tenant that has nothing yet."""
    with narrow.client(narrow.new_key(name, "admin")[1]) as http:
        yield http


@pytest.fixture
def roomy(narrow: Stack, name: str, tenant: httpx.Client) -> httpx.Client:
    """The same, of one that may keep what it likes."""
    own(narrow, name, "--max-bytes", "none")
    return tenant


def own(stack: Stack, *arguments: str, ok: bool = True) -> dict[str, object]:
    """What `splatct keys tenant` says."""
    command = [sys.executable, "-m", "splatct_client", "keys", "tenant", *arguments, "--data", str(stack.data)]
    command.append("--json")
    environment = stack.environment | {"PYTHONPATH": PYTHONPATH}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode == 0) is ok, done.stderr
    return dict(json.loads(done.stdout))


def test_bytes_are_taken_when_an_upload_is_announced_and_given_back(tenant: httpx.Client) -> None:
    uploads = [announce(tenant, FILES)["id"] for _ in range(2)] + [send(tenant, FILES)]
    scan_id = tenant.post(f"/v1/uploads/{uploads[2]}/commit").json()["id"]
    full = tenant.post("/v1/uploads", json=BODY)
    assert full.status_code == 507 and full.json()["type"] == "urn:splatct:problem:quota-exceeded"
    limit = round(3.5 * SIZE)
    assert f"{SIZE} bytes are asked for; {3 * SIZE} of {limit} are taken" in full.json()["errors"][0]["what"]
    assert tenant.get("/v1/usage").json() == {
        "bytes": {"used": 3 * SIZE, "limit": limit},
        "active_jobs": {"used": 0, "limit": 2},
        "open_uploads": {"used": 2, "limit": 1000},
    }
    tenant.delete(f"/v1/uploads/{uploads[0]}")
    announce(tenant, FILES)
    assert tenant.post("/v1/uploads", json=BODY).status_code == 507
    tenant.delete(f"/v1/scans/{scan_id}")
    announce(tenant, FILES)


def test_what_can_never_fit_is_another_answer(tenant: httpx.Client) -> None:
    body = {"name": "s", "files": [{"name": "scan.json", "size": 4 * SIZE}]}
    answer = tenant.post("/v1/uploads", json=body)
    assert answer.status_code == 413 and f"{4 * SIZE} bytes together" in answer.json()["errors"][0]["what"]
    assert tenant.get("/v1/usage").json()["bytes"]["used"] == 0


def test_of_uploads_at_once_no_more_than_fit_are_taken(tenant: httpx.Client) -> None:
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: tenant.post("/v1/uploads", json=BODY).status_code, range(16)))
    assert sorted(answers) == [201] * 3 + [507] * 13


def test_a_tenant_s_jobs_at_a_time(narrow: Stack, roomy: httpx.Client) -> None:
    tenant = roomy
    scan_id = commit(tenant, FILES)
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: tenant.post("/v1/jobs", json={"scan_id": scan_id}), range(8)))
    assert sorted(answer.status_code for answer in answers) == [202] * 2 + [429] * 6
    refused = tenant.put(f"/v1/jobs/{uuid4()}", json={"scan_id": scan_id})
    assert refused.status_code == 429 and int(refused.headers["retry-after"]) > 0
    assert "2 are queued or running, 2 may be" in refused.json()["errors"][0]["what"]
    assert not list((narrow.data / "jobs").glob(".new-*")), "nothing is left of what was refused"
    own(narrow, "another", "--max-bytes", "none")
    with narrow.client(narrow.new_key("another", "admin")[1]) as another:
        submit(another, commit(another, FILES))
    first = next(answer.json()["id"] for answer in answers if answer.status_code == 202)
    tenant.post(f"/v1/jobs/{first}/cancel")
    submit(tenant, scan_id)


def test_a_repeated_submission_needs_no_second_place(roomy: httpx.Client) -> None:
    tenant = roomy
    scan_id, job_id = commit(tenant, FILES), uuid4()
    submit(tenant, scan_id)
    answers = [tenant.put(f"/v1/jobs/{job_id}", json={"scan_id": scan_id}).status_code for _ in range(2)]
    assert answers == [202, 202]


def test_a_job_is_refused_that_the_quota_could_not_keep(narrow: Stack, name: str, tenant: httpx.Client) -> None:
    scan_id = commit(tenant, FILES)
    refused = tenant.post("/v1/jobs", json={"scan_id": scan_id})
    assert refused.status_code == 507 and refused.json()["type"] == "urn:splatct:problem:quota-exceeded"
    assert f"{JOB} bytes are asked for; {SIZE} of" in refused.json()["errors"][0]["what"]
    assert not list((narrow.data / "jobs").glob(".new-*")), "nothing is left of it"
    (warning,) = tenant.post("/v1/jobs/validate", json={"scan_id": scan_id}).json()["warnings"]
    assert f"it may write {JOB} bytes, the quota has" in warning
    own(narrow, name, "--max-bytes", str(SIZE + 2 * JOB - 1))
    submit(tenant, scan_id)
    assert tenant.get("/v1/usage").json()["bytes"]["used"] == SIZE + JOB
    assert tenant.post("/v1/jobs", json={"scan_id": scan_id}).status_code == 507, "the first one's may all be written"


def test_results_count_as_they_are(stack: Stack) -> None:
    """And what is deleted does no longer."""
    scan_id = commit(stack.http, scan_files(result_bytes=30_000))
    sent = stack.http.get("/v1/usage").json()["bytes"]["used"]
    job_id = submit(stack.http, scan_id)
    assert stack.http.get("/v1/usage").json()["bytes"]["used"] == sent + JOB
    stack.start_worker()
    stack.wait(job_id, "succeeded")
    folder = stack.data / "jobs" / job_id
    left = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file() and file.name != "job.json")
    stack.until(lambda: stack.http.get("/v1/usage").json()["bytes"]["used"] == sent + left, 10, "it is measured")
    assert left > 30_000
    stack.http.delete(f"/v1/jobs/{job_id}")
    assert stack.http.get("/v1/usage").json()["bytes"]["used"] == sent


def test_open_uploads(narrow: Stack, name: str, roomy: httpx.Client) -> None:
    own(narrow, name, "--max-uploads", "2")
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda _: roomy.post("/v1/uploads", json=BODY), range(6)))
    assert sorted(answer.status_code for answer in answers) == [201] * 2 + [429] * 4
    refused = next(answer for answer in answers if answer.status_code == 429)
    assert int(refused.headers["retry-after"]) > 0 and "2 are open, 2 may be" in refused.json()["errors"][0]["what"]
    first = next(answer.json()["id"] for answer in answers if answer.status_code == 201)
    assert roomy.post(f"/v1/uploads/{first}/files", json={"files": [{"name": "b", "size": 1}]}).status_code == 201
    roomy.delete(f"/v1/uploads/{first}")
    commit(roomy, FILES)
    announce(roomy, FILES)


def test_sessions_of_one_key(narrow: Stack) -> None:
    key, other = narrow.new_key("a", "read")[1], narrow.new_key("a", "read")[1]
    with narrow.client() as http, narrow.client() as second:
        answers = [http.post("/v1/session", json={"key": key}) for _ in range(4)]
        assert [answer.status_code for answer in answers] == [201] * 3 + [429]
        assert "3 sessions" in answers[3].json()["errors"][0]["what"]
        assert 0 < int(answers[3].headers["retry-after"]) <= 12 * 3600
        assert second.post("/v1/session", json={"key": other}).status_code == 201, "another key's are its own"
        csrf = {"X-CSRF-Token": http.get("/v1/session").json()["csrf"]}
        assert http.delete("/v1/session", headers=csrf).status_code == 204
        assert http.post("/v1/session", json={"key": key}).status_code == 201


def test_a_tenant_s_own_quotas(narrow: Stack, name: str, tenant: httpx.Client) -> None:
    server = own(narrow, name)
    assert server == {"tenant": name, "bytes": round(3.5 * SIZE), "active_jobs": 2, "open_uploads": 1000}
    assert own(narrow, name, "--max-bytes", "2G", "--max-jobs", "7")["bytes"] == 2 << 30
    assert own(narrow, name, "--max-uploads", "none") == {
        "tenant": name, "bytes": 2 << 30, "active_jobs": 7, "open_uploads": None
    }  # fmt: skip
    usage = tenant.get("/v1/usage").json()
    assert (usage["bytes"]["limit"], usage["active_jobs"]["limit"]) == (2 << 30, 7)
    assert usage["open_uploads"]["limit"] is None
    restored = own(narrow, name, "--max-bytes", "default", "--max-jobs", "default", "--max-uploads", "default")
    assert restored == server


@pytest.mark.parametrize(
    ("option", "given"),
    [("--max-bytes", "lots"), ("--max-bytes", "0"), ("--max-bytes", "99999999999999T"), ("--max-jobs", "2G"),
     ("--max-uploads", "-1")],
    ids=["word", "zero", "huge", "unit", "negative"],
)  # fmt: skip
def test_quotas_that_are_none_are_refused(narrow: Stack, option: str, given: str) -> None:
    said = own(narrow, "lab", f"{option}={given}", ok=False)
    assert option in str(said["error"]) and given in str(said["error"])
