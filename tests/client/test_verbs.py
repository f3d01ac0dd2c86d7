"""The `splatct` command as its users meet it: a process, its streams, its exit code."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

CLIENT = Path(__file__).resolve().parents[2] / "client"
JOB_ID = "6a1f6f0e-0000-4000-8000-000000000001"


def free_address() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{probe.getsockname()[1]}"


def test_help_lists_every_verb(splatct):
    done = splatct("--help")
    assert done.returncode == 0
    for verb in ("submit", "send", "import", "jobs", "fetch", "cancel", "restart", "webhooks"):
        assert f"\n  {verb} " in done.stdout
    assert "exit codes" in done.stdout


def test_a_reader_that_leaves_early_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "splatct_client", "--help"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, env={"PYTHONPATH": str(CLIENT)}, timeout=60)
    os.close(writing)
    assert done.returncode == 141 and done.stderr == b""


def test_the_help_of_a_verb_loads_no_http_library(splatct):
    imported = splatct("submit", "--help", PYTHONPROFILEIMPORTTIME="1").stderr
    assert "splatct_client.scanfolder" in imported and "httpx" not in imported


def test_a_misspelt_verb_gets_a_guess(splatct):
    done = splatct("sumbit")
    assert done.returncode == 2 and "did you mean 'submit'" in done.stderr and "Traceback" not in done.stderr


def test_submit_sends_waits_and_fetches(splatct, server, api, scan, tmp_path):
    api.results = {"volume.tif": b"v" * 100000}
    done = splatct(
        "submit", str(scan), "--server", server, "--calibrate", "static", "--option", "splats=30000",
        "--name", "Prüfling 7", "-o", str(tmp_path / "out"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert api.submitted == [
        {"scan_id": "scan-1", "options": {"calibrate": "static", "splats": 30000}, "name": "Prüfling 7"}
    ]
    assert set(api.uploads) == {"scan.json", "projections.tif", "flat.tif", "dark.tif", "mask.tif"}
    assert {f["name"]: f["size"] for f in api.announced["files"]} == {n: len(b) for n, b in api.uploads.items()}
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["manifest.json", "volume.tif"]
    assert "100 %" in done.stderr and "fitting at bin 4" in done.stderr


def test_submit_json_is_one_object(splatct, server, scan, api):
    done = splatct("submit", str(scan), "--server", server, "--json")
    assert done.returncode == 0 and json.loads(done.stdout)["job"]["id"] == JOB_ID


def test_names_of_any_script_travel(splatct, server, api, scan):
    described = json.loads((scan / "scan.json").read_text())
    (scan / "Aufnahme über 360°.tif").write_bytes(b"pixels")
    described |= {"name": "歯車 №7", "projections": {"files": ["Aufnahme über 360°.tif"]}}
    del described["bad_pixels"]
    (scan / "scan.json").write_text(json.dumps(described, ensure_ascii=False), encoding="utf-8")
    done = splatct("submit", str(scan), "--server", server)
    assert done.returncode == 0, done.stderr
    assert api.announced["name"] == "歯車 №7" and api.uploads["Aufnahme über 360°.tif"] == b"pixels"


def test_a_wrong_folder_is_one_clear_line(splatct, tmp_path):
    done = splatct("submit", str(tmp_path / "nowhere"))
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "is not a folder" in done.stderr


def test_errors_are_json_when_asked(splatct, scan):
    (scan / "flat.tif").unlink()
    done = splatct("submit", str(scan), "--json")
    error = json.loads(done.stdout)["error"]
    assert done.returncode == error["exit_code"] == 2
    assert [p["where"] for p in error["problems"]] == ["scan.json/projections/flat"]


def test_usage_errors_are_json_when_asked(splatct):
    done = splatct("submit", "--json")
    assert done.returncode == 2 and json.loads(done.stdout)["error"]["kind"] == "UsageError"


def test_without_a_server_it_says_how_to_start_one(splatct, scan):
    done = splatct("submit", str(scan), SPLATCT_SERVER=free_address())
    assert done.returncode == 3 and "splatct up" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("verb", [["submit", "SCAN"], ["fetch", JOB_ID]])
def test_a_folder_with_files_in_it_is_refused_before_anything_is_sent(splatct, server, api, scan, tmp_path, verb):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("keep me")
    arguments = [str(scan) if word == "SCAN" else word for word in verb]
    done = splatct(*arguments, "--server", server, "-o", str(out))
    assert done.returncode == 2 and "--overwrite" in done.stderr
    assert api.calls == [] and (out / "mine.txt").read_text() == "keep me"


def test_an_unfinished_fetch_may_go_on_without_overwrite(splatct, server, api, tmp_path):
    api.states, api.results = ["succeeded"], {"volume.tif": b"v" * 1000}
    out = tmp_path / "out"
    out.mkdir()
    (out / ".splatct-job").write_text(JOB_ID)
    (out / "volume.tif.part").write_bytes(b"v" * 400)
    done = splatct("fetch", JOB_ID, "--server", server, "-o", str(out))
    assert done.returncode == 0, done.stderr
    assert api.ranges == ["bytes=400-"] and sorted(p.name for p in out.iterdir()) == ["manifest.json", "volume.tif"]


def test_a_bad_option_is_found_before_the_upload(splatct, server, api, scan):
    done = splatct("submit", str(scan), "--server", server, "--calibrate", "some", "--option", "colour=red")
    assert done.returncode == 2
    assert "full, static, none" in done.stderr and "colour: unknown option" in done.stderr
    assert api.announced == {}


def test_a_refused_scan_gives_its_disk_back(splatct, server, api, scan):
    body = {"title": "The scan cannot be used", "errors": [{"where": "flat.tif", "what": "is no TIFF"}]}
    api.commit_answer = (422, {"Content-Type": "application/problem+json"}, json.dumps(body).encode())
    done = splatct("submit", str(scan), "--server", server)
    assert done.returncode == 2 and "flat.tif: is no TIFF" in done.stderr
    assert api.calls[-1] == "DELETE /v1/uploads/up-1"


def test_a_failed_job_is_exit_1_with_its_reason(splatct, server, api, scan):
    api.states, api.error = ["failed"], {"kind": "ReconstructionError", "message": "no signal in the data"}
    done = splatct("submit", str(scan), "--server", server, "--wait")
    assert done.returncode == 1 and "no signal in the data" in done.stderr


def test_jobs_prints_a_table_and_a_card(splatct, server):
    table = splatct("jobs", "--server", server)
    assert table.returncode == 0 and table.stdout.startswith("JOB") and JOB_ID in table.stdout
    card = splatct("jobs", JOB_ID, "--server", server)
    assert "fitting at bin 4" in card.stdout and "1 min 30 s" in card.stdout


def test_an_unknown_job_is_wrong_input(splatct, server):
    done = splatct("jobs", "no-such", "--server", server)
    assert done.returncode == 2 and "no-such" in done.stderr


def test_cancel_says_what_became_of_it(splatct, server):
    assert splatct("cancel", JOB_ID, "--server", server).stdout == f"job {JOB_ID} is cancelling\n"
