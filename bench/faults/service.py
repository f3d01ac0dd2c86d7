"""The service as the faults strike it: its engine is the real one, slowed by test mode."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from bench.service import Service
from splatcore.simulate import Simulation
from worker.jobfolder import JobFolder

CHECKPOINT_S = 1.0
_SETTINGS = {"checkpoint_s": CHECKPOINT_S, "test_mode": 1, "test_step_s": 0.004}
_OPTIONS = {"quality": "preview", "calibrate": "full", "splats": 1500, "threads": 1}
_SCAN = Simulation(views=16, det=48, sigma_rot=0.02, sigma_trans=1.0, seed=1)


class Struck(Service):
    """A service with a small scan, any number of jobs of which can be submitted."""

    def __init__(self, folder: Path, workers: int, settings: Mapping[str, object] | None = None) -> None:
        super().__init__(folder, workers, {**_SETTINGS, **(settings or {})})

    def __enter__(self) -> Self:
        super().__enter__()
        self._scan = self.send_body(24, _SCAN)
        return self

    def submit(self, seed: int) -> str:
        return self.client.submit(self._scan, {**_OPTIONS, "seed": seed}).id

    def published(self) -> Counter[str]:
        said = (line for line in self.log.read_text(errors="replace").splitlines() if "published its results" in line)
        return Counter(word.strip(":") for line in said for word in line.split() if word.endswith(":"))

    def kept_ago(self, job_id: str) -> float | None:
        with contextlib.suppress(FileNotFoundError):
            return time.time() - JobFolder(self.data, job_id).checkpoint.stat().st_mtime
        return None
