"""`splatct up`: one command, one tree of processes, nothing left behind."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from server.everything import run_everything
from server.settings import Settings, SettingsError

from .stack import PYTHONPATH, Stack, commit, scan_files, submit


class Up:
    """`splatct up` on a free port, as a process."""

    def __init__(self, data: Path, *arguments: str) -> None:
        self.data = data
        environment = {k: v for k, v in os.environ.items() if not k.startswith("SPLATCT_")}
        environment |= {"PYTHONPATH": PYTHONPATH, "SPLATCT_ENGINE": "fake_engine", "SPLATCT_RECONCILE_S": "0.5"}
        code = (
            "import argparse, sys; from server.verbs import up as verb; "
            "p = argparse.ArgumentParser(); verb.configure(p); sys.exit(verb.run(p.parse_args()))"
        )
        command = [sys.executable, "-c", code, "--data", str(data), "--port", "0", *arguments]
        self.process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self.process.stdout is not None
        self.line = self.process.stdout.readline()

    def pids(self) -> list[int]:
        """Every process that has this data folder in its command line or environment."""
        found = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if entry.name.isdecimal() and int(entry.name) != os.getpid():
                    text = (entry / "cmdline").read_bytes() + (entry / "environ").read_bytes()
                    if str(self.data).encode() in text:
                        found.append(int(entry.name))
        return found

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def up(tmp_path: Path) -> Iterator[Up]:
    running = Up(tmp_path / "data")
    yield running
    running.close()


def test_up_runs_a_job_survives_deaths_and_stops_cleanly(up: Up) -> None:
    assert up.line.startswith("SplatCT is ready: http://127.0.0.1:")
    with httpx.Client(base_url=up.line.split()[3], trust_env=False, timeout=30) as http:
        job_id = submit(http, commit(http, scan_files()))
        Stack.until(lambda: http.get(f"/v1/jobs/{job_id}").json()["state"] == "succeeded", what="success")
        worker = next(p for p in up.pids() if Path(f"/proc/{p}/cmdline").read_bytes().split(b"\0")[3] == b"worker")
        os.kill(worker, signal.SIGKILL)
        job_id = submit(http, commit(http, scan_files()))
        Stack.until(lambda: http.get(f"/v1/jobs/{job_id}").json()["state"] == "succeeded", what="success again")
    assert (up.data / "redis").stat().st_mode & 0o077 == 0
    up.process.send_signal(signal.SIGINT)
    assert up.process.wait(30) == 0
    Stack.until(lambda: not up.pids(), 10, "nothing is left")


def test_nothing_outlives_a_killed_up(up: Up) -> None:
    assert len(up.pids()) >= 4  # itself, Redis, server, worker
    up.process.kill()
    up.process.wait()
    Stack.until(lambda: not up.pids(), 15, "nothing is left")


def test_a_second_one_on_the_same_data_is_refused(up: Up) -> None:
    second = Up(up.data)
    assert second.process.wait(20) == 1 and second.line == ""
    second.close()
    assert up.process.poll() is None


def test_a_file_for_the_data_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("mine")
    with pytest.raises(SettingsError, match="is a file, expected a folder"):
        run_everything(Settings(data=tmp_path / "data", port=0), 1, True, print)
