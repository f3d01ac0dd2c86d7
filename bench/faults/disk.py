"""A disk that is full: while a scan arrives, while a run keeps its state, while it writes its results.

Everything lies on a small tmpfs: uploads, jobs, the database, Redis. Each time the disk is filled, what must go on
does, what cannot is told so, things can be deleted, and once there is room again all comes to its end.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from bench.faults.campaign import FINISHED
from bench.faults.service import Struck
from bench.faults.tinydisk import NoMount, TinyDisk, tiny_disk
from bench.faults.uploads import noise_scan

__all__ = ["NoMount", "fill_the_disk"]

_DISK_MIB = 48
_SETTINGS = {"disk_floor_mib": 0, "disk_reserve_mib": 1}
_JOB_S = 300.0
_DONE = {"upload": "refused with 507, then committed whole", "checkpoint": "went on without newer states to its end",
         "publish": "failed as disk_full, or waited, then went on to its end", "delete": "of a scan"}  # fmt: skip


@dataclass
class DiskOutcome:
    done: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    resumed_s: list[float] = field(default_factory=list)  # from the room to the end of what had waited for it
    minutes: float = 0.0

    def good(self) -> bool:
        return not self.wrong

    def to_json(self) -> dict[str, Any]:
        return {**vars(self), "done": dict(self.done)}

    def table(self) -> str:
        rows = "".join(f"| {kind}: {text} | {self.done[kind]} |\n" for kind, text in _DONE.items())
        bad = "".join(f"- {line}\n" for line in self.wrong)
        head = f"A full disk ({_DISK_MIB} MiB), {self.minutes:.0f} minutes.\n\n| | |\n|---|---:|\n"
        return f"{head}{rows}| **went wrong** | {len(self.wrong)} |\n\n{bad}\n"


def fill_the_disk(folder: Path, rounds: int, seed: int, say: Callable[[str], None]) -> DiskOutcome:
    """So often during an upload, a checkpoint and a publication. Raises NoMount where no disk can be had."""
    out, began = DiskOutcome(), time.monotonic()
    with tiny_disk(folder / "disk", _DISK_MIB) as disk, Struck(disk.path, 1, _SETTINGS) as service:
        for number in range(rounds):
            with httpx.Client(base_url=service.url, trust_env=False, timeout=60) as http:
                filled = _Filled(service, http, disk, random.Random(f"{seed}/{number}"), out)
                for kind in ("upload", "checkpoint", "publish"):
                    try:
                        getattr(filled, kind)()
                        out.done[kind] += 1
                    except (httpx.HTTPError, TimeoutError, Wrong) as failure:
                        out.wrong.append(f"round {number + 1}, {kind}: {type(failure).__name__}: {failure}"[:300])
                    finally:
                        disk.empty()
            say(f"{number + 1} of {rounds} times on a full disk")
    out.minutes = round((time.monotonic() - began) / 60, 1)
    return out


class Wrong(Exception):
    """Something that a full disk must not lead to."""


class _Filled:
    """One round."""

    def __init__(
        self, service: Struck, http: httpx.Client, disk: TinyDisk, rng: random.Random, out: DiskOutcome
    ) -> None:
        self._service, self._http, self._disk, self._rng, self._out = service, http, disk, rng, out

    def upload(self) -> None:
        spare = self._send(*self._announce())
        upload, files = self._announce()
        stack = files["projections.tif"]
        self._disk.fill(leave=self._rng.randrange(len(stack)))
        refused = self._http.put(f"/v1/uploads/{upload}/files/projections.tif", content=stack)
        if refused.status_code != 507 or "delete" not in refused.text:
            raise Wrong(f"an upload on a full disk was answered with {refused.status_code}: {refused.text[:200]}")
        self._delete(spare)
        self._disk.empty()
        self._send(upload, files)
        for file, sent in files.items():
            if (self._service.data / "scans" / upload / file).read_bytes() != sent:
                raise Wrong(f"{file} of the scan {upload} is not what was sent")
        self._delete(upload)

    def checkpoint(self) -> None:
        spare = self._send(*self._announce())
        job = self._service.submit(self._rng.randrange(2**31))
        self._until(lambda: self._service.kept_ago(job) is not None, f"{job} keeps its state")
        self._disk.fill()
        time.sleep(self._rng.uniform(1, 4))  # several states would have been due
        self._delete(spare)
        if self._job(job)["state"] in ("failed", "cancelled"):
            raise Wrong(f"{job} ended because its state could not be kept: {self._job(job)['error']}")
        self._disk.empty()
        self._ends_well(job)

    def publish(self) -> None:
        """Full to the last byte, database and all, or but for a few records."""
        leave = self._rng.choice((0, 96 * 1024))
        job = self._service.submit(self._rng.randrange(2**31))
        self._until(lambda: self._job(job)["progress"] > 0.5, f"{job} is half done")

        def over() -> bool:
            self._disk.fill(leave)
            return job not in self._service.engines()

        self._until(over, f"the engine of {job} ends on a full disk")
        if (self._service.data / "jobs" / job / "results").exists():
            raise Wrong(f"{job} has published results that there was no room for")
        self._disk.empty()
        began = time.monotonic()
        self._until(lambda: self._job(job)["state"] in FINISHED, f"{job} has ended")
        ended = self._job(job)
        if ended["state"] == "failed" and ended["error"]["kind"] == "disk_full":
            again = self._http.post(f"/v1/jobs/{job}/restart").raise_for_status().json()["id"]
            self._ends_well(again)
            if not any("Going on from the checkpoint" in event["message"] for event in self._service.events(again)):
                raise Wrong(f"{again} did not go on from what {job} had kept")
        elif ended["state"] != "succeeded":
            raise Wrong(f"{job} {ended['state']}: {ended['error']}")
        self._out.resumed_s.append(round(time.monotonic() - began, 1))

    def _announce(self) -> tuple[str, dict[str, bytes]]:
        scan, stack = noise_scan(128, self._rng.randrange(2**32))
        files = {"scan.json": scan, "projections.tif": stack}
        listed = [{"name": name, "size": len(data)} for name, data in files.items()]
        made = self._http.post("/v1/uploads", json={"name": "full", "files": listed}).raise_for_status()
        return str(made.json()["id"]), files

    def _send(self, upload: str, files: dict[str, bytes]) -> str:
        for name, data in files.items():
            self._http.put(f"/v1/uploads/{upload}/files/{name}", content=data).raise_for_status()
        self._http.post(f"/v1/uploads/{upload}/commit").raise_for_status()
        return upload

    def _delete(self, scan: str) -> None:
        answer = self._http.delete(f"/v1/scans/{scan}")
        if answer.status_code != 204:
            raise Wrong(f"deleting a scan on a full disk was answered with {answer.status_code}: {answer.text[:200]}")
        self._out.done["delete"] += 1

    def _job(self, job: str) -> dict[str, Any]:
        return dict(self._http.get(f"/v1/jobs/{job}").raise_for_status().json())

    def _ends_well(self, job: str) -> None:
        began = time.monotonic()
        self._until(lambda: self._job(job)["state"] in FINISHED, f"{job} has ended")
        ended = self._job(job)
        if ended["state"] != "succeeded":
            raise Wrong(f"{job} {ended['state']}: {ended['error']}")
        self._out.resumed_s.append(round(time.monotonic() - began, 1))

    def _until(self, condition: Callable[[], bool], what: str) -> None:
        self._service.until(condition, _JOB_S, what)
