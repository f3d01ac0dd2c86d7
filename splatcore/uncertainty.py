"""How well the poses are known when the volume is not known either (docs/method.md, "Uncertainty").

A view's own 6x6 normal equations take the volume as given. It is not: at a frequency that one view alone shows,
the volume takes up whatever that view says, a shifted edge or noise alike, and nothing is left to tell the pose by.
By the slice theorem a view shows a plane of the object's spectrum, and an object of limited extent blurs that
plane to a thickness of one over its extent. How many planes pass within that thickness of a frequency is
therefore how many views share it; a view's own part in what the volume holds there is one in that many.
What is left to the pose, summed over frequencies, is the Fisher matrix with the volume marginalised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from splatcore import _native
from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.poses import Prior
from splatcore.splats import Floats, Splats

_LARGEST = 128  # detector edge on which derivative images are drawn; finer detail belongs to single views
_STEP_PX = 0.25  # of the central differences
_BLOCKS = 16  # a side of the detector
_COUPLED = 160  # views up to which poses are solved with each other's; beyond, each by itself


@dataclass(frozen=True)
class Slices:
    """Derivative images of every view as spectra about the isocentre's shadow."""

    spectra: np.ndarray  # complex64 [views, 6, cols, rows // 2 + 1]: along u whole, along v the half from zero up
    weights: Array  # [rows // 2 + 1]: how often a frequency along v counts; sum |spectra|^2 weights = sum of squares
    f_u: Array  # [cols] cycles per mm at the isocentre
    scores: Array  # [views, 6, 6] scatter of the pose's gradient


def pose_covariance(
    splats: Splats, frames: Frames, images: Floats, mask: Floats | None, huber: float, prior: Prior, threads: int
) -> Array:
    """Covariance of every view's pose error (omega rad, tau mm; world axes), the volume unknown and the gauge
    settled. [views, 6, 6]

    frames: corrected, at the size of images [views, rows, cols]; mask [rows, cols] or None; huber: residual beyond
    which a pixel counts less, as in the pose sweeps.
    """
    seen = _slices(splats, frames, images, mask, huber, threads)
    overlap = view_overlap(frames, seen.f_u, _extent(splats))
    if len(frames) <= _COUPLED:
        fisher = joint_fisher(seen, overlap, frames)
    else:
        fisher = _blocks(seen, overlap)
    own = np.einsum("vivj->vij", fisher.reshape(len(frames), 6, len(frames), 6))
    noise = np.trace(np.linalg.solve(own, seen.scores), axis1=1, axis2=2) / 6
    scale = np.repeat(1 / np.sqrt(noise), 6)
    return settled_covariance(fisher * scale[:, None] * scale, frames, prior)


def _extent(splats: Splats) -> Array:
    """Second central moments [3, 3], mm^2, of the space that splats fill: of the support, not of the density."""
    means = splats.means.astype(np.float64)
    inside = means[splats.density > 1e-2 * np.median(splats.density)]
    return np.cov(inside.T)


def view_overlap(frames: Frames, f_u: Array, extent: Array) -> Array:
    """How much of view k's slice view j shows at a frequency f along u: exp(-(2 pi f)^2 (u_k . n_j)^2 s_j^2), with
    n_j the direction of j's central ray and s_j the extent of the support along it. [cols, views, views]"""
    axes = frames.axes()
    spread = np.einsum("vi,ij,vj->v", axes[:, 2], extent, axes[:, 2])
    distance = np.einsum("ki,ji->kj", axes[:, 0], axes[:, 2]) ** 2 * spread
    distance = (distance + distance.T) / 2
    return np.exp(-((2 * np.pi * f_u[:, None, None]) ** 2) * distance)


def joint_fisher(seen: Slices, overlap: Array, frames: Frames) -> Array:
    """The pose block of the joint Fisher matrix, volume marginalised: D'(1 - P) D over the noise's variance, P the
    normalised overlap. [6 views, 6 views]"""
    views, _, cols, rows = seen.spectra.shape
    mirror = (-np.arange(cols)) % cols
    axes = frames.axes()
    # A view from the other side shows the same slice with u turned round.
    side = np.einsum("ki,ji->kj", axes[:, 0], axes[:, 0]) >= 0
    scaled = seen.spectra * np.sqrt(seen.weights).astype(np.float32)
    fisher = np.zeros((views, 6, views, 6))
    for index in range(cols):
        here = scaled[:, :, index].reshape(6 * views, rows)
        there = scaled[:, :, mirror[index]].reshape(6 * views, rows)
        same = (here @ here.conj().T).real.reshape(views, 6, views, 6)
        other = (here @ there.conj().T).real.reshape(views, 6, views, 6)
        reach = np.sqrt(overlap[index].sum(axis=1))
        share = overlap[index] / reach[:, None] / reach
        weight = np.where(side, -share, 0.0)
        np.fill_diagonal(weight, 1 - np.diagonal(share))
        fisher += weight[:, None, :, None] * same - np.where(side, 0.0, share)[:, None, :, None] * other
    return (fisher + fisher.transpose(2, 3, 0, 1)).reshape(6 * views, 6 * views) / 2


def _blocks(seen: Slices, overlap: Array) -> Array:
    """The views' own blocks of `joint_fisher`, other poses taken as known. [6 views, 6 views]"""
    raise NotImplementedError


