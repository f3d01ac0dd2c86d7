"""Backups of a server that runs, and what becomes of them: the same answers, the same bytes, jobs that run again."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from server.archive import BackupError, Manifest
from server.backup import back_up
from server.settings import Settings
from worker.jobfolder import JobFolder

from ..postgres import running_postgres
from .stack import PYTHONPATH, Stack, announce, commit, scan_files, submit


def splatct(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    clean = {k: v for k, v in os.environ.items() if not k.startswith("SPLATCT_")} | {"PYTHONPATH": PYTHONPATH}
    command = [sys.executable, "-m", "splatct_client", *arguments]
    return subprocess.run(command, env=clean | environment, capture_output=True, text=True, timeout=120, check=False)


def backup(stack: Stack, target: Path) -> dict[str, Any]:
    done = splatct("backup", str(target), "--data", str(stack.data), "--json")
    assert done.returncode == 0, done.stderr + done.stdout
    return dict(json.loads(done.stdout))


@contextlib.contextmanager
def restored(source: Path, folder: Path) -> Iterator[tuple[Stack, dict[str, Any]]]:
    """A server of what the backup held, on another data folder, port and Redis."""
    stack = Stack(folder)
    done = splatct("restore", str(source), "--data", str(stack.data), "--json")
    assert done.returncode == 0, done.stderr
    with stack:
        yield stack, json.loads(done.stdout)


@pytest.mark.slow
def test_a_running_server_is_backed_up_and_its_jobs_run_again(stack: Stack, tmp_path: Path) -> None:
    stack.start_worker()
    scan = commit(stack.http, scan_files())
    finished = submit(stack.http, scan)
    stack.wait(finished, "succeeded")
    slow = submit(stack.http, commit(stack.http, scan_files(steps=100, pause=0.1)))
    waiting = submit(stack.http, scan)
    half = announce(stack.http, scan_files())["id"]
    stack.until(JobFolder(stack.data, slow).checkpoint.exists, what="a checkpoint of the job at work")
    told = backup(stack, tmp_path / "backup")
    assert (told["scans"], told["jobs"], told["damaged"]) == (2, 3, [])
    assert stack.job(slow)["state"] == "running", "the backup disturbed nothing"
    assert (tmp_path / "backup").stat().st_mode & 0o077 == 0, "it holds everybody's data"
    before = {job: stack.job(job) for job in (finished, slow, waiting)}
    volume = stack.http.get(f"/v1/jobs/{finished}/results/volume.tif").content
    (tmp_path / "other").mkdir()
    with restored(tmp_path / "backup", tmp_path / "other") as (other, counts):
        assert (counts["scans"], counts["jobs"], counts["queued"], counts["dropped"]) == (2, 3, 2, [])
        assert other.job(finished) == before[finished]
        assert other.http.get(f"/v1/jobs/{finished}/results/volume.tif").content == volume
        assert other.http.get(f"/v1/jobs/{finished}/log").text == stack.http.get(f"/v1/jobs/{finished}/log").text
        assert [one["id"] for one in other.http.get("/v1/scans").json()["scans"]] == [
            one["id"] for one in stack.http.get("/v1/scans").json()["scans"]
        ]
        assert other.http.get(f"/v1/uploads/{half}").status_code == 404, "open uploads are begun again"
        assert other.job(slow)["state"] == "queued" and other.job(slow)["attempt"] == before[slow]["attempt"] + 1
        other.start_worker()
        done = other.wait(slow, "succeeded", "failed", seconds=60)
        assert done["state"] == "succeeded", done["error"]
        events = other.http.get(f"/v1/jobs/{slow}/events").json()["events"]
        assert "Going on from the checkpoint" in [event["message"] for event in events]
        assert other.wait(waiting, "succeeded", "failed")["state"] == "succeeded"
        submit(other.http, scan)  # the scan's files are there
    assert stack.wait(slow, "succeeded", seconds=60)["attempt"] == 1


@pytest.mark.slow
def test_a_backup_while_things_come_and_go_is_whole(stack: Stack, tmp_path: Path) -> None:
    """What is deleted, finished or sent in the meantime leaves nothing that the restored server misses."""
    stop, faults = threading.Event(), []

    def busy() -> None:
        with stack.client() as http:
            while not stop.is_set():
                scan = commit(http, scan_files())
                job = submit(http, scan)
                http.post(f"/v1/jobs/{job}/cancel")
                for url in (f"/v1/jobs/{job}", f"/v1/scans/{scan}"):
                    if http.delete(url).status_code != 204:
                        faults.append(url)

    kept = commit(stack.http, scan_files())
    threads = [threading.Thread(target=busy) for _ in range(2)]
    for thread in threads:
        thread.start()
    try:
        for number in range(3):
            backup(stack, tmp_path / f"backup-{number}")
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    assert not faults
    for number in range(3):
        folder = tmp_path / f"backup-{number}"
        manifest = Manifest.read(folder)
        assert not list(manifest.verify(folder)) and kept in manifest.scans
        with contextlib.closing(sqlite3.connect(folder / "splatct.db")) as database:
            rows = {kind: {row[0] for row in database.execute(f"SELECT id FROM {kind}")} for kind in ("scans", "jobs")}
        assert rows == {"scans": set(manifest.scans), "jobs": set(manifest.jobs)}
        assert {file.name for file in (folder / "scans").iterdir()} == rows["scans"]
        assert splatct("restore", str(folder), "--data", str(tmp_path / f"data-{number}")).returncode == 0


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a server that is gone: its `data`, and its `backup`."""
    folder = tmp_path_factory.mktemp("original")
    with Stack(folder) as stack:
        stack.start_worker()
        stack.wait(submit(stack.http, commit(stack.http, scan_files())), "succeeded")
        backup(stack, folder / "backup")
    return folder


