"""RTK from the bench's side: each call is a process of its own, in a Python that may be another than this one.

`pip install 'splatct[bench]'`, or `pip install 'itk==5.4.*' itk-rtk numpy` in an environment of its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from splatcore.geometry import Frames
from splatcore.grid import VolumeGrid
from splatcore.splats import Floats

_ROOT = Path(__file__).parents[3]


class RtkError(RuntimeError):
    """RTK is not there, or cannot do what is asked of it."""


@dataclass(frozen=True)
class Snapshot:
    """A reconstruction after so many iterations."""

    iterations: int
    seconds: float  # since the start, loading not counted
    volume: Floats  # [z, y, x] 1/mm, zero outside the inscribed cylinder


@dataclass(frozen=True)
class RTK:
    """RTK in the environment of the interpreter `python`."""

    python: str = sys.executable

    @cached_property
    def available(self) -> bool:
        """Whether itk-rtk is installed there; it is not loaded."""
        ask = "from importlib.metadata import version; version('itk-rtk')"
        try:
            return subprocess.run([self.python, "-c", ask], capture_output=True).returncode == 0
        except OSError:  # no such Python
            return False

    def require(self) -> None:
        if not self.available:
            raise RtkError(
                f"RTK: {self.python} has no itk-rtk; install it with `pip install 'splatct[bench]'`, or name a Python "
                "that has it with --rtk-python"
            )

    def project(self, volume: Floats, grid: VolumeGrid, frames: Frames, threads: int) -> Floats:
        """Line integrals by RTK's Joseph projector. volume [z, y, x] 1/mm -> [views, rows, cols]"""
        with tempfile.TemporaryDirectory() as folder:
            self._call(Path(folder), {"task": "project"}, {"volume": volume}, grid, frames, threads)
            images: Floats = np.load(Path(folder) / "images.npy")
        return images

    def reconstruct(
        self, method: str, images: Floats, frames: Frames, grid: VolumeGrid, threads: int, snapshots: tuple[int, ...],
        knobs: dict[str, float],
    ) -> tuple[list[Snapshot], float]:  # fmt: skip
        """The volumes after each number of iterations, and the peak memory of the process in MiB."""
        job = {"task": "reconstruct", "method": method, "snapshots": list(snapshots), "knobs": knobs}
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            answer = self._call(folder, job, {"images": images}, grid, frames, threads)
            found = [
                Snapshot(s["iterations"], s["seconds"], np.load(folder / f"volume{s['iterations']}.npy"))
                for s in answer["snapshots"]
            ]
        return found, float(answer["peak_mib"])

    def geometry_xml(self, frames: Frames) -> str:
        """The frames as RTK's geometry file, for rtkfdk and the rest of its command line (`--geometry`)."""
        grid = VolumeGrid((1, 1, 1), (1.0, 1.0, 1.0))
        with tempfile.TemporaryDirectory() as folder:
            self._call(Path(folder), {"task": "geometry"}, {}, grid, frames, 1)
            return (Path(folder) / "geometry.xml").read_text(encoding="utf-8")

    def _call(
        self, folder: Path, job: dict[str, Any], arrays: dict[str, Floats], grid: VolumeGrid, frames: Frames,
        threads: int,
    ) -> dict[str, Any]:  # fmt: skip
        self.require()
        if frames.beam != "cone":
            raise RtkError(f"RTK: got a {frames.beam} beam, expected a cone: the bench hands over sources")
        job |= {
            "threads": threads, "rows": frames.rows, "cols": frames.cols, "shape": grid.shape,
            "voxel_mm": grid.voxel_mm, "center_mm": grid.center_mm,
        }  # fmt: skip
        (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
        views = {name: getattr(frames, name) for name in ("source", "detector_center", "u", "v")}
        np.savez(folder / "arrays.npz", allow_pickle=False, **views, **arrays)
        ran = subprocess.run(
            [self.python, "-m", "bench.paper.rtk.worker", str(folder)], cwd=_ROOT, capture_output=True, text=True
        )  # fmt: skip
        if ran.returncode:
            raise RtkError(f"RTK: {(ran.stderr.strip().splitlines() or [f'exit code {ran.returncode}'])[-1]}")
        answer: dict[str, Any] = json.loads((folder / "answer.json").read_text(encoding="utf-8"))
        return answer
