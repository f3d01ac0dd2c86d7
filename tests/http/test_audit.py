"""The audit log: what was done is on record before its answer is, and stays there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
import sqlalchemy as sa
from fastapi.routing import iter_route_contexts
from sqlalchemy.exc import DatabaseError

from server.app import create_app
from server.audit import AuditLog, Deed, Wanted, audit
from server.migrations import prepare
from server.settings import Settings
from server.witness import ACTIONS, Recent
from worker.database import Database

from ..postgres import emptied, running_postgres
from .stack import PYTHONPATH, Stack, announce, commit, scan_files, submit


def entries(stack: Stack, **wanted: Any) -> list[dict[str, Any]]:
    database = Database(f"sqlite:///{stack.data / 'splatct.db'}")
    found = list(AuditLog(database).entries(Wanted(**wanted)))
    database.close()
    return found


def test_readings_are_remembered_for_a_while_and_no_longer() -> None:
    """Or a server would grow with every job that is looked at."""
    now = 0.0
    recent = Recent(60.0, 100, lambda: now)
    deeds = [Deed("lab", None, "", "read-results", str(number), "", None) for number in range(150)]
    assert not recent.again(deeds[0]) and recent.again(deeds[0])
    now = 59.0
    assert recent.again(deeds[0]) and not recent.again(deeds[1])
    now = 60.0
    assert not recent.again(deeds[0]) and recent.again(deeds[1])  # counted from when it was noted
    now = 130.0
    assert not recent.again(deeds[2]) and len(recent) == 1
    for deed in deeds:
        recent.again(deed)
    assert len(recent) == 100 and recent.again(deeds[-1]) and not recent.again(deeds[0])


def test_every_call_that_changes_something_is_noted() -> None:
    """A new one fails here until `server.witness` names what it does."""
    app = create_app(Settings(data=Path("nowhere")))
    changing = {
        (method, context.path)
        for context in iter_route_contexts(app.routes)
        for method in getattr(context, "methods", None) or ()
        if method not in ("GET", "HEAD", "OPTIONS")
    }
    bytes_of_an_upload = {(method, "/v1/uploads/{upload_id}/files/{name}") for method in ("PUT", "PATCH")}
    asks_alone = {("POST", "/v1/jobs/validate")}
    assert changing - bytes_of_an_upload - asks_alone == {call for call in ACTIONS if call[0] != "GET"}


def test_a_job_s_whole_life(keyed: Stack) -> None:
    key, text = keyed.new_key("audited", "read", "submit", "delete")
    with keyed.client(text) as http:
        given_up = announce(http, scan_files())["id"]
        http.delete(f"/v1/uploads/{given_up}")
        scan_id = commit(http, scan_files())
        job_id = submit(http, scan_id)
        keyed.until(lambda: http.get(f"/v1/jobs/{job_id}").json()["state"] == "succeeded", what="the job ends")
        http.get(f"/v1/jobs/{job_id}/results")
        for _ in range(3):  # a download in three ranges, and two slices
            http.get(f"/v1/jobs/{job_id}/results/volume.tif", headers={"Range": "bytes=0-9"})
        http.get(f"/v1/jobs/{job_id}/slices/z/0.png")
        http.get(f"/v1/jobs/{job_id}/slices/z/1.png")
        http.get(f"/v1/jobs/{job_id}/log")
        http.post(f"/v1/jobs/{job_id}/cancel")
        http.delete(f"/v1/jobs/{job_id}", headers={"X-Request-Id": "the-end"})
        http.delete(f"/v1/scans/{scan_id}")
    found = entries(keyed, tenant="audited")
    assert [(entry["action"], entry["thing"], entry["detail"]) for entry in found] == [
        ("upload", given_up, ""),
        ("delete-upload", given_up, ""),
        ("upload", scan_id, ""),
        ("commit", scan_id, ""),
        ("submit", job_id, ""),
        ("read-results", job_id, "results"),
        ("read-results", job_id, "volume.tif"),
        ("read-results", job_id, "slices"),
        ("read-log", job_id, "log"),
        ("cancel", job_id, ""),
        ("delete-job", job_id, ""),
        ("delete-scan", scan_id, ""),
    ]
    assert {(entry["key_id"], entry["address"]) for entry in found} == {(key.id, "127.0.0.1")}
    assert entries(keyed, thing=job_id, action="delete-job")[0]["request_id"] == "the-end"
    assert [entry["at"] for entry in found] == sorted(entry["at"] for entry in found)


def test_what_was_refused_or_done_before_is_no_deed(keyed: Stack) -> None:
    _, text = keyed.new_key("careful", "read", "submit")
    with keyed.client(text) as http:
        scan_id, job_id = commit(keyed.http, scan_files()), uuid4()
        http.delete(f"/v1/scans/{scan_id}")  # 403
        http.post(f"/v1/jobs/{uuid4()}/cancel")  # 404
        http.post("/v1/jobs", json={"scan_id": scan_id})  # 422: another tenant's
        own = commit(http, scan_files())
        for _ in range(2):
            http.put(f"/v1/jobs/{job_id}", json={"scan_id": own})
    assert [entry["action"] for entry in entries(keyed, tenant="careful")] == ["upload", "commit", "submit"]


def test_sessions_are_noted_and_so_are_keys_that_were_none(keyed: Stack) -> None:
    key, text = keyed.new_key("visitor", "read")
    before = len(entries(keyed, action="sign-in-refused"))
    with keyed.client() as http:
        http.post("/v1/session", json={"key": "splatct_aaaaaaaaaa_wrong"})
        csrf = http.post("/v1/session", json={"key": text}).json()["csrf"]
        http.delete("/v1/session", headers={"X-CSRF-Token": csrf})
    assert [(e["action"], e["key_id"]) for e in entries(keyed, tenant="visitor")] == [
        ("sign-in", key.id),
        ("sign-out", key.id),
    ]
    refused = entries(keyed, action="sign-in-refused")
    assert len(refused) == before + 1 and (refused[-1]["tenant"], refused[-1]["key_id"]) == ("", None)
    assert "wrong" not in json.dumps(refused)


def test_without_keys_the_local_tenant_is_noted(shared: Stack) -> None:
    scan_id = commit(shared.http, scan_files())
    assert [(e["tenant"], e["key_id"], e["action"]) for e in entries(shared, thing=scan_id)] == [
        ("local", None, "upload"),
        ("local", None, "commit"),
    ]


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.system)])
def log(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    if request.param == "sqlite":
        database = Database(f"sqlite:///{tmp_path / 'splatct.db'}")
        prepare(database)
        yield database
        database.close()
        return
    with running_postgres() as url:
        database = Database(emptied(url))
        prepare(database)
        yield database
        database.close()


def test_the_database_refuses_to_change_what_is_there(log: Database) -> None:
    AuditLog(log).note(Deed("a", "k", "192.0.2.1", "submit", "job"))
    for statement in (audit.update().values(tenant="b"), audit.delete()):
        with pytest.raises(DatabaseError, match="append-only"), log.writing() as write:
            write.execute(statement)
    assert [entry["tenant"] for entry in AuditLog(log).entries(Wanted())] == ["a"]


def test_many_entries_come_whole_and_in_order(log: Database) -> None:
    rows = [
        {"at": float(n), "tenant": "ab"[n % 2], "key_id": None, "address": "", "action": "submit", "thing": str(n),
         "detail": "", "request_id": None} for n in range(2500)
    ]  # fmt: skip
    with log.writing() as write:
        write.execute(audit.insert(), rows)
    found = list(AuditLog(log).entries(Wanted(tenant="b", since=100.0, until=2400.0)))
    assert [int(entry["thing"]) for entry in found] == list(range(101, 2400, 2))
    assert len(list(AuditLog(log).entries(Wanted()))) == 2500


def test_a_failing_log_stops_nobody_and_says_what_is_missing(stack: Stack) -> None:
    """As on a full disk, where deleting is what helps."""
    scan_id = commit(stack.http, scan_files())
    database = Database(f"sqlite:///{stack.data / 'splatct.db'}")
    with database.writing() as write:
        write.execute(sa.text("ALTER TABLE audit RENAME TO elsewhere"))
    database.close()
    assert stack.http.delete(f"/v1/scans/{scan_id}").status_code == 204
    lines = (stack.data.parent / "log.txt").read_text().splitlines()
    (kept,) = [json.loads(line) for line in lines if "audit log could not be written" in line]
    assert (kept["action"], kept["thing"], kept["tenant"]) == ("delete-scan", scan_id, "local")


def splatct(data: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SPLATCT_")} | {"PYTHONPATH": PYTHONPATH}
    command = [sys.executable, "-m", "splatct_client", *arguments, "--data", str(data)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)


def test_the_command_lists_filters_and_exports(keyed: Stack) -> None:
    _, text = keyed.new_key("listed", "admin")
    with keyed.client(text) as http:
        scan_id = commit(http, scan_files())
    shown = splatct(keyed.data, "audit", "--tenant", "listed")
    assert shown.returncode == 0 and [line.split()[4:6] for line in shown.stdout.splitlines()] == [
        ["upload", scan_id],
        ["commit", scan_id],
    ]
    lines = splatct(keyed.data, "audit", "--id", scan_id, "--action", "commit", "--since", "1h", "--lines").stdout
    (entry,) = [json.loads(line) for line in lines.splitlines()]
    assert entry["tenant"] == "listed" and entry["at"].endswith("+00:00") and entry["thing"] == scan_id
    whole = json.loads(splatct(keyed.data, "audit", "--tenant", "listed", "--json").stdout)["entries"]
    assert [entry["action"] for entry in whole] == ["upload", "commit"]
    assert splatct(keyed.data, "audit", "--tenant", "listed", "--until", "2001-01-01").stdout == ""
    odd = splatct(keyed.data, "audit", "--since", "yesterday")
    assert odd.returncode == 2 and "got 'yesterday'" in odd.stderr


def test_keys_made_and_revoked_are_noted(tmp_path: Path) -> None:
    splatct(tmp_path, "keys", "add", "--tenant", "lab")
    key_id = json.loads(splatct(tmp_path, "keys", "list", "--json").stdout)["keys"][0]["id"]
    splatct(tmp_path, "keys", "revoke", key_id)
    noted = json.loads(splatct(tmp_path, "audit", "--json").stdout)["entries"]
    assert [(e["action"], e["thing"], e["tenant"], e["address"]) for e in noted] == [
        ("add-key", key_id, "lab", "command line"),
        ("revoke-key", key_id, "lab", "command line"),
    ]
