"""What no projection can tell, and how it is settled (docs/method.md, "Gauge").

A cone-beam scan leaves seven directions open: a rigid motion of the whole world, and magnification, which
slides every source along its own line to the isocentre while the object grows and its density falls. A
parallel-beam scan leaves six, and each view's shift along its ray. The world is settled where the poses
are nearest the nominal ones: mean rotation zero, translation and magnification by least squares.
"""

from __future__ import annotations

import numpy as np

from splatcore.geometry import Array, Frames, RigidMotions, rotation_from_vector, vector_from_rotation
from splatcore.splats import Similarity


def settle(nominal: Frames, motions: RigidMotions) -> tuple[Similarity, RigidMotions]:
    """The similarity of the world that brings the motions nearest the identity, and the motions after it.

    The object must be moved by the similarity (`Splats.moved`) for the projections to stay as they are.
    With x' = s Q x + t a view's pose R x + tau becomes R Q' (x' - t) / s + tau, and scaling a cone view
    about its source S leaves its image alone: R' = R Q', tau' = s tau + (1 - s) S - R Q' t.
    """
    turn = mean_rotation(motions.rotation)
    rotation = motions.rotation @ turn.T
    # tau' = tau + (s - 1) (tau - S) - R' t, least squares in (t, s - 1).
    columns = [-rotation]
    if nominal.beam == "cone":
        columns.append((motions.translation - nominal.source)[:, :, None])
    matrix = np.concatenate(columns, axis=2)
    target = motions.translation
    if nominal.beam == "parallel":
        across = np.eye(3) - nominal.source[:, :, None] * nominal.source[:, None, :]
        matrix, target = across @ matrix, np.einsum("vij,vj->vi", across, target)
    solution = np.linalg.lstsq(matrix.reshape(-1, matrix.shape[2]), -target.ravel(), rcond=None)[0]
    shift = solution[:3]
    scale = 1.0 + float(solution[3]) if nominal.beam == "cone" else 1.0
    translation = target + np.einsum("vij,j->vi", matrix, solution)
    return Similarity(turn, np.asarray(shift, np.float64), scale), RigidMotions(rotation, translation)


def mean_rotation(rotations: Array) -> Array:
    """The Q that makes the rotation vectors of R_k Q' sum to zero (Karcher mean). [3, 3]"""
    turn = np.eye(3)
    for _ in range(20):
        mean = vector_from_rotation(rotations @ turn.T).mean(axis=0)
        turn = rotation_from_vector(mean) @ turn
        if np.linalg.norm(mean) < 1e-14:
            break
    return turn


def pose_errors(true: Frames, estimated: Frames) -> RigidMotions:
    """T_true^-1 T_est of every view, a motion of the world (design of the scores: RMS of its angle and length)."""
    rotation = np.einsum("vji,vjk->vik", true.axes(), estimated.axes())
    there, here = true.origin(), estimated.origin()
    translation = there - np.einsum("vij,vj->vi", rotation, here)
    if true.beam == "parallel":
        ray = true.source
        translation -= np.sum(translation * ray, axis=1, keepdims=True) * ray
    return RigidMotions(rotation, translation)


def align(true: Frames, estimated: Frames) -> tuple[Similarity, Frames]:
    """The similarity of the estimated world that brings its poses nearest the true ones, and the
    estimated frames after it. Move the splats by the same similarity."""
    similarity, _ = settle(true, pose_errors(true, estimated))
    return similarity, moved_frames(estimated, similarity)


def moved_frames(frames: Frames, similarity: Similarity) -> Frames:
    """Frames that see the moved world as these see the old one. Of a cone view the detector moves along
    with the source, its size unchanged: scaling about the source changes no image."""
    turn, shift, scale = similarity.rotation, similarity.translation, similarity.scale

    def place(points: Array) -> Array:
        return scale * points @ turn.T + shift

    cone = frames.beam == "cone"
    first = place(frames.source) if cone else frames.source @ turn.T
    center = first + (frames.detector_center - frames.source) @ turn.T if cone else place(frames.detector_center)
    return Frames(frames.beam, first, center, frames.u @ turn.T, frames.v @ turn.T, frames.rows, frames.cols)
