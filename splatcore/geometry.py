"""Frames: where source and detector stand in every view, as world vectors in millimetres.

                     v (one row down)          World: right-handed, origin at the isocentre,
                     |                         +z the rotation axis.
    S  . . . . . . . D --> u (one column)      Pixel (r, c) of the stored image lies at
  source      detector centre                  D + (c - (cols-1)/2) u + (r - (rows-1)/2) v.

A cone-beam frame is (source, detector_center, u, v); a parallel one has the direction `ray`
(unit, source to detector) in place of the source. u x v may point either way.

A pose correction of a view is a rigid motion of the object about the isocentre,
camera(x) = nominal(R x + t); `RigidMotions` holds one for each view. Arrays are float64.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Beam = Literal["cone", "parallel"]


@dataclass(frozen=True)
class Frames:
    """The views of a scan. `source` holds unit ray directions where `beam` is parallel."""

    beam: Beam
    source: Array  # [views, 3] mm (cone) or unit direction (parallel)
    detector_center: Array  # [views, 3] mm
    u: Array  # [views, 3] mm, one column
    v: Array  # [views, 3] mm, one row
    rows: int
    cols: int

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, views: Any) -> Frames:
        """The chosen views (a slice, a mask or an index array)."""
        return replace(
            self,
            source=self.source[views],
            detector_center=self.detector_center[views],
            u=self.u[views],
            v=self.v[views],
        )

    @property
    def line(self) -> bool:
        """Whether the detector is one line of pixels, so that a view sees one plane of the object: a fan beam."""
        return min(self.rows, self.cols) == 1 < max(self.rows, self.cols)

    def plane_normals(self) -> Array:
        """Unit normals of the planes that the views of a line detector see. [views, 3]"""
        along = self.u if self.rows == 1 else self.v
        ray = self.detector_center - self.source if self.beam == "cone" else self.source
        normal = np.cross(along, ray)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def binned(self, down: int, across: int | None = None) -> Frames:
        """The frames of images whose pixels are means of blocks of `down` rows by `across` columns (default: as many).

        Trailing rows and columns that fill no block are dropped, so the centre may move.
        """
        across = down if across is None else across
        rows, cols = self.rows // down, self.cols // across
        shift_c = (cols * across - self.cols) / 2
        shift_r = (rows * down - self.rows) / 2
        center = self.detector_center + shift_c * self.u + shift_r * self.v
        return replace(self, detector_center=center, u=self.u * across, v=self.v * down, rows=rows, cols=cols)

    def axes(self) -> Array:
        """Orthonormal detector axes as rows: along u, along v made square to u, their cross product. [views, 3, 3]"""
        first = self.u / np.linalg.norm(self.u, axis=1, keepdims=True)
        third = np.cross(first, self.v)
        third /= np.linalg.norm(third, axis=1, keepdims=True)
        return np.stack([first, np.cross(third, first), third], axis=1)

    def pixel_from_world(self) -> Array:
        """K [views, 3, 3] with q = K (x - origin): for a cone column = q0/q2, row = q1/q2 and q2 the
        fraction of the way from source to detector plane; parallel: column = q0, row = q1. Columns
        and rows count from the detector's centre; `origin()` is the point to subtract."""
        third = self.detector_center - self.source if self.beam == "cone" else self.source
        return np.linalg.inv(np.stack([self.u, self.v, third], axis=2))

    def origin(self) -> Array:
        """The point that `pixel_from_world` measures from. [views, 3] mm"""
        return self.source if self.beam == "cone" else self.detector_center

    def isocentre_depth(self) -> Array:
        """The share of the way from source to detector plane at which the isocentre lies: what a pixel shrinks by
        there. Ones for a parallel beam. [views]"""
        if self.beam == "parallel":
            return np.ones(len(self))
        return np.abs(np.einsum("vi,vi->v", self.pixel_from_world()[:, 2], self.source))

    def project(self, points: Array) -> Array:
        """Points [n, 3] mm to (column, row) array indices. [views, n, 2]"""
        q = np.einsum("vij,vnj->vni", self.pixel_from_world(), points[None] - self.origin()[:, None])
        if self.beam == "cone":
            q = q[..., :2] / q[..., 2:]
        return q[..., :2] + np.array([(self.cols - 1) / 2, (self.rows - 1) / 2])

    def packed(self) -> Array:
        """[views, 4, 3]: source (or ray), detector centre, u, v, as the core takes them."""
        return np.ascontiguousarray(np.stack([self.source, self.detector_center, self.u, self.v], axis=1))

    def shifted_detector(self, columns: float, rows: float = 0.0) -> Frames:
        """The detector moved in its own plane, in pixels."""
        return replace(self, detector_center=self.detector_center + columns * self.u + rows * self.v)

    def to_json(self) -> list[dict[str, list[float]]]:
        """One dict per view, as in scan.json and poses.json."""
        first = "source" if self.beam == "cone" else "ray"
        return [
            {first: s.tolist(), "detector_center": d.tolist(), "u": u.tolist(), "v": v.tolist()}
            for s, d, u, v in zip(self.source, self.detector_center, self.u, self.v, strict=True)
        ]


