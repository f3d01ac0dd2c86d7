"""How much each ray counts in a backprojection: views by the angle they stand for, rays by how often they are seen.

A full circle sees every ray of the midplane twice, once from either end; a short scan sees some twice and others
once; a detector off its middle (half fan) likewise. Both copies of a ray must weigh one in all, and the weight must
not jump where the second copy ends, or the ramp filter turns the jump into a streak. So every ray gets a confidence c
that falls smoothly to zero where the scan ends (Noo, Defrise, Clackdoyle and Kudo, 2002) and where the detector ends
(Wang, X-ray micro-CT with a displaced detector array, 2002), and weighs c / (c + c of its other copy).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatcore.geometry import Array, Frames
from splatcore.grid import VolumeGrid

_SAME_ANGLE = np.deg2rad(1e-3)  # views closer than this stand at one angle
# The widest gap between neighbouring views is the end of a short scan if it exceeds both, else a hole in a full turn.
_OPEN, _OPEN_STEPS = np.deg2rad(20.0), 3.0  # rad, times the usual step
_POINTS = 32  # an axis, at which coverage is looked up
_STEPS_OF_TAPER = 3.0  # between views, at the ends of a scan that overlaps itself by less


@dataclass(frozen=True)
class Orbit:
    """The views by their angle about z, and the arc that they cover without a wide gap."""

    angle: Array  # [views] rad, of the source (against the ray: parallel) about z
    step: Array  # [views] rad, half the way to the neighbour on either side
    start: float  # rad, where the arc begins, half a step before the first view
    arc: float  # rad, 2 pi for a full turn

    @property
    def full(self) -> bool:
        """Whether it is a full turn."""
        return self.arc == 2 * np.pi

    def confidence(self, angle: Array) -> Array:
        """1 inside the arc, 0 outside, a smooth way between over what the scan sees twice. Any shape, rad."""
        if self.full:
            return np.ones_like(angle)
        taper = max(self.arc - np.pi, _STEPS_OF_TAPER * float(np.median(self.step)))
        taper = min(taper, self.arc / 2)
        along = (angle - self.start) % (2 * np.pi)
        return _rise(np.minimum(along, self.arc - along) / taper)


def _rise(share: Array) -> Array:
    """sin^2, from 0 at 0 to 1 at 1."""
    return np.sin(np.pi / 2 * np.clip(share, 0, 1)) ** 2


def orbit(frames: Frames) -> Orbit:
    """The views' order on the circle."""
    outward = frames.source if frames.beam == "cone" else -frames.source
    angle = np.arctan2(outward[:, 1], outward[:, 0])
    order = np.argsort(angle)
    gaps = np.diff(angle[order], append=angle[order[0]] + 2 * np.pi)
    apart = gaps[gaps > _SAME_ANGLE]  # a scan of several turns sees every angle more than once
    usual = float(np.median(apart if apart.size else gaps))
    last, start, arc = int(np.argmax(gaps)), float(angle[order[0]]), 2 * np.pi
    if gaps[last] > max(_OPEN, _OPEN_STEPS * usual):
        start = float(angle[order[(last + 1) % len(order)]]) - usual / 2
        arc = 2 * np.pi - float(gaps[last]) + usual
        gaps[last] = usual
    step = np.empty(len(angle))
    step[order] = (gaps + np.roll(gaps, 1)) / 2
    return Orbit(angle, step, start, arc)


def ray_weights(frames: Frames) -> Array:
    """The weight of every detector column in every view, rad: what plain summation of filtered views must multiply
    them by. [views, cols]

    The rays looked at are those of the row on which the isocentre falls. Over all views that see a ray the weights
    sum to the angle it stands for, pi in all; where less than half a turn is seen, all are raised in proportion."""
    turn = orbit(frames)
    distance, opposite = _midplane_rays(frames)
    low, high = distance.min(axis=1), distance.max(axis=1)
    pixel = np.linalg.norm(frames.u, axis=1) * frames.isocentre_depth()
    half = (high - low) / (2 * (frames.cols - 1)) if frames.cols > 1 else pixel / 2  # to the edges of the outer pixels
    low, high = low - half, high + half
    here = turn.confidence(turn.angle)[:, None] * _on_detector(distance, low[:, None], high[:, None])
    other = _nearest(turn.angle, opposite)
    there = turn.confidence(opposite) * _on_detector(-distance, low[other], high[other])
    share = np.where(here > 0, here / np.maximum(here + there, 1e-12), 0.0)
    return turn.step[:, None] * share * max(1.0, np.pi / turn.arc)


