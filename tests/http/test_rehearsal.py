"""Test mode: the server fails as told, and a client gets through all the same."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from splatct_client.client import Client
from splatct_client.scanfolder import read_scan_folder
from splatct_client.sending import send

from server.settings import Settings, SettingsError

from .stack import Stack, announce, commit, scan_files, submit


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Stack]]:
    running: list[Stack] = []

    def begin(**given: str) -> Stack:
        stack = Stack(tmp_path)
        stack.environment |= {"SPLATCT_CHECKPOINT_S": "0", "SPLATCT_TEST_MODE": "1"} | {
            f"SPLATCT_TEST_{k.upper()}": v for k, v in given.items()
        }
        running.append(stack.__enter__())
        stack.start_worker()
        return stack

    yield begin
    for stack in running:
        stack.__exit__(None, None, None)


@pytest.mark.parametrize(
    ("end", "kind", "attempts"),
    [("bad_input", "bad_input", 1), ("out_of_memory", "out_of_memory", 1), ("disk_full", "disk_full", 1),
     ("cannot_reconstruct", "cannot_reconstruct", 1), ("bug", "crashed", 1), ("crash", "crashed", 5)],
)  # fmt: skip
def test_the_engine_ends_as_told(start: Callable[..., Stack], end: str, kind: str, attempts: int) -> None:
    stack = start(end=end, at_step="2")
    job = stack.wait(submit(stack.http, commit(stack.http, scan_files(steps=5))), "failed", "succeeded", seconds=60)
    assert (job["state"], job["error"]["kind"], job["attempt"]) == ("failed", kind, attempts)


def test_a_crash_of_the_first_attempt_alone_costs_an_attempt(start: Callable[..., Stack]) -> None:
    stack = start(end="crash", at_step="3", attempts="1")
    job = stack.wait(submit(stack.http, commit(stack.http, scan_files(steps=5))), "failed", "succeeded")
    assert (job["state"], job["attempt"]) == ("succeeded", 2)


@pytest.mark.slow
def test_a_hanging_engine_can_be_cancelled(start: Callable[..., Stack]) -> None:
    stack = start(end="hang", at_step="2", step_s="0.1")
    job_id = submit(stack.http, commit(stack.http, scan_files(steps=5)))
    stack.until(lambda: stack.job(job_id)["stage"] == "level", what="the engine is at work")
    stack.http.post(f"/v1/jobs/{job_id}/cancel")
    assert stack.wait(job_id, "cancelled")["state"] == "cancelled"


def test_dropped_uploads_are_dropped_and_the_client_gets_through(start: Callable[..., Stack], tmp_path: Path) -> None:
    stack, files = start(drop_uploads="0.6"), scan_files()
    upload, cut = announce(stack.http, files), 0
    for _ in range(20):
        try:
            answer = stack.http.put(f"/v1/uploads/{upload['id']}/files/scan.json", content=files["scan.json"])
            cut += answer.status_code >= 500
        except httpx.TransportError:
            cut += 1
    assert 5 <= cut <= 18
    with Client(str(stack.http.base_url)) as client:
        folder = tmp_path / "scan"
        folder.mkdir()
        for name, data in files.items():
            (folder / name).write_bytes(data)
        scan_id = send(client, read_scan_folder(folder))
    kept = stack.data / "scans" / scan_id / "projections.tif"
    assert hashlib.sha256(kept.read_bytes()).digest() == hashlib.sha256(files["projections.tif"]).digest()


@pytest.mark.parametrize("given", [{"test_end": "crash"}, {"test_drop_uploads": 0.1}, {"test_step_s": 1.0}])
def test_nothing_misbehaves_outside_test_mode(given: dict[str, object]) -> None:
    with pytest.raises(SettingsError, match="TEST_MODE=1"):
        Settings.read(given)
    assert Settings.read({**given, "test_mode": True}).test_mode
