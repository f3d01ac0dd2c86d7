"""Which constant errors of a scanner its projections can show, and how strongly.

The object is free: it may answer any error by moving each of its points. So take points, let an error move their
images in all views, and let every point, and the whole detector plane along its own line to the isocentre, follow as
well as it can. What remains on the detector, in pixels per unit of the error, is all that any method can see.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from splatcore.geometry import Array, Frames, RigidMotions, rotation_from_vector

# Unit of each error.
UNITS = {
    "cor_px": "px", "roll_deg": "degree", "axis_pitch_deg": "degree", "yaw_deg": "degree",
    "detector_tilt_deg": "degree", "v_offset_px": "px", "dso_mm": "mm", "dsd_mm": "mm", "z_shift_mm": "mm",
}  # fmt: skip


def sensitivity(frames: Frames, reach_mm: float) -> dict[str, float]:
    """RMS over views and points of what one unit of each error leaves on the detector, in pixels.

    reach_mm: points lie on a lattice of 5 x 5 x 5 in a cube of this half width about the isocentre; with one row or
    one column of pixels, in the plane that it sees, and only along the line of pixels.
    """
    line = frames.rows == 1, frames.cols == 1
    steps = np.linspace(-reach_mm, reach_mm, 5)
    heights = np.zeros(1) if line[0] else steps
    points = np.stack(np.meshgrid(steps, steps, heights, indexing="ij"), axis=-1).reshape(-1, 3)
    seen = [axis for axis, hidden in enumerate((line[1], line[0])) if not hidden] or [0]

    def flow(near: Frames, far: Frames, where: tuple[Array, Array], step: float) -> Array:
        """Central difference of the images of the points. [points, views x coordinates]"""
        moved = (far.project(where[1]) - near.project(where[0]))[..., seen] / (2 * step)
        return np.moveaxis(moved, 1, 0).reshape(len(points), -1)

    each = []
    for axis in np.eye(3)[: 2 if line[0] else 3]:
        each.append(flow(frames, frames, (points - 1e-3 * axis, points + 1e-3 * axis), 1e-3))
    followers = np.stack(each, axis=2)  # [points, observations, 2 or 3]
    bases = np.linalg.qr(followers)[0]

    left = {}
    for name, error in _ERRORS.items():
        if frames.beam == "parallel" and name in ("dso_mm", "dsd_mm"):
            left[name] = 0.0
            continue
        moved = flow(error(frames, -1e-4), error(frames, 1e-4), (points, points), 1e-4)
        rest = moved - np.einsum("poj,pj->po", bases, np.einsum("poj,po->pj", bases, moved))
        left[name] = float(np.sqrt((rest**2).sum(axis=1).mean() / len(frames)))
    return left


def _about(frames: Frames, axis: int, degrees: float) -> Array:
    return rotation_from_vector(frames.axes()[:, axis] * np.deg2rad(degrees))


def _turned(frames: Frames, axis: int, degrees: float) -> Frames:
    """The detector turned about its own centre."""
    turn = _about(frames, axis, degrees)
    return replace(frames, u=np.einsum("vij,vj->vi", turn, frames.u), v=np.einsum("vij,vj->vi", turn, frames.v))


def _pitched(frames: Frames, degrees: float) -> Frames:
    return RigidMotions(_about(frames, 0, degrees), np.zeros((len(frames), 3))).correct(frames)


def _along_ray(frames: Frames, source_mm: float, detector_mm: float) -> Frames:
    back = -frames.axes()[:, 2] * np.sign(np.einsum("vi,vi->v", frames.axes()[:, 2], frames.detector_center))[:, None]
    return replace(
        frames,
        source=frames.source + source_mm * back,
        detector_center=frames.detector_center - detector_mm * back,
    )


def _raised(frames: Frames, height_mm: float) -> Frames:
    up = np.array([0.0, 0.0, height_mm])
    source = frames.source + up if frames.beam == "cone" else frames.source
    return replace(frames, source=source, detector_center=frames.detector_center + up)


_ERRORS: dict[str, Callable[[Frames, float], Frames]] = {
    "cor_px": lambda f, d: f.shifted_detector(d),
    "roll_deg": lambda f, d: _turned(f, 2, d),
    "axis_pitch_deg": _pitched,
    "yaw_deg": lambda f, d: _turned(f, 1, d),
    "detector_tilt_deg": lambda f, d: _turned(f, 0, d),
    "v_offset_px": lambda f, d: f.shifted_detector(0.0, d),
    "dso_mm": lambda f, d: _along_ray(f, d, -d),
    "dsd_mm": lambda f, d: _along_ray(f, 0.0, d),
    "z_shift_mm": _raised,
}
