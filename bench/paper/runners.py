"""What each kind of method does with a scan: a volume or splats, scored; seconds and peak memory of its own."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.coverage import coverage, quotients
from bench.paper import voxels
from bench.paper.cells import Cell
from bench.paper.rtk.remote import RTK
from bench.peak import peak_mib
from splatcore import r2
from splatcore.evaluate import evaluate, pose_scores, read_truth
from splatcore.gauge import align
from splatcore.geometry import Frames
from splatcore.options import Options
from splatcore.posefile import read_poses
from splatcore.reconstruct import drain, reconstruct
from splatcore.reconstruction import Reconstruction
from splatcore.results import write_results
from splatcore.scan import Scan, read_scan
from splatcore.splats import Floats, Splats
from splatcore.start import fdk

NEEDLE = 10.0  # longest axis over shortest, beyond which a splat counts as a needle


@dataclass(frozen=True)
class Job:
    """A cell with everything it needs at hand."""

    cell: Cell
    folder: Path  # the scan's
    poses: Path | None  # poses.json of the method "ours" on the same scan, where the cell asks for it
    out: Path  # where poses.json may be kept
    threads: int
    rtk: RTK

    @property
    def options(self) -> dict[str, Any]:
        return dict(self.cell.method.options)

    def scan(self) -> Scan:
        """The scan with the frames that the method is to work on."""
        scan = read_scan(self.folder)
        return replace(scan, frames=self.frames(scan.frames))

    def frames(self, nominal: Frames) -> Frames:
        if self.cell.method.frames == "nominal":
            return nominal
        true = read_truth(self.folder)[3]
        if self.cell.method.frames == "true":
            return true
        assert self.poses is not None
        # Corrected frames stand in a world of their own (the gauge): a voxel volume must be made in the truth's.
        return align(true, read_poses(self.poses)[1])[1]


def run(job: Job) -> dict[str, Any]:
    """The scores of a cell: those of `splatcore.evaluate`, `seconds`, `peak_mib`, and what its kind adds."""
    began = time.perf_counter()
    found = RUNNERS[job.cell.method.kind](job)
    return {**found, "process_seconds": time.perf_counter() - began}


def _splats(job: Job) -> dict[str, Any]:
    scan = job.scan()
    return _scored(job, drain(reconstruct(scan, Options.from_dict({**job.options, "threads": job.threads}))))


def _baseline(job: Job) -> dict[str, Any]:
    """R2-Gaussian or the paper's method. Fewer steps than theirs move poses by as much longer ones."""
    scan = job.scan()
    options = Options.from_dict({**job.options, "threads": job.threads, "steps": job.cell.steps})
    switches = r2.Switches(
        pose_rate=max(1.0, r2.STEPS / (job.cell.steps or r2.STEPS)),
        unit=scan.simulation["attenuation_unit"] if scan.simulation else None,
    )
    return _scored(job, drain(r2.reconstruct(scan, options, switches)))


def _scored(job: Job, result: Reconstruction) -> dict[str, Any]:
    peak = peak_mib()  # before voxelising and scoring
    folder = job.out / "result"
    write_results(result, folder, overwrite=True)
    scores = evaluate(folder, job.folder, job.threads)
    shutil.copyfile(folder / "poses.json", job.out / "poses.json")
    shutil.rmtree(folder)
    return {
        **scores, "seconds": result.timings["total"], "peak_mib": peak, "splats": len(result.splats),
        "needles": needle_share(result.splats), "static": result.static, "verdict": result.report.get("verdict"),
        "coverage": _coverage(job, result),
    }  # fmt: skip


def _coverage(job: Job, result: Reconstruction) -> dict[str, Any] | None:
    """Shares of the aligned pose errors within one and two stated deviations; None where poses were not moved."""
    sigma = np.deg2rad(result.sigma_rotation_deg), result.sigma_translation_mm
    if np.isnan(sigma).any():
        return None
    return coverage(str(job.cell.scan.scene), quotients(read_truth(job.folder)[3], result.corrected, *sigma))


def needle_share(splats: Splats) -> float:
    """The share of splats whose longest axis is more than ten times their shortest."""
    if not len(splats):
        return 0.0
    return float(np.mean(splats.scales.max(axis=1) > NEEDLE * splats.scales.min(axis=1)))


def _voxels(reconstruct: Callable[[Job, Scan], tuple[Floats, Frames]]) -> Callable[[Job], dict[str, Any]]:
    """The runner of a method that gives a volume and the frames it believes in."""

    def run(job: Job) -> dict[str, Any]:
        scan = job.scan()
        began = time.perf_counter()
        volume, frames = reconstruct(job, scan)
        seconds, peak = time.perf_counter() - began, peak_mib()
        return {**voxels.score(volume, frames, scan.volume, job.folder), "seconds": seconds, "peak_mib": peak}

    return run


def _fdk(job: Job, scan: Scan) -> tuple[Floats, Frames]:
    return fdk(scan.projections, scan.frames, scan.volume, job.threads), scan.frames


def _sart(job: Job, scan: Scan) -> tuple[Floats, Frames]:
    from splatcore.classical import sart

    return sart(scan.projections, scan.frames, scan.volume, job.threads), scan.frames


def _cgls(job: Job, scan: Scan) -> tuple[Floats, Frames]:
    from splatcore.classical import cgls

    return cgls(scan.projections, scan.frames, scan.volume, job.threads), scan.frames


def _matching(job: Job, scan: Scan) -> tuple[Floats, Frames]:
    from splatcore.matching import match

    volume, motions = match(scan, job.threads)
    return volume, motions.correct(scan.frames)


def _rtk(job: Job) -> dict[str, Any]:
    """The best of the method's snapshots by the truth, which favours the peer: nobody stops so well without it."""
    scan, knobs = job.scan(), job.options
    method, counts = str(knobs.pop("method")), tuple(knobs.pop("snapshots"))
    grid = scan.volume
    found, peak = job.rtk.reconstruct(method, scan.projections, scan.frames, grid, job.threads, counts, knobs)
    scored = [(s, voxels.score(s.volume, scan.frames, grid, job.folder)) for s in found]
    best, scores = max(scored, key=lambda pair: float(pair[1]["psnr"]))
    tried = {str(s.iterations): round(float(values["psnr"]), 3) for s, values in scored}
    return {**scores, "seconds": best.seconds, "peak_mib": peak, "iterations": best.iterations, "tried": tried}


def _bound(job: Job) -> dict[str, Any]:
    from bench.bound import bound

    header, _, _, true = read_truth(job.folder)
    assert header.volume is not None
    found = bound(job.folder, threads=job.threads)
    return {**found, "nominal": pose_scores(true, header.frames, header.volume), "peak_mib": peak_mib()}


RUNNERS: dict[str, Callable[[Job], dict[str, Any]]] = {
    "splats": _splats,
    "baseline": _baseline,
    "fdk": _voxels(_fdk),
    "sart": _voxels(_sart),
    "cgls": _voxels(_cgls),
    "matching": _voxels(_matching),
    "rtk": _rtk,
    "bound": _bound,
}
