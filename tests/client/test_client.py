"""The client against a server in memory: retries, integrity, waiting, resuming."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from splatct_client import (
    Client,
    FileSpec,
    InputError,
    IntegrityError,
    ResultFile,
    ServerProblem,
    ServerUnreachable,
    UnexpectedAnswer,
)
from splatct_client.following import watch
from splatct_client.retry import Patience

JOB_ID = "6a1f6f0e-0000-4000-8000-000000000001"


def upload_one(client: Client, source: Path | bytes, name: str = "a.tif") -> None:
    upload = client.create_upload("scan", [FileSpec(name, 1)])
    client.put_file(upload.id, name, source)


def test_a_file_arrives_as_it_is_on_disk(client, api, tmp_path):
    path = tmp_path / "a.tif"
    path.write_bytes(bytes(range(256)) * 10000)
    seen = []
    upload = client.create_upload("scan", [FileSpec("a.tif", path.stat().st_size)])
    stored = client.put_file(upload.id, "a.tif", path, seen.append)
    assert api.uploads["a.tif"] == path.read_bytes()
    assert stored.complete
    assert seen == sorted(seen) and seen[-1] == path.stat().st_size and len(seen) > 2


def test_a_name_with_odd_characters_arrives_as_it_is(client, api):
    name = "Ränder/Projektion #1 50%?.tif"
    upload_one(client, b"x", name)
    assert api.uploads == {name: b"x"}


@pytest.mark.parametrize("status", [429, 500, 502, 503, 504])
def test_an_overloaded_server_is_asked_again(client, api, sleeps, status):
    api.faults = [("PUT /v1/uploads/up-1/files", (status, {}, b""))] * 2
    upload_one(client, b"data")
    assert api.uploads["a.tif"] == b"data"
    assert len(sleeps) == 2 and sleeps[1] > sleeps[0]


def test_retry_after_is_honoured(client, api, sleeps):
    api.faults = [("PUT /v1/uploads/up-1/files", (429, {"Retry-After": "7"}, b""))]
    upload_one(client, b"data")
    assert sleeps == [7.0]


def test_a_lost_connection_is_retried_with_the_whole_file(client, api):
    api.faults = [("PUT /v1/uploads/up-1/files", httpx.ReadError("reset"))]
    upload_one(client, b"data" * 1000)
    assert api.uploads["a.tif"] == b"data" * 1000


def test_patience_ends(client, api, sleeps):
    api.faults = [("PUT /v1/uploads/up-1/files", (503, {}, b""))] * 100
    with pytest.raises(ServerProblem, match="503") as caught:
        upload_one(client, b"data")
    assert caught.value.exit_code == 1
    assert 30 < sum(sleeps) <= 60


def test_a_submission_is_repeated_under_the_same_id(client, api):
    client.options()
    api.faults = [("PUT /v1/jobs", httpx.ReadTimeout("slow")), ("PUT /v1/jobs", (500, {}, b""))]
    assert client.submit("scan-1").id == JOB_ID
    puts = [call for call in api.calls if call.startswith("PUT")]
    assert len(puts) == 3 and len(set(puts)) == 1 and len(api.submitted) == 1
    client.submit("scan-1")
    assert api.calls[-1] not in puts, "another submission, another id"


def test_an_upload_is_asked_for_again_under_the_same_id(client, api):
    client.options()
    api.faults = [("PUT /v1/uploads", httpx.ReadTimeout("slow")), ("PUT /v1/uploads", (500, {}, b""))]
    client.create_upload("scan", [FileSpec("a.tif", 1)])
    puts = [call for call in api.calls if call.startswith("PUT")]
    assert len(puts) == 3 and len(set(puts)) == 1
    client.create_upload("scan", [FileSpec("a.tif", 1)])
    assert api.calls[-1] not in puts, "another upload, another id"


def test_an_older_server_is_never_asked_for_an_upload_twice(client, api):
    client.options()
    api.takes_ids = False
    assert client.create_upload("scan", [FileSpec("a.tif", 1)]).id == "up-1"
    api.faults = [("POST /v1/uploads", httpx.ReadTimeout("slow"))]
    with pytest.raises(ServerUnreachable):
        client.create_upload("scan", [FileSpec("a.tif", 1)])
    assert api.calls.count("POST /v1/uploads") == 2


def test_an_older_server_is_never_sent_a_job_twice(client, api):
    client.options()
    api.takes_ids = False
    assert client.submit("scan-1").id == JOB_ID
    api.faults = [("POST /v1/jobs", httpx.ReadTimeout("slow"))]
    with pytest.raises(ServerUnreachable):
        client.submit("scan-1")
    assert api.calls.count("POST /v1/jobs") == 2


def test_a_server_that_never_answered_is_reported_at_once(client, api, sleeps):
    api.faults = [("GET", httpx.ConnectError("Connection refused"))]
    with pytest.raises(ServerUnreachable, match="splatct up"):
        client.options()
    assert sleeps == []


def test_bytes_changed_on_the_way_are_noticed(client, api):
    wrong = b'{"name": "a.tif", "size": 4, "sha256": "00"}'
    api.faults = [("PUT /v1/uploads/up-1/files", (200, {}, wrong))]
    with pytest.raises(IntegrityError, match=r"a\.tif"):
        upload_one(client, b"data")


def test_every_listed_problem_is_told(client, api):
    errors = [
        {"where": "/geometry/dso_mm", "what": "got -1", "hint": "expected a length"},
        {"where": "a.tif", "what": "cut"},
    ]
    body = {"type": "urn:splatct:problem:scan", "title": "The scan cannot be used", "status": 422, "errors": errors}
    api.commit_answer = (422, {"Content-Type": "application/problem+json"}, httpx.Response(200, json=body).content)
    with pytest.raises(ServerProblem) as caught:
        client.commit("up-1")
    text = str(caught.value)
    assert "/geometry/dso_mm: got -1 (expected a length)" in text and "a.tif: cut" in text
    assert caught.value.kind == "urn:splatct:problem:scan" and caught.value.exit_code == 2


def test_an_error_without_problem_json_is_told_too(client, api):
    api.faults = [("GET", (404, {"Content-Type": "text/html"}, b"<h1>nginx</h1>"))]
    with pytest.raises(ServerProblem, match=r"Not Found.*404"):
        client.options()


def test_a_web_page_is_no_api(client, api):
    api.faults = [("GET", (200, {"Content-Type": "text/html"}, b"<h1>hello</h1>"))]
    with pytest.raises(UnexpectedAnswer, match="text/html"):
        client.options()


def test_waiting_tells_every_step(client, api):
    seen = []
    job = client.wait(JOB_ID, lambda job: seen.append(job.state))
    assert job.finished and seen == ["queued", "running", "succeeded"]


def test_waiting_outlives_a_restart_of_the_server(client, api):
    client.options()
    api.faults = [("GET /v1/jobs", httpx.ConnectError("refused"))] * 3
    assert client.wait(JOB_ID).state == "succeeded"


class LongPoll:
    """A server whose job changes when told; remembers what it was asked."""

    def __init__(self, sleeps, states, tags=True, polls=True):
        self.sleeps, self.states, self.tags, self.polls = sleeps, states, tags, polls
        self.asked = []

    def __call__(self, request):
        query, known = dict(request.url.params), request.headers.get("If-None-Match")
        self.asked.append((query, known))
        assert len(self.asked) < 50
        state = self.states[0]
        if known is not None and self.polls:
            self.sleeps.append(float(query["wait"]))  # the fake clock runs on what was slept
            state = self.states.pop(0)
        elif known is None or not self.tags:
            state = self.states.pop(0)
        headers = {"ETag": f'W/"{state}"'} if self.tags else {}
        if known is not None and known == headers.get("ETag"):
            if not self.polls:
                self.states.pop(0)
            return httpx.Response(304, headers=headers)
        return httpx.Response(200, headers=headers, json={"id": JOB_ID, "state": state})


def waited(sleeps, server):
    seen = []
    patience = Patience(sleep=sleeps.append, clock=lambda: sum(sleeps))
    with Client("http://ct.example", patience=patience, transport=httpx.MockTransport(server)) as client:
        client.wait(JOB_ID, lambda job: seen.append(job.state))
    return seen


def test_waiting_lets_the_server_wait(sleeps):
    server = LongPoll(sleeps, ["queued", "queued", "queued", "running", "succeeded"])
    assert waited(sleeps, server) == ["queued", "running", "succeeded"]
    assert server.asked[0] == ({}, None)
    assert all(query == {"wait": "30.0"} and known for query, known in server.asked[1:])
    assert sleeps == [30.0] * 4, "the client itself never slept"


def test_waiting_on_a_server_that_cannot_wait_pauses_by_itself(sleeps):
    assert waited(sleeps, LongPoll(sleeps, ["running"] * 10 + ["succeeded"], tags=False))[-1] == "succeeded"
    assert len(sleeps) == 10 and sleeps[0] == 0.5 and sleeps[-1] == 5.0


def test_a_304_that_comes_too_early_is_no_reason_to_race(sleeps):
    waited(sleeps, LongPoll(sleeps, ["running"] * 4 + ["succeeded"], polls=False))
    assert len(sleeps) >= 3 and min(sleeps) >= 0.5


def test_ctrl_c_leaves_the_job_alone_and_says_how_to_go_on(client, api, capsys):
    api.faults = [("GET /v1/jobs", KeyboardInterrupt())]
    with pytest.raises(KeyboardInterrupt):
        watch(client, JOB_ID)
    assert f"splatct cancel {JOB_ID}" in capsys.readouterr().err
    assert not any("cancel" in call for call in api.calls)


def test_a_download_is_whole_and_leaves_no_part(client, api, tmp_path):
    api.results = {"volume.tif": b"v" * 5000}
    (file,) = client.results(JOB_ID)
    path = client.download(JOB_ID, file, tmp_path)
    assert path.read_bytes() == b"v" * 5000
    assert [p.name for p in tmp_path.iterdir()] == ["volume.tif"]


def test_a_cut_download_goes_on_where_it_was(client, api, tmp_path):
    data = bytes(range(256)) * 100
    api.results, api.cut_download_at = {"volume.tif": data}, [10000, 20000]
    (file,) = client.results(JOB_ID)
    assert client.download(JOB_ID, file, tmp_path).read_bytes() == data
    assert api.ranges == [None, "bytes=10000-", "bytes=20000-"]


def test_the_piece_of_an_older_file_is_thrown_away(client, api, tmp_path):
    api.results = {"volume.tif": b"new" * 1000}
    (tmp_path / "volume.tif.part").write_bytes(b"old" * 10)
    (file,) = client.results(JOB_ID)
    assert client.download(JOB_ID, file, tmp_path).read_bytes() == b"new" * 1000
    assert api.ranges == ["bytes=30-", None]


def test_a_file_that_is_here_already_is_not_fetched(client, api, tmp_path):
    api.results = {"volume.tif": b"v" * 100}
    (file,) = client.results(JOB_ID)
    client.download(JOB_ID, file, tmp_path)
    client.download(JOB_ID, file, tmp_path)
    assert len(api.ranges) == 1


def test_a_result_with_the_wrong_digest_never_gets_its_name(client, api, tmp_path):
    api.results = {"volume.tif": b"v" * 100}
    with pytest.raises(IntegrityError, match="sha256"):
        client.download(JOB_ID, ResultFile("volume.tif", 100, "0" * 64), tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", "a/../../evil", "C:evil", "..\\evil", ""])
def test_a_result_name_cannot_leave_the_folder(client, tmp_path, name):
    with pytest.raises(UnexpectedAnswer, match="plain relative name"):
        client.download(JOB_ID, ResultFile(name, 1, "0"), tmp_path / "out")


@pytest.mark.parametrize("address", ["localhost:8080", "ftp://x", "", "http://"])
def test_an_address_must_be_one(address):
    with pytest.raises(InputError, match=r"http://127\.0\.0\.1:8080"):
        Client(address)
