"""A detector that is one line of pixels: fan beams and single slices.

Such a view sees one plane of the object, so that of its six freedoms three are left: a turn about the plane's normal
and two shifts in it. What would leave the plane is taken out of the normal equations, not held by a prior, and the
splats are kept on the plane: their gradient across it is zero but for rounding, which Adam would blow up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatcore.geometry import Array, Frames
from splatcore.splats import Floats

_STRAIN = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # the components of a strain, in order
_ONE_PLANE = 0.99  # share of the views' normals along one direction


@dataclass(frozen=True)
class Plane:
    """The plane that all views of a line detector see."""

    point: Array  # [3] mm
    normal: Array  # [3] unit

    def flatten(self, means: Floats) -> None:
        """Put points [n, 3] mm onto the plane, in place."""
        means -= ((means - self.point) @ self.normal)[:, None] * self.normal


def common_plane(frames: Frames) -> Plane | None:
    """The plane of a fan-beam scan; None where the detector has an area, or where every view sees another plane, as
    with a single column along the rotation axis."""
    if not frames.line:
        return None
    normals = frames.plane_normals()
    share, axes = np.linalg.eigh(np.einsum("vi,vj->ij", normals, normals) / len(normals))
    if share[2] < _ONE_PLANE:
        return None
    point = (frames.source if frames.beam == "cone" else frames.detector_center).mean(axis=0)
    return Plane(point, axes[:, 2])


def in_plane(frames: Frames) -> Array:
    """What a line detector can show: projectors of (omega, tau, strain) onto the turn about the normal n of a view's
    plane, shifts along the plane, and the strains E of a common plane, E n = 0 (all strains where there is none).
    [views, 12, 12]"""
    normal = frames.plane_normals()
    across = normal[:, :, None] * normal[:, None, :]
    free = np.zeros((len(frames), 12, 12))
    free[:, :3, :3], free[:, 3:6, 3:6], free[:, 6:, 6:] = across, np.eye(3) - across, np.eye(6)
    plane = common_plane(frames)
    if plane is not None:
        first, second = np.linalg.svd(plane.normal[None])[2][1:]
        pairs = ((first, first), (second, second), (first, second))
        strains = [np.outer(a, b) + np.outer(b, a) for a, b in pairs]
        basis, _ = np.linalg.qr(np.array([[e[at] for at in _STRAIN] for e in strains]).T)
        free[:, 6:, 6:] = basis @ basis.T
    return free


def unseen(frames: Frames) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Components of omega and of tau that share in a direction which leaves the plane. [views, 3] each, bool"""
    seen = np.diagonal(in_plane(frames), axis1=1, axis2=2) > 1 - 1e-6
    return ~seen[:, :3], ~seen[:, 3:6]
