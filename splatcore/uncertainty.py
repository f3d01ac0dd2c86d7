"""How well the poses are known when the volume is not known either (docs/method.md, "Uncertainty").

A view's own 6x6 normal equations take the volume as given. It is not: at a frequency that one view alone shows,
the volume takes up whatever that view says, a shifted edge or noise alike, and nothing is left to tell the pose by.
By the slice theorem a view shows a plane of the object's spectrum, and an object of limited extent blurs that
plane to a thickness of one over its extent. How many planes pass within that thickness of a frequency is
therefore how many views share it; a view's own part in what the volume holds there is one in that many.
What is left to the pose, summed over frequencies, is the Fisher matrix with the volume marginalised: the bread of
a sandwich. Its filling is how the pose's gradient really scatters, over blocks of the detector, so that the
reconstruction's own error counts as well as noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special

from splatcore import _native
from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.poses import Prior
from splatcore.splats import Floats, Splats

_LARGEST = 128  # detector edge on which derivative images are drawn; finer detail belongs to single views
_STEP_PX = 0.25  # of the central differences
_BLOCKS = 16  # a side of the detector, of the scores; 32 give the same, with few the scores' zero sum shows
_COUPLED = 160  # views up to which poses are solved with each other's; beyond, each by itself
_FAINTEST = 0.01  # of the median density: fainter splats do not say how far the object reaches


@dataclass(frozen=True)
class Slices:
    """The derivative images of every view as spectra, phases counted from the isocentre's shadow."""

    spectra: NDArray[np.complex64]  # [views, 6, cols, half], half = rows // 2 + 1: all of u, v from zero up
    f_u: Array  # [cols] cycles per mm at the isocentre
    scores: Array  # [views, 6, 6] scatter of the pose's gradient


def pose_covariance(
    splats: Splats, frames: Frames, images: Floats, mask: Floats | None, huber: float, prior: Prior, threads: int
) -> Array:
    """Covariance of every view's pose error (omega rad, tau mm; world axes), the volume unknown and the gauge
    settled. [views, 6, 6]

    frames: corrected, at the size of images [views, rows, cols]; mask [rows, cols] or None; huber: residual beyond
    which a pixel counts less, as in the pose sweeps. Beyond 160 views the other views' poses are taken as known.
    """
    seen = derivative_slices(splats, frames, images, mask, huber, threads)
    support = extent(splats)
    if len(frames) > _COUPLED:
        own = own_fisher(seen, frames, support)
        noise = _noise(own, seen.scores)
        return np.asarray(np.linalg.inv(own / noise[:, None, None] + np.diag(prior.precision())), np.float64)
    fisher = joint_fisher(seen, frames, support)
    scale = np.repeat(1 / np.sqrt(_noise(own_blocks(fisher), seen.scores)), 6)
    return settled_covariance(fisher * scale[:, None] * scale, frames, prior)


def _noise(own: Array, scores: Array) -> Array:
    """Variance of a pixel: the scores' scatter in units of what independent noise of variance one leaves of it. [views]

    A residual has lost the share that the volume took up, and so has its product with the derivative: the marginal
    matrix and not the view's own normal equations is what divides it."""
    scale = np.sqrt(np.maximum(np.diagonal(own, axis1=1, axis2=2), 1e-300))
    norm = scale[:, :, None] * scale[:, None, :]
    ratio = np.linalg.solve(own / norm + 1e-9 * np.eye(6), scores / norm)
    return np.maximum(np.trace(ratio, axis1=1, axis2=2) / 6, 1e-30)


def extent(splats: Splats) -> Array:
    """Second central moments [3, 3], mm^2, of the space that splats fill: of the support, not of the density."""
    inside = splats.means[splats.density > _FAINTEST * np.median(splats.density)].astype(np.float64)
    away = inside - inside.mean(axis=0)
    moments: Array = away.T @ away / len(inside)
    return moments


def overlap(frames: Frames, f: float, support: Array) -> tuple[Array, Array]:
    """What view j tells of view k's slice at a frequency f along u (cycles per mm): two [views, views], of j at the
    same frequency and at the opposite one, as views from the other side show it.

    Squared correlation of two Fourier coefficients of a white random object in an ellipse whose second moments are
    those of the support: (2 J1(x) / x)^2, x = 4 pi sqrt(d'C d), d = f (u_k -+ u_j)."""
    u = frames.axes()[:, 0]
    kernels = []
    for sign in (1.0, -1.0):
        apart = u[:, None] - sign * u[None]
        x = 4 * np.pi * abs(f) * np.sqrt(np.maximum(np.einsum("kji,il,kjl->kj", apart, support, apart), 0))
        safe = np.maximum(x, 1e-6)
        kernels.append((2 * special.j1(safe) / safe) ** 2)
    return kernels[0], kernels[1]


