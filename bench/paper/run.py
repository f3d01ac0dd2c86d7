"""Runs cells one after the other, each in a fresh process, and keeps what they found.

A finished cell is `cells/KEY.json` in the work folder; a bench that was interrupted goes on from there. A cell that
fails stays in the tables as failed, with its reason, and is tried again the next time.
"""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.paper.cells import Cell
from bench.paper.rtk.remote import RTK, RtkError
from bench.paper.runners import Job
from bench.paper.scans import make_scan

_ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Outcome:
    """What became of a cell."""

    cell: Cell
    scores: dict[str, Any] | None  # None: failed
    reason: str = ""  # why it failed
    cached: bool = False

    def document(self) -> dict[str, Any]:
        """The cell as results.json shows it."""
        base = {"cell": str(self.cell), "key": self.cell.key, **self.cell.parameters()}
        if self.scores is None:
            return {**base, "status": "failed", "reason": self.reason}
        return {**base, "status": "done", "scores": self.scores}


@dataclass(frozen=True)
class Bench:
    """Where the work is kept, and with what it is done."""

    work: Path
    data: Path | None
    threads: int
    rtk: RTK
    limit_s: float = 6 * 3600.0

    def run(self, cells: Iterable[Cell], tell: Callable[[str], None] = lambda _: None) -> list[Outcome]:
        """The outcome of every cell, in their order, each computed once; `tell` hears of each as it ends."""
        done: dict[str, Outcome] = {}
        for cell in cells:
            if cell.key in done:
                continue
            began = time.monotonic()
            outcome = done[cell.key] = self.one(cell)
            how = "cached" if outcome.cached else f"{time.monotonic() - began:.0f} s"
            tell(f"{cell}: {_summary(outcome)} [{how}]")
        return list(done.values())

    def one(self, cell: Cell) -> Outcome:
        """A cell's outcome, from the cache where it is there."""
        kept = self.work / "cells" / f"{cell.key}.json"
        if kept.exists():
            return Outcome(cell, json.loads(kept.read_text(encoding="utf-8")), cached=True)
        needed = cell.needs()
        if needed is not None and (before := self.one(needed)).scores is None:
            return Outcome(cell, None, f"needs {needed.method.label}, which failed: {before.reason}")
        try:
            if cell.method.by_rtk:
                self.rtk.require()
            folder = make_scan(cell.scan, self.work, self.data, self.threads, self.rtk)
        except (FileNotFoundError, RtkError) as error:
            return Outcome(cell, None, str(error))
        return self._computed(cell, folder, needed)

    def _computed(self, cell: Cell, folder: Path, needed: Cell | None) -> Outcome:
        out = self.work / "running" / cell.key
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        poses = None if needed is None else self._poses(needed)
        (out / "job.pickle").write_bytes(pickle.dumps(Job(cell, folder, poses, out, self.threads, self.rtk)))
        command = [sys.executable, "-m", "bench.paper.cell", str(out / "job.pickle")]
        try:
            ran = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, timeout=self.limit_s)
        except subprocess.TimeoutExpired:
            return Outcome(cell, None, f"took longer than {self.limit_s:g} s")
        if ran.returncode:
            said = ran.stderr.strip().splitlines()
            return Outcome(cell, None, said[-1] if said else f"ended with code {ran.returncode} and said nothing")
        scores = json.loads((out / "scores.json").read_text(encoding="utf-8"))
        kept = self.work / "cells" / f"{cell.key}.json"
        kept.parent.mkdir(parents=True, exist_ok=True)
        if (out / "poses.json").exists():  # before the scores: a cell with scores is whole
            (out / "poses.json").replace(self._poses(cell))
        (out / "scores.json").replace(kept)
        shutil.rmtree(out)
        return Outcome(cell, scores)

    def _poses(self, cell: Cell) -> Path:
        return self.work / "cells" / f"{cell.key}.poses.json"


def _summary(outcome: Outcome) -> str:
    s = outcome.scores
    if s is None:
        return f"FAILED, {outcome.reason}"
    if "psnr" not in s:
        return f"{s['joint_rot_deg']:.4f} deg, {s['joint_trans_vox']:.4f} voxel"
    return f"{s['psnr_aligned']:.2f} dB aligned, {s['psnr']:.2f} raw, {s['rot_deg_aligned']:.3f} deg"