def lopsidedness(frames: Frames) -> float:
    """How far the detector is off its middle: 0 where the axis is in it, 1 where the axis is at its end or off it."""
    distance, _ = _midplane_rays(frames)
    low, high = -distance.min(axis=1), distance.max(axis=1)
    return float(np.median(1 - np.maximum(np.minimum(low, high), 0) / np.maximum(np.maximum(low, high), 1e-9)))


def coverage(frames: Frames, grid: VolumeGrid) -> Array:
    """The share of all directions across the axis from which each voxel is seen: the ray weights through it, summed
    over views, over pi. Looked up on at most 32 points an axis. [z, y, x]"""
    weights = np.pad(ray_weights(frames), ((0, 0), (1, 1)))
    z, y, x = (np.unique(np.linspace(0, n - 1, min(n, _POINTS)).round().astype(int)) for n in grid.shape)
    points = grid.centers_mm()[np.ix_(z, y, x)]
    total = np.zeros(points.shape[:3])
    for k in range(len(frames)):
        column = frames[k : k + 1].project(points.reshape(-1, 3))[0, :, 0].reshape(total.shape)
        total += weights[k, np.clip(np.round(column), -1, frames.cols).astype(int) + 1]
    for axis, (n, at) in enumerate(zip(grid.shape, (z, y, x), strict=True)):
        middle = (at[1:] + at[:-1]) / 2
        total = np.take(total, np.searchsorted(middle, np.arange(n)), axis=axis)
    return total / np.pi


def _midplane_rays(frames: Frames) -> tuple[Array, Array]:
    """(signed distance from the axis in mm, the angle rad of the source that sees the same ray from its other
    end) of every column's ray, in the row on which the isocentre falls, seen along z. [views, cols] each"""
    row = frames.project(np.zeros((1, 3)))[:, 0, 1] - (frames.rows - 1) / 2
    row = np.where(np.isfinite(row), row, 0.0)
    columns = np.arange(frames.cols) - (frames.cols - 1) / 2
    point = frames.detector_center[:, None] + columns[:, None] * frames.u[:, None] + (row[:, None] * frames.v)[:, None]
    if frames.beam == "cone":
        from_ = np.broadcast_to(frames.source[:, None, :2], (*point.shape[:2], 2))
        along = point[..., :2] - from_
    else:
        from_ = point[..., :2]
        along = np.broadcast_to(frames.source[:, None, :2], from_.shape)
    along = along / np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-12)
    distance = from_[..., 0] * along[..., 1] - from_[..., 1] * along[..., 0]
    # The ray leaves the circle of the sources where its other copy starts; parallel sources are infinitely far.
    other = along if frames.beam == "parallel" else from_ - 2 * np.sum(from_ * along, axis=2, keepdims=True) * along
    return distance, np.arctan2(other[..., 1], other[..., 0])


def _on_detector(distance: Array, low: Array, high: Array) -> Array:
    """1 for rays well inside the distances from the axis that a view sees, 0 outside them. It falls over the part
    that lies as near the axis as the nearer end does: all that is seen twice, if the axis is on the detector."""
    width = 2 * np.maximum(np.minimum(-low, high), 1e-9)
    return _rise((distance - low) / width) * _rise((high - distance) / width)


def _nearest(angles: Array, wanted: Array) -> Array:
    """Index of the view whose angle is nearest, round the circle; the shape of `wanted`."""
    order = np.argsort(angles)
    ring = np.concatenate([angles[order[-1:]] - 2 * np.pi, angles[order], angles[order[:1]] + 2 * np.pi])
    middle = (ring[1:] + ring[:-1]) / 2
    found: Array = np.concatenate([order[-1:], order, order[:1]])[np.searchsorted(middle, wanted)]
    return found
