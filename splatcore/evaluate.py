"""How good a result is, where the truth is known: the scores of simulated scans.

Raw scores compare as it stands; aligned ones first remove what no projection can tell (splatcore.gauge): the
similarity that brings the estimated poses nearest the true ones also moves the splats, which are voxelised again.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from splatcore.document import Document
from splatcore.errors import Problem, ScanError
from splatcore.gauge import align, pose_errors
from splatcore.geometry import Array, Frames
from splatcore.grid import VolumeGrid
from splatcore.machine import threads_allowed
from splatcore.results import read_results
from splatcore.scan import read_header
from splatcore.scanfiles import find_file
from splatcore.scangeometry import read_frames
from splatcore.scanjson import ScanHeader
from splatcore.scores import psnr, ssim
from splatcore.splats import Floats
from splatcore.tiff import read_stack

_LATTICE = 5  # points an edge
_LATTICE_REACH = 0.5  # of the volume's half width: inside the inscribed cylinder


def evaluate(results: Path | str, truth: Path | str, threads: int | None = None) -> dict[str, Any]:
    """Scores of a result folder against the `simulation` block of a scan folder.

    Keys: psnr, ssim, rot_deg, trans_vox, rpe_px, each also *_aligned; and `nominal` with the pose errors
    of the scan's own frames, before any calibration. Raises ScanError, ResultError.
    """
    found = read_results(results)
    header, volume, unit, frames = read_truth(Path(truth))
    for what, true, ours in (
        ("volume_file", volume.shape, found.volume.shape),
        ("frames", len(frames), len(found.frames)),
    ):
        if true != ours:
            hint = "evaluate against the scan that was reconstructed"
            raise ScanError([Problem(f"/simulation/{what}", f"the truth has {true}, the result {ours}", hint)])
    similarity, aligned = align(frames, found.frames)
    moved = found.splats.moved(similarity).voxelize(found.grid, threads or threads_allowed())
    scores: dict[str, Any] = {
        "psnr": psnr(found.volume, volume, unit),
        "psnr_aligned": psnr(moved, volume, unit),
        "ssim": ssim(found.volume, volume, unit),
        "ssim_aligned": ssim(moved, volume, unit),
    }
    for suffix, estimated in (("", found.frames), ("_aligned", aligned)):
        for name, value in pose_scores(frames, estimated, found.grid).items():
            scores[name + suffix] = value
    nominal = pose_scores(frames, header.frames, found.grid)
    return {**scores, "nominal": nominal, "seconds": found.manifest["timings"].get("total"), "scan": header.name}


def pose_scores(true: Frames, estimated: Frames, grid: VolumeGrid) -> dict[str, float]:
    """RMS over views of the angle and the length of T_true^-1 T_est, and of a lattice's distance on the detector."""
    omega, tau = pose_errors(true, estimated).vectors()
    lattice = _lattice(grid)
    distance = np.linalg.norm(true.project(lattice) - estimated.project(lattice), axis=2)
    return {
        "rot_deg": float(np.rad2deg(np.sqrt((omega**2).sum(axis=1).mean()))),
        "trans_vox": float(np.sqrt((tau**2).sum(axis=1).mean()) / grid.edge_mm),
        "rpe_px": float(np.sqrt((distance**2).mean())),
    }


def _lattice(grid: VolumeGrid) -> Array:
    """5 x 5 x 5 points inside the object's cylinder, mm."""
    edge = np.linspace(-_LATTICE_REACH, _LATTICE_REACH, _LATTICE)
    points = np.stack(np.meshgrid(edge, edge, edge, indexing="ij"), axis=-1).reshape(-1, 3)
    return points * grid.half_extent_mm() + np.array(grid.center_mm)


def read_truth(folder: Path) -> tuple[ScanHeader, Floats, float, Frames]:
    """The scan's header, its true volume [z, y, x] 1/mm, the attenuation that counts as 1, and its true frames.

    Raises ScanError where the scan carries no truth."""
    header = read_header(folder)
    doc, simulation = Document(), header.simulation
    if simulation is None:
        raise ScanError([Problem("/simulation", "is missing: this scan does not carry its truth",
                                 "scores need a simulated scan, as `splatct simulate` writes it")])  # fmt: skip
    file = find_file(folder, simulation.get("volume_file"), "/simulation/volume_file", doc)
    unit = doc.number(simulation.get("attenuation_unit", 1.0), "/simulation/attenuation_unit", 0, 1e6)
    detector = (header.frames.rows, header.frames.cols)
    frames = read_frames(simulation.get("frames"), "/simulation/frames", header.frames.beam, detector, doc)
    if doc.problems or file is None or unit is None or frames is None:
        raise ScanError(doc.all_problems())
    return header, read_stack(file.path, file.name), unit, frames


def table(scores: dict[str, Any]) -> str:
    """The scores as a person reads them."""
    nominal = scores["nominal"]
    rows = [
        ("", "before", "after", "aligned"),
        ("PSNR (dB)", "", f"{scores['psnr']:.2f}", f"{scores['psnr_aligned']:.2f}"),
        ("SSIM", "", f"{scores['ssim']:.4f}", f"{scores['ssim_aligned']:.4f}"),
    ]
    for name, label in (
        ("rot_deg", "rotation (deg)"),
        ("trans_vox", "translation (voxel)"),
        ("rpe_px", "reprojection (px)"),
    ):
        rows.append((label, f"{nominal[name]:.3f}", f"{scores[name]:.3f}", f"{scores[name + '_aligned']:.3f}"))
    lines = [f"{a:<20} {b:>9} {c:>9} {d:>9}" for a, b, c, d in rows]
    if scores.get("seconds"):
        lines.append(f"{'seconds':<20} {scores['seconds']:>29.1f}")
    return "\n".join(lines)