@pytest.fixture
def made(original: Path, tmp_path: Path) -> Path:
    """A backup of one's own, to damage."""
    return Path(shutil.copytree(original / "backup", tmp_path / "backup"))


def test_a_damaged_backup_is_told_and_not_restored(made: Path, tmp_path: Path) -> None:
    assert splatct("backup", str(made), "--verify").returncode == 0
    assert "as they were written" in splatct("restore", str(made), "--verify").stdout
    (pixels,) = made.glob("scans/*/projections.tif")
    data = bytearray(pixels.read_bytes())
    data[1000] ^= 1
    pixels.write_bytes(data)
    (volume,) = made.glob("jobs/*/results/volume.tif")
    volume.unlink()
    told = splatct("restore", str(made), "--verify", "--json")
    faults = json.loads(told.stdout)["faults"]
    assert told.returncode == 1 and len(faults) == 2
    assert "projections.tif: its sha256 is" in faults[0] + faults[1] and "cannot be read" in faults[0] + faults[1]
    refused = splatct("restore", str(made), "--data", str(tmp_path / "new"))
    assert refused.returncode == 1 and "is damaged" in refused.stderr and not (tmp_path / "new").exists()


@pytest.mark.parametrize("path", ["../elsewhere", "/etc/elsewhere", "scans/../../elsewhere"])
def test_a_manifest_leads_nowhere_else(made: Path, tmp_path: Path, path: str) -> None:
    manifest = json.loads((made / "manifest.json").read_bytes())
    manifest["files"].append({"path": path, "size": 1, "sha256": hashlib.sha256(b"x").hexdigest()})
    (made / "manifest.json").write_text(json.dumps(manifest))
    refused = splatct("restore", str(made), "--data", str(tmp_path / "new"))
    assert refused.returncode == 1 and "leads out of the backup" in refused.stderr
    assert not (tmp_path / "new").exists()


def test_a_link_in_a_backup_is_not_followed(made: Path, tmp_path: Path) -> None:
    (log,) = made.glob("jobs/*/log.txt")
    log.rename(tmp_path / "log.txt")
    log.symlink_to(tmp_path / "log.txt")
    refused = splatct("restore", str(made), "--data", str(tmp_path / "new"))
    assert refused.returncode == 1 and "log.txt: cannot be read" in refused.stderr


def test_what_is_there_is_never_overwritten(original: Path, made: Path, tmp_path: Path) -> None:
    over = splatct("restore", str(made), "--data", str(original / "data"))
    assert over.returncode == 1 and "is not an empty folder" in over.stderr
    again = splatct("backup", str(made), "--data", str(original / "data"))
    assert again.returncode == 1 and "exists, expected the name of a new folder" in again.stderr
    inside = splatct("restore", str(made), "--data", str(made / "data"))
    assert inside.returncode == 1 and "lies in the backup itself" in inside.stderr
    nothing = splatct("backup", str(tmp_path / "b"), "--data", str(tmp_path / "no"))
    assert nothing.returncode == 2 and "there is no database" in nothing.stderr
    (made / "manifest.json").unlink()
    unfinished = splatct("restore", str(made), "--data", str(tmp_path / "new"))
    assert unfinished.returncode == 1 and "has no manifest.json" in unfinished.stderr


