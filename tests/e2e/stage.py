"""The real server on a free port, with the test in the worker's place: it claims jobs, says progress
events and publishes results, all through the worker's own ledger and folders."""

from __future__ import annotations

import hashlib
import json
import math
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from server.migrations import prepare
from server.settings import Settings
from worker.contract import State
from worker.database import Database
from worker.jobfolder import JobFolder
from worker.journal import EventWriter
from worker.ledger import Ledger, jobs


@dataclass
class Stage:
    """A data folder in which the test plays the worker."""

    data: Path
    url: str = ""
    stop: Callable[[], None] = lambda: None  # the server
    start_again: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        (self.data / "jobs").mkdir(parents=True, exist_ok=True)
        self.database = Database(Settings(data=self.data).database)
        prepare(self.database)
        self.ledger = Ledger(self.database)

    def job(self, name: str, state: State = State.QUEUED, **values: Any) -> str:
        job_id = str(uuid.uuid4())
        folder = JobFolder(self.data, job_id)
        (self.data / "empty").mkdir(exist_ok=True)
        folder.create(self.data / "empty")
        row = {
            "id": job_id, "name": name, "scan_id": str(uuid.uuid4()), "scan_name": name, "state": state,
            "options": {"calibrate": "full", "splats": None}, "message": "Waiting", "created_at": time.time(), **values,
        }  # fmt: skip
        with self.database.writing() as write:
            write.execute(jobs.insert().values(**row))
        return job_id

    def start(self, job_id: str) -> None:
        assert self.ledger.claim(job_id, 1, "another-host")

    def say(self, job_id: str, **event: Any) -> None:
        with EventWriter(JobFolder(self.data, job_id).events) as writer:
            writer.append({"attempt": 1, **event})
        row = {"stage": event["stage"], "message": event["message"], "progress": event["fraction"], "eta_s": 42.0}
        assert self.ledger.beat(job_id, 1, row)

    def finish(self, job_id: str, report: dict[str, Any] | None = None) -> None:
        folder = JobFolder(self.data, job_id)
        made = folder.attempt(1)
        made.mkdir()
        write_results(made, report or REPORT)
        folder.publish(1)
        assert self.ledger.succeed(job_id, 1)

    def show_draft(self, job_id: str, edge: int) -> None:
        """A cube of so many voxels a side, as the engine leaves it at the end of a level."""
        volume = np.full((edge, edge, edge), 0.02, np.float32)
        tifffile.imwrite(JobFolder(self.data, job_id).draft, volume, photometric="minisblack", metadata=None)
        draft = {"shape": [edge] * 3, "voxel_mm": [1.6, 1.0, 1.0]}
        self.say(job_id, stage="level", fraction=0.5, message=f"{edge} voxels", draft=draft)

    def end_early(self, job_id: str) -> None:
        """Cancelled, with what it had."""
        assert self.ledger.ask_cancel(job_id)
        folder = JobFolder(self.data, job_id)
        folder.attempt(1).mkdir()
        write_results(folder.attempt(1), REPORT)
        assert folder.publish_partial(1)
        assert self.ledger.end_cancel(job_id, 1, partial=True)


REPORT = {
    "verdict": "The scan is usable. Its centre of rotation was 2.3 pixels off and has been corrected.",
    "findings": [
        {"name": "center_of_rotation", "severity": "warning", "text": "The axis fell 2.3 px off its column.",
         "evidence": {"cor_px": 129.8, "nominal_px": 127.5, "sigma_px": 0.02}},
        {"name": "view jitter", "severity": "problem", "text": "Views 12 to 15 moved by more than 2°.", "evidence": {}},
        {"name": "detector", "severity": "ok", "text": "No dead columns found.", "evidence": {}},
    ],
}  # fmt: skip


def write_results(folder: Path, report: dict[str, Any]) -> None:
    """A result folder with a volume whose three axes differ in length."""
    z, y, x = np.mgrid[-1:1:40j, -1:1:56j, -1:1:64j]
    ball = (x**2 + y**2 + z**2 < 0.7) * 0.02 + ((x - 0.3) ** 2 + y**2 + (z - 0.2) ** 2 < 0.05) * 0.03
    noise = np.random.default_rng(0).normal(0, 0.001, ball.shape)
    tifffile.imwrite(folder / "volume.tif", (ball + noise).astype(np.float32), photometric="minisblack", metadata=None)

    def view(k: int) -> dict[str, Any]:
        bend = math.sin(k / 6)
        moved = {"rotation_deg": [bend, 0.4 * bend, 0.1 * k / 75], "translation_mm": [0.5, bend / 2, -0.3 * bend]}
        sigma = {"rotation_deg": [0.05, 0.06, 0.02], "translation_mm": [0.02, 0.02, None if k == 3 else 0.04]}
        return {"index": k, "correction": moved, "sigma": sigma, "residual_rms": 0.01 + 0.002 * (k % 7)}

    static = {"cor_px": 129.8, "roll_deg": 0.31, "dsd_mm": None}
    poses = {"format": "splatct-poses/1", "views": [view(k) for k in range(75)], "static": static, "gauge": "mean"}
    (folder / "poses.json").write_text(json.dumps(poses))
    (folder / "report.json").write_text(json.dumps(report))
    (folder / "report.html").write_text("<!doctype html><title>Report</title><p>Report")
    files = [
        {"name": p.name, "size": p.stat().st_size, "sha256": hashlib.sha256(p.read_bytes()).hexdigest()}
        for p in sorted(folder.iterdir())
    ]
    (folder / "manifest.json").write_text(
        json.dumps({"format": "splatct-result/1", "files": files, "volume": {"voxel_mm": [1.6, 1.0, 1.0]}})
    )


def progress_events() -> Iterator[dict[str, Any]]:
    """What a run of three levels says."""
    yield {"stage": "read", "fraction": 0.02, "message": "Reading 75 views"}
    for level, base in ((8, 0.1), (4, 0.35), (2, 0.65)):
        for step in range(20):
            loss = 0.08 * math.exp(-(step + 20 * base * 3) / 25) + 0.004
            yield {"stage": "level", "fraction": base + step / 100, "message": f"Fitting at 1/{level} resolution",
                   "level": level, "step": step * 10, "loss": loss, "splats": 30000}  # fmt: skip
        yield {"stage": "poses", "fraction": base + 0.2, "message": f"Pose sweep at 1/{level}", "level": level,
               "moved_deg": 2.0 * base**2 / 3**base, "moved_mm": 0.9 / (1 + 9 * base)}  # fmt: skip


def wait_until(true: Callable[[], bool], seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)
