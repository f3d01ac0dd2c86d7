"""Scores of methods that give voxels, where `splatcore.evaluate` wants splats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from splatcore.evaluate import pose_scores, read_truth
from splatcore.gauge import align
from splatcore.geometry import Frames
from splatcore.grid import VolumeGrid
from splatcore.scores import psnr, ssim
from splatcore.splats import Floats, Similarity


def score(volume: Floats, frames: Frames, grid: VolumeGrid, scan: Path) -> dict[str, Any]:
    """psnr, ssim, rot_deg, trans_vox and rpe_px of a volume [z, y, x] 1/mm made with `frames`, each also aligned: the
    similarity that brings the frames nearest the true ones moves the voxels too, by cubic interpolation."""
    _, truth, unit, true = read_truth(scan)
    similarity, moved_frames = align(true, frames)
    moved = resampled(volume, grid, similarity)
    found: dict[str, Any] = {}
    for suffix, values, where in (("", volume, frames), ("_aligned", moved, moved_frames)):
        found |= {f"psnr{suffix}": psnr(values, truth, unit), f"ssim{suffix}": ssim(values, truth, unit)}
        found |= {name + suffix: value for name, value in pose_scores(true, where, grid).items()}
    return found


def resampled(volume: Floats, grid: VolumeGrid, similarity: Similarity) -> Floats:
    """The object after x -> scale * rotation x + translation, its density divided by the scale. [z, y, x]"""
    turn, shift, scale = similarity.rotation, similarity.translation, similarity.scale
    axes = np.meshgrid(*grid.axes_mm()[::-1], indexing="ij")
    points = np.stack([axes[2], axes[1], axes[0]]).reshape(3, -1)  # x, y, z
    came_from = turn.T @ (points - shift[:, None]) / scale
    middle = (np.array(grid.shape[::-1]) - 1) / 2
    index = (came_from - np.array(grid.center_mm)[:, None]) / np.array(grid.voxel_mm[::-1])[:, None] + middle[:, None]
    moved = ndimage.map_coordinates(volume, index[::-1], order=3, mode="grid-constant").reshape(grid.shape)
    return (moved / scale).astype(np.float32)