def test_damage_in_the_data_folder_is_found_by_the_backup(stack: Stack, tmp_path: Path) -> None:
    scan = commit(stack.http, scan_files())
    lost = commit(stack.http, scan_files())
    pixels = stack.data / "scans" / scan / "projections.tif"
    data = bytearray(pixels.read_bytes())
    data[1000] ^= 1
    pixels.write_bytes(data)
    (stack.data / "scans" / lost / "projections.tif").unlink()
    done = splatct("backup", str(tmp_path / "backup"), "--data", str(stack.data))
    assert done.returncode == 1
    assert f"scans/{scan}/projections.tif: its sha256 is" in done.stdout
    assert f"scans/{lost}: projections.tif is missing" in done.stdout


def test_a_full_target_leaves_no_backup(stack: Stack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commit(stack.http, scan_files())
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(BackupError, match="1000 are free there; choose a disk with more room"):
        back_up(Settings(data=stack.data), tmp_path / "backup", files_only=False)
    assert [file.name for file in tmp_path.iterdir() if "backup" in file.name] == []


def test_files_of_one_content_stay_one_file(stack: Stack, tmp_path: Path) -> None:
    """Names of one file in the data folder take the backup no more room than there."""
    first, second = (commit(stack.http, scan_files()) for _ in range(2))
    twin = stack.data / "scans" / second / "projections.tif"
    twin.unlink()
    twin.hardlink_to(stack.data / "scans" / first / "projections.tif")
    backup(stack, tmp_path / "backup")
    inodes = {file.stat().st_ino for file in (tmp_path / "backup").glob("scans/*/projections.tif")}
    assert len(inodes) == 1
    assert splatct("restore", str(tmp_path / "backup"), "--data", str(tmp_path / "new")).returncode == 0
    assert (tmp_path / "new" / "scans" / first / "projections.tif").stat().st_nlink == 2


def test_a_database_server_s_database_is_pg_dump_s_job(stack: Stack, tmp_path: Path) -> None:
    url = "postgresql+psycopg://nobody@localhost/nothing"
    with pytest.raises(BackupError, match="pg_dump first, then `splatct backup DEST --files-only`"):
        back_up(Settings(data=stack.data, database_url=url), tmp_path / "b", files_only=False)
    with pytest.raises(BackupError, match="leave the option out"):
        back_up(Settings(data=stack.data), tmp_path / "b", files_only=True)


@pytest.mark.system
def test_files_beside_a_dump_of_postgresql(tmp_path: Path) -> None:
    from ..postgres import program

    with running_postgres() as url:
        stack = Stack(tmp_path / "first")
        stack.environment["SPLATCT_DATABASE_URL"] = url
        with stack:
            scan = commit(stack.http, scan_files())
            job = submit(stack.http, scan)
            plain = url.replace("+psycopg", "")
            dump = subprocess.run([program("pg_dump"), "-Fc", plain], capture_output=True, check=True).stdout
            later = commit(stack.http, scan_files())
            done = splatct(
                "backup", str(tmp_path / "b"), "--files-only", "--data", str(stack.data), SPLATCT_DATABASE_URL=url
            )
            assert done.returncode == 0, done.stderr
        bare = splatct("restore", str(tmp_path / "b"), "--data", str(tmp_path / "new"))
        assert bare.returncode == 1 and "pg_restore first" in bare.stderr
        restore = [program("pg_restore"), "--clean", "--if-exists", "-d", plain]
        subprocess.run(restore, input=dump, check=True)
        second = Stack(tmp_path / "second")
        second.environment["SPLATCT_DATABASE_URL"] = url
        made = splatct("restore", str(tmp_path / "b"), "--data", str(second.data), "--json", SPLATCT_DATABASE_URL=url)
        assert made.returncode == 0, made.stderr
        with second:
            second.start_worker()
            assert second.wait(job, "succeeded", "failed")["state"] == "succeeded"
            assert second.http.get(f"/v1/scans/{later}").status_code == 404, "it came after the dump"
