"""Corrected frames in other toolkits' terms, so that FDK or an iterative method of theirs can use them.

RTK's geometry file (`rtkfdk --geometry`, https://www.openrtk.org) and ASTRA's vectors (`cone_vec`, `parallel3d_vec`).
"""

from __future__ import annotations

import io

import numpy as np

from splatcore.errors import ExportError
from splatcore.geometry import Array, Frames

_SQUARE = 1e-6  # how far u and v may be from perpendicular, and pixels from equal
# RTK's gantry turns about y. A cyclic change of axes takes our z there without mirroring: (x, y, z) -> (y, z, x).
_TO_RTK = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


def upside_down(frames: Frames) -> bool:
    """Whether RTK must be given the images flipped: it wants u x v to point from the detector to the source.

    Raises ExportError where some views are mirrored and some are not."""
    facing = np.einsum("vi,vi->v", np.cross(frames.u, frames.v), frames.source - frames.detector_center) > 0
    if facing.any() != facing.all():
        raise ExportError("some views are mirrored and some are not: RTK takes one orientation per scan")
    return not facing.all()


def rtk_geometry(frames: Frames) -> str:
    """RTK's geometry XML (version 3). A volume [z, y, x] is RTK's [x, z, y] (its axes x y z are our y z x); images are
    flipped upside down where `upside_down` says so.

    Raises ExportError for what RTK cannot describe: a parallel beam, slanted or unequal pixels."""
    if frames.beam != "cone":
        raise ExportError(f"RTK's geometry: got a {frames.beam} beam, expected a cone; try astra, which takes both")
    flipped = upside_down(frames)
    sizes = np.linalg.norm(np.stack([frames.u, frames.v]), axis=2)
    slant = np.abs(np.einsum("vi,vi->v", frames.u, frames.v)) / (sizes[0] * sizes[1])
    if slant.max() > _SQUARE or (np.ptp(sizes, axis=1) / sizes[:, 0]).max() > _SQUARE:
        raise ExportError("RTK's geometry: expected rows square to columns and pixels of one size in all views")
    row = frames.u / sizes[0][:, None]
    column = (-1.0 if flipped else 1.0) * frames.v / sizes[1][:, None]
    axes = np.stack([row, column, np.cross(row, column)], axis=1) @ _TO_RTK.T  # rows: RTK's rotated axes
    source = np.einsum("vij,vj->vi", axes, frames.source @ _TO_RTK.T)
    center = np.einsum("vij,vj->vi", axes, frames.detector_center @ _TO_RTK.T)
    text = io.StringIO()
    text.write('<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n<RTKThreeDCircularGeometry version="3">\n')
    for turned, s, d in zip(axes, source, center, strict=True):
        distance = float(s[2] - d[2])
        # turned = Rz(-in plane) Rx(-out of plane) Ry(-gantry)
        angles = (
            np.arctan2(turned[2, 0], turned[2, 2]),
            -np.arcsin(np.clip(turned[2, 1], -1, 1)),
            np.arctan2(turned[0, 1], turned[1, 1]),
        )
        gantry, out_of_plane, in_plane = np.rad2deg(angles) % 360
        entries = {
            "SourceToIsocenterDistance": s[2], "SourceToDetectorDistance": distance, "GantryAngle": gantry,
            "ProjectionOffsetX": d[0], "ProjectionOffsetY": d[1], "OutOfPlaneAngle": out_of_plane,
            "InPlaneAngle": in_plane, "SourceOffsetX": s[0], "SourceOffsetY": s[1],
        }  # fmt: skip
        text.write("  <Projection>\n")
        for name, value in entries.items():
            text.write(f"    <{name}>{float(value)!r}</{name}>\n")
        rows = (" ".join(f"{value!r}" for value in line) for line in _matrix(turned, s, d).tolist())
        text.write("    <Matrix>\n      " + "\n      ".join(rows) + "\n    </Matrix>\n  </Projection>\n")
    text.write("</RTKThreeDCircularGeometry>\n")
    return text.getvalue()


def astra_vectors(frames: Frames) -> Array:
    """ASTRA's vectors [views, 12]: source or ray, detector centre, u, v, for `cone_vec` or `parallel3d_vec`."""
    return frames.packed().reshape(len(frames), 12)


def _matrix(turned: Array, source: Array, center: Array) -> Array:
    """World (RTK's axes) to detector mm, homogeneous [3, 4]: source and centre in the rotated axes."""
    distance = source[2] - center[2]
    shear = np.array([[-distance, 0, 0, distance * source[0]], [0, -distance, 0, distance * source[1]],
                      [0, 0, 1, -source[2]]])  # fmt: skip
    offset = np.array([[1, 0, source[0] - center[0]], [0, 1, source[1] - center[1]], [0, 0, 1]])
    whole = np.eye(4)
    whole[:3, :3] = turned
    found: Array = offset @ shear @ whole
    return found