def joint_fisher(seen: Slices, frames: Frames, support: Array) -> Array:
    """The pose block of the joint Fisher matrix with the volume marginalised, for noise of variance one: D'(1 - P)D,
    where P, the volume's hat matrix, is the overlap divided by its sum over all views. [6 views, 6 views]"""
    views, _, cols, half = seen.spectra.shape
    fisher = np.zeros((views, 6, views, 6))
    for index in range(cols):
        same, other = overlap(frames, float(seen.f_u[index]), support)
        reach = np.sqrt((same + other).sum(axis=1))
        norm = reach[:, None] * reach
        here = seen.spectra[:, :, index].reshape(6 * views, half)
        there = seen.spectra[:, :, -index % cols].reshape(6 * views, half)
        kept = (np.eye(views) - same / norm)[:, None, :, None]
        fisher += kept * (here @ here.conj().T).real.reshape(fisher.shape)
        fisher -= (other / norm)[:, None, :, None] * (here @ there.conj().T).real.reshape(fisher.shape)
    square = fisher.reshape(6 * views, 6 * views)
    return (square + square.T) / 2


def own_fisher(seen: Slices, frames: Frames, support: Array) -> Array:
    """The views' own blocks of `joint_fisher`, without the rest. [views, 6, 6]"""
    views, _, cols, _ = seen.spectra.shape
    total = np.zeros((views, 6, 6))
    for index in range(cols):
        same, other = overlap(frames, float(seen.f_u[index]), support)
        reach = (same + other).sum(axis=1)
        here, there = seen.spectra[:, :, index], seen.spectra[:, :, -index % cols]
        total += (1 - np.diagonal(same) / reach)[:, None, None] * (here @ here.conj().transpose(0, 2, 1)).real
        total -= (np.diagonal(other) / reach)[:, None, None] * (here @ there.conj().transpose(0, 2, 1)).real
    return (total + total.transpose(0, 2, 1)) / 2


def own_blocks(square: Array) -> Array:
    """The diagonal 6x6 blocks of a matrix of all poses. [views, 6, 6]"""
    views = len(square) // 6
    blocks: Array = np.einsum("vivj->vij", square.reshape(views, 6, views, 6)).copy()
    return blocks


def settled_covariance(fisher: Array, frames: Frames, prior: Prior) -> Array:
    """The views' blocks of the inverse of a pose Fisher matrix, errors counted after `gauge.settle`. [views, 6, 6]"""
    inverse = np.asarray(np.linalg.inv(fisher + np.diag(np.tile(prior.precision(), len(frames)))), np.float64)
    basis = np.linalg.qr(gauge_directions(frames))[0]
    inverse -= basis @ (basis.T @ inverse)
    inverse -= (inverse @ basis) @ basis.T
    return own_blocks(inverse)


def gauge_directions(frames: Frames) -> Array:
    """Pose increments that no projection tells from a moved object: rotation, translation and, for a cone beam,
    magnification of the world; lengths in mm. [6 views, 6 or 7]

    Rotations and translations share no component, so taking these out of errors is what `gauge.settle` does."""
    views = len(frames)
    columns = np.zeros((views, 6, 7 if frames.beam == "cone" else 6))
    columns[:, :, :6] = np.eye(6)
    if frames.beam == "cone":
        columns[:, 3:, 6] = frames.source
    return columns.reshape(6 * views, -1)


def derivative_slices(
    splats: Splats, frames: Frames, images: Floats, mask: Floats | None, huber: float, threads: int
) -> Slices:
    """Draw and transform the derivatives; arguments as for `pose_covariance`."""
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
    # Sums over the half spectrum are sums over full-size pixels.
    weights = np.full(rows // 2 + 1, 2.0)
    weights[0] = 1.0
    if rows % 2 == 0:
        weights[-1] = 1.0
    weights = np.sqrt(weights * factor**2 / (rows * cols))
    image = np.empty((frames.rows, frames.cols), np.float32)
    packed, cone = frames.packed(), frames.beam == "cone"
    for k in range(views):
        derivative = _derivatives(renderer, splats, small[k : k + 1], steps)
        fine.render(packed[k], cone, *splats.arrays(), image)
        scores[k] = _scores(derivative, image - images[k], mask, huber, factor)
        turn = np.exp(2j * np.pi * fft.fftfreq(cols) * middle[k, 0])[:, None]
        turn = turn * np.exp(2j * np.pi * fft.rfftfreq(rows) * middle[k, 1]) * weights
        spectrum = fft.rfft(derivative, axis=1, workers=threads)  # along v
        spectra[k] = fft.fft(spectrum, axis=2, workers=threads).transpose(0, 2, 1) * turn
    return Slices(spectra, fft.fftfreq(cols) / pitch, scores)


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
    """Outer products of the score, summed over square blocks of the detector: the scatter of the pose's gradient,
    however pixels of a block depend on each other. [6, 6]"""
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