def circular(
    beam: Beam,
    angles_deg: Array,
    dso_mm: float,
    dsd_mm: float,
    rows: int,
    cols: int,
    pixel_mm: tuple[float, float],
    offset_mm: tuple[float, float] = (0.0, 0.0),
) -> Frames:
    """Nominal frames of a circular orbit about +z. pixel and offset are [v, u]."""
    angle = np.deg2rad(np.asarray(angles_deg, np.float64))
    zero = np.zeros_like(angle)
    outward = np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
    along_u = np.stack([-np.sin(angle), np.cos(angle), zero], axis=1)
    along_v = np.broadcast_to(np.array([0.0, 0.0, -1.0]), along_u.shape).copy()
    center = -(dsd_mm - dso_mm) * outward + offset_mm[1] * along_u + offset_mm[0] * along_v
    source = dso_mm * outward if beam == "cone" else -outward
    return Frames(beam, source, center, along_u * pixel_mm[1], along_v * pixel_mm[0], rows, cols)


def rotation_from_vector(vector: Array) -> Array:
    """Exp: rotation vectors [..., 3] rad to matrices [..., 3, 3] (Rodrigues)."""
    w = np.asarray(vector, np.float64)
    theta = np.linalg.norm(w, axis=-1)[..., None, None]
    skew = np.zeros((*w.shape[:-1], 3, 3))
    skew[..., 0, 1], skew[..., 0, 2], skew[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    skew -= np.swapaxes(skew, -1, -2)
    half = np.sinc(theta / (2 * np.pi))  # sin(theta/2) / (theta/2)
    return np.eye(3) + np.sinc(theta / np.pi) * skew + 0.5 * half**2 * (skew @ skew)


def vector_from_rotation(matrix: Array) -> Array:
    """Log: rotation matrices [..., 3, 3] to rotation vectors [..., 3] rad, angle in [0, pi]."""
    r = np.asarray(matrix, np.float64)
    # Through the quaternion, whose largest component is found first: exact at 0 and at pi alike.
    m00, m11, m22 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    squares = np.stack([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], -1)
    a, b, c = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    d, e, f = r[..., 1, 0] + r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 2, 1] + r[..., 1, 2]
    rows = np.stack(
        [
            np.stack([squares[..., 0], a, b, c], -1),
            np.stack([a, squares[..., 1], d, e], -1),
            np.stack([b, d, squares[..., 2], f], -1),
            np.stack([c, e, f, squares[..., 3]], -1),
        ],
        axis=-2,
    )
    best = np.argmax(squares, axis=-1)
    quat = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    quat = np.where(quat[..., :1] < 0, -quat, quat)
    sine = np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quat[..., :1])
    scale = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return quat[..., 1:] * scale


def quaternion_from_rotation(matrix: Array) -> Array:
    """The unit quaternion w x y z, w not negative, of a rotation matrix. [3, 3] -> [4]"""
    vector = vector_from_rotation(matrix)
    half = float(np.linalg.norm(vector)) / 2
    return np.concatenate([[np.cos(half)], 0.5 * np.sinc(half / np.pi) * vector])


@dataclass(frozen=True)
class RigidMotions:
    """x -> rotation x + translation, one for each view."""

    rotation: Array  # [views, 3, 3]
    translation: Array  # [views, 3] mm

    @classmethod
    def identity(cls, views: int) -> RigidMotions:
        return cls(np.tile(np.eye(3), (views, 1, 1)), np.zeros((views, 3)))

    @classmethod
    def exp(cls, omega: Array, tau: Array) -> RigidMotions:
        """Rotation vectors [views, 3] rad and translations [views, 3] mm."""
        return cls(rotation_from_vector(omega), np.array(tau, np.float64))

    def __len__(self) -> int:
        return len(self.rotation)

    def __getitem__(self, views: Any) -> RigidMotions:
        """The chosen views (a slice, a mask or an index array)."""
        return RigidMotions(self.rotation[views], self.translation[views])

    def vectors(self) -> tuple[Array, Array]:
        """(omega rad, tau mm), the inverse of `exp`."""
        return vector_from_rotation(self.rotation), self.translation

    def __matmul__(self, first: RigidMotions) -> RigidMotions:
        """`a @ b` moves by b, then by a. An increment acts on the left: increment @ pose."""
        return RigidMotions(
            self.rotation @ first.rotation,
            np.einsum("vij,vj->vi", self.rotation, first.translation) + self.translation,
        )

    def inverse(self) -> RigidMotions:
        back = np.swapaxes(self.rotation, 1, 2)
        return RigidMotions(back, -np.einsum("vij,vj->vi", back, self.translation))

    def correct(self, nominal: Frames) -> Frames:
        """Frames that see x as the nominal ones see R x + t: (R'(s-t), R'(d-t), R'u, R'v)."""
        back = np.swapaxes(self.rotation, 1, 2)

        def turn(vectors: Array) -> Array:
            return np.einsum("vij,vj->vi", back, vectors)

        cone = nominal.beam == "cone"
        return replace(
            nominal,
            source=turn(nominal.source - self.translation) if cone else turn(nominal.source),
            detector_center=turn(nominal.detector_center - self.translation),
            u=turn(nominal.u),
            v=turn(nominal.v),
        )