def settled_covariance(fisher: Array, frames: Frames, prior: Prior) -> Array:
    """The views' blocks of the inverse, errors counted after `gauge.settle`. [views, 6, 6]"""
    views = len(frames)
    inverse = np.linalg.inv(fisher + np.diag(np.tile(prior.precision(), views)))
    out = gauge_directions(frames)
    basis = np.linalg.qr(out)[0]
    inverse -= basis @ (basis.T @ inverse)
    inverse -= (inverse @ basis) @ basis.T
    return np.einsum("vivj->vij", inverse.reshape(views, 6, views, 6))


def gauge_directions(frames: Frames) -> Array:
    """Pose increments that no projection tells from a moved object: rotation, translation and, for a cone beam,
    magnification of the world; lengths in mm. [6 views, 6 or 7]"""
    views = len(frames)
    columns = np.zeros((views, 6, 7 if frames.beam == "cone" else 6))
    columns[:, :, :6] = np.eye(6)
    if frames.beam == "cone":
        columns[:, 3:, 6] = frames.source
    return columns.reshape(6 * views, -1)


def _slices(
    splats: Splats, frames: Frames, images: Floats, mask: Floats | None, huber: float, threads: int
) -> Slices:
    factor = max(1, -(-min(frames.rows, frames.cols) // _LARGEST))
    small = frames.binned(factor)
    rows, cols, views = small.rows, small.cols, len(frames)
    renderer, fine = _native.Renderer32(rows, cols, threads), _native.Renderer32(frames.rows, frames.cols, threads)
    pitch = float(np.median(np.linalg.norm(small.u, axis=1) * small.isocentre_depth()))
    radius = float(np.linalg.norm(splats.means, axis=1).max())
    steps = np.array([_STEP_PX * pitch / radius] * 3 + [_STEP_PX * pitch] * 3)
    middle = small.project(np.zeros((1, 3)))[:, 0]
    spectra = np.empty((views, 6, cols, rows // 2 + 1), np.complex64)
    scores = np.empty((views, 6, 6))
    image = np.empty((frames.rows, frames.cols), np.float32)
    packed, cone = frames.packed(), frames.beam == "cone"
    for k in range(views):
        derivative = _derivatives(renderer, splats, small[k : k + 1], steps)
        fine.render(packed[k], cone, *splats.arrays(), image)
        scores[k] = _scores(derivative, image - images[k], mask, huber, factor)
        turn = np.exp(2j * np.pi * (fft.fftfreq(cols) * middle[k, 0])[:, None])
        turn = turn * np.exp(2j * np.pi * fft.rfftfreq(rows) * middle[k, 1])
        spectrum = fft.rfft(derivative, axis=1, workers=threads)  # along v
        spectra[k] = fft.fft(spectrum, axis=2, workers=threads).transpose(0, 2, 1) * turn
    weights = np.full(rows // 2 + 1, 2.0)
    weights[0] = 1.0
    if rows % 2 == 0:
        weights[-1] = 1.0
    weights *= factor**2 / (rows * cols)
    return Slices(spectra, weights, fft.fftfreq(cols) / pitch, scores)


def _derivatives(renderer: _native.Renderer32, splats: Splats, frame: Frames, steps: Array) -> Floats:
    """Central differences of one view's image along omega and tau. [6, rows, cols]"""
    images = np.empty((2, 6, frame.rows, frame.cols), np.float32)
    for sign, row in zip((1.0, -1.0), images, strict=True):
        motions = RigidMotions.exp(sign * np.diag(np.r_[steps[:3], 0, 0, 0])[:, :3], sign * np.diag(steps)[:, 3:])
        for j in range(6):
            moved = RigidMotions(motions.rotation[j : j + 1], motions.translation[j : j + 1]).correct(frame)
            renderer.render(moved.packed()[0], frame.beam == "cone", *splats.arrays(), row[j])
    return (images[0] - images[1]) / (2 * steps[:, None, None]).astype(np.float32)


def _scores(derivative: Floats, residual: Floats, mask: Floats | None, huber: float, factor: int) -> Array:
    """Sum of outer products of the score over square blocks of the detector, as small as the model's own error is
    wide: what the pose's gradient scatters by, however pixels depend on each other. [6, 6]"""
    weight = np.minimum(1, huber / np.maximum(np.abs(residual), 1e-20))
    inside = (np.abs(residual) <= huber).astype(np.float64)
    if mask is not None:
        weight, inside = weight * mask, inside * mask
    score = derivative * (_block_mean(weight * residual, factor) * factor**2)
    edge = max(1, min(score.shape[1:]) // _BLOCKS)
    rows, cols = score.shape[1] // edge, score.shape[2] // edge
    blocks = score[:, : rows * edge, : cols * edge].reshape(6, rows, edge, cols, edge).sum(axis=(2, 4)).reshape(6, -1)
    # A pixel beyond the corner adds to the scatter but no longer to the curvature.
    squares = (derivative.astype(np.float64) ** 2).sum(axis=0)
    kept = float((squares * _block_mean(inside, factor)).sum() / max(float(squares.sum()), 1e-300))
    return (blocks.astype(np.float64) @ blocks.T) / max(kept, 0.1) ** 2


def _block_mean(image: Array, factor: int) -> Array:
    rows, cols = image.shape[0] // factor, image.shape[1] // factor
    return image[: rows * factor, : cols * factor].reshape(rows, factor, cols, factor).mean(axis=(1, 3))
