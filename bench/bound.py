"""How well poses can be known at all: the Cramer-Rao bound of a simulated scan, from its truth.

    python bench/bound.py SCAN [SCAN ...] [--edge 32] [--samples 3] [--json FILE]

`known` is the bound with the volume known: the inverse 6x6 Fisher matrix of every view at full size, at the true
frames, with R2-Gaussian's noise. `ratio` is by how much it grows when the volume is not known: the square root of
the pose block's trace of the inverse joint Fisher matrix of volume and poses, over the same with the volume known.
It is computed on the same object at `--edge` voxels with as many fewer pixels and views, so that unknowns per
measurement, views per voxel and noise per pixel are those of the scan. `joint` is their product.

The volume's prior is a Gaussian one: neighbouring voxels differ by a normal deviate as large, in the mean square,
as they do in the truth (`--prior 1`; 0.1 is a tenth of that precision), inside the cylinder of the field of view.
The seven directions that no projection shows are settled as `splatcore.gauge` settles them.

How: an exact draw from the posterior is the solution of the normal equations with noise on the right-hand side
(Papandreou and Yuille, "Gaussian sampling by local perturbations", 2010). Conjugate gradients solve for volume and
poses together; the volume is preconditioned by the ramp, the poses by their own 6x6. Every draw gives one error to
each view, and the RMS over views and draws is the bound.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy import fft

from splatcore import _native
from splatcore.document import Document
from splatcore.gauge import settle
from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.grid import VolumeGrid
from splatcore.machine import threads_allowed
from splatcore.scan import read_header
from splatcore.scangeometry import read_frames
from splatcore.simulate import project
from splatcore.splats import Floats, grid_array

_STEP = 0.25  # voxels at the volume's edge, of the central differences
_WEAK = 1e-3  # of the smoothness: precision of a voxel's own value, so that no direction is left open
_TOLERANCE, _MOST = 1e-3, 200  # of conjugate gradients


def known_fisher(volume: Floats, grid: VolumeGrid, frames: Frames, noise: Floats, threads: int) -> Array:
    """Fisher information of every view's pose, the volume known. noise [views, rows, cols]: standard deviations.
    [views, 6, 6] rad, mm"""
    total = np.empty((len(frames), 6, 6))
    for k in range(len(frames)):
        d = derivative_images(volume, grid, frames[k : k + 1], threads)[0].astype(np.float64)
        total[k] = (d / noise[k].ravel().astype(np.float64) ** 2) @ d.T
    return total


def derivative_images(volume: Floats, grid: VolumeGrid, frames: Frames, threads: int) -> Floats:
    """Central differences of Joseph's projector along omega and tau. [views, 6, pixels]"""
    half, step = float(grid.half_extent_mm().max()), _STEP * min(grid.voxel_mm)
    out = np.empty((len(frames), 6, frames.rows * frames.cols), np.float32)
    for j, size in enumerate([step / half] * 3 + [step] * 3):
        vector = np.zeros((len(frames), 6))
        vector[:, j] = size
        ahead, behind = (
            project(volume, grid, RigidMotions.exp(s * vector[:, :3], s * vector[:, 3:]).correct(frames), threads)
            for s in (1.0, -1.0)
        )
        out[:, j] = ((ahead - behind) / np.float32(2 * size)).reshape(len(frames), -1)
    return out


def r2_noise(line_integrals: Floats, i0: float = 1e4, sigma_counts: float = 10.0) -> Floats:
    """Standard deviation of `simulate.add_noise`'s "r2", to first order: m sqrt(n + sigma^2) / n, n = i0 e^(-p/m)."""
    peak = float(line_integrals.max())
    counts = i0 * np.exp(-line_integrals / peak)
    return (peak * np.sqrt(counts + sigma_counts**2) / counts).astype(np.float32)


@dataclass(frozen=True)
class Unknowns:
    """A change of everything unknown: the volume, and poses in units of their known-volume deviation."""

    volume: Floats  # [z, y, x]
    poses: Array  # [views, 6]

    def dot(self, other: Unknowns) -> float:
        return float(np.sum(self.volume * other.volume, dtype=np.float64) + np.sum(self.poses * other.poses))

    def plus(self, scale: float, other: Unknowns) -> Unknowns:
        return Unknowns(self.volume + np.float32(scale) * other.volume, self.poses + scale * other.poses)


class JointProblem:
    """Volume and poses of one noisy scan, linearised at the truth."""

    def __init__(
        self, volume: Floats, grid: VolumeGrid, frames: Frames, noise: Floats, prior: float, threads: int
    ) -> None:
        self.frames, self._grid, self._threads = frames, grid, threads
        self._noise = noise.reshape(len(frames), -1)
        self._weight = 1 / self._noise**2
        derivatives = derivative_images(volume, grid, frames, threads)
        fisher = np.stack(
            [
                (d * w) @ d.T
                for d, w in zip(derivatives.astype(np.float64), self._weight.astype(np.float64), strict=True)
            ]
        )
        self.known = np.linalg.inv(fisher)  # covariance [views, 6, 6]
        self._unit = np.linalg.cholesky(self.known)
        self._derivatives = np.einsum("kip,kij->kjp", derivatives, self._unit.astype(np.float32))
        ny, nx = volume.shape[1:]
        y, x = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (ny, nx))
        self._support = np.broadcast_to(y[:, None] ** 2 + x**2 < 1, volume.shape).astype(np.float32)
        squares = np.concatenate([(d**2)[_pairs(self._support, a) > 0] for a, d in enumerate(_differences(volume))])
        self._smooth = prior / float(squares.mean())

    def draw(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """One posterior draw of the poses' errors, the gauge settled, and what the same noise does to them where the
        volume is known. Both [views, 6] rad, mm."""
        data = rng.standard_normal(self._weight.shape).astype(np.float32) / self._noise
        own = np.einsum("kjp,kp->kj", self._derivatives, data, dtype=np.float64)
        shape = self._support.shape
        pulls = [rng.standard_normal(d.shape).astype(np.float32) for d in _differences(self._support)]
        right = self._back(data) + np.float32(np.sqrt(self._smooth)) * _differences_adjoint(pulls, shape)
        right += np.float32(np.sqrt(_WEAK * self._smooth)) * rng.standard_normal(shape).astype(np.float32)
        poses = self._solve(Unknowns(self._support * right, own)).poses
        return self._settled(self._in_units(poses)), self._in_units(own)

    def _in_units(self, poses: Array) -> Array:
        return np.einsum("kij,kj->ki", self._unit, poses)

    def _settled(self, errors: Array) -> Array:
        small = 1e-3  # where settling is linear
        motions = RigidMotions.exp(small * errors[:, :3], small * errors[:, 3:])
        return np.concatenate(settle(self.frames, motions)[1].vectors(), axis=1) / small

    def _forward(self, volume: Floats) -> Floats:
        return project(np.ascontiguousarray(volume), self._grid, self.frames, self._threads).reshape(self._noise.shape)

    def _back(self, images: Floats) -> Floats:
        out = np.zeros(self._support.shape, np.float32)
        cone, box = self.frames.beam == "cone", grid_array(self._grid)
        shaped = np.ascontiguousarray(images, np.float32).reshape(-1, self.frames.rows, self.frames.cols)
        for frame, image in zip(self.frames.packed(), shaped, strict=True):
            _native.project_volume_adjoint(frame, cone, box, image, out, self._threads)
        return out

    def normal(self, change: Unknowns) -> Unknowns:
        """The joint Fisher matrix, prior included, times a change."""
        volume = change.volume * self._support
        images = self._forward(volume) + np.einsum("kjp,kj->kp", self._derivatives, change.poses.astype(np.float32))
        images *= self._weight
        pull = _differences_adjoint(_differences(volume), volume.shape) + np.float32(_WEAK) * volume
        return Unknowns(
            self._support * (self._back(images) + np.float32(self._smooth) * pull),
            np.einsum("kjp,kp->kj", self._derivatives, images, dtype=np.float64),
        )

    @cached_property
    def _ramp(self) -> Floats:
        """Inverse of the normal equations of the volume in the middle of the object, where views cross like spokes:
        K w d^4 / (pixel area) / (pi |k|) in cycles per voxel, plus the prior's spectrum."""
        nz, ny, nx = self._support.shape
        kz, ky, kx = np.meshgrid(fft.fftfreq(nz), fft.fftfreq(ny), fft.rfftfreq(nx), indexing="ij")
        voxel = min(self._grid.voxel_mm)
        sides = np.linalg.norm(self.frames.u, axis=1) * np.linalg.norm(self.frames.v, axis=1)
        pixel = float(np.median(sides * self.frames.isocentre_depth() ** 2))
        spokes = len(self.frames) * float(self._weight.mean()) * voxel**4 / pixel
        spokes = spokes / (np.pi * np.sqrt(kx**2 + ky**2 + (0.5 / nx) ** 2))
        spokes *= (np.sinc(kx) * np.sinc(ky) * np.sinc(kz)) ** 2
        prior = self._smooth * ((2 * np.pi) ** 2 * (kx**2 + ky**2 + kz**2) + _WEAK)
        return (1 / (spokes + prior)).astype(np.float32)

    def _precondition(self, change: Unknowns) -> Unknowns:
        spectrum = fft.rfftn(change.volume, workers=self._threads) * self._ramp
        volume = fft.irfftn(spectrum, change.volume.shape, workers=self._threads)
        return Unknowns(self._support * volume.astype(np.float32), change.poses)

    def _solve(self, right: Unknowns) -> Unknowns:
        found = Unknowns(np.zeros_like(right.volume), np.zeros_like(right.poses))
        rest, towards = right, self._precondition(right)
        size = first = rest.dot(towards)
        for _ in range(_MOST):
            image = self.normal(towards)
            step = size / towards.dot(image)
            found, rest = found.plus(step, towards), rest.plus(-step, image)
            improved = self._precondition(rest)
            before, size = size, rest.dot(improved)
            if size < _TOLERANCE**2 * first:
                return found
            towards = improved.plus(size / before, towards)
        raise RuntimeError(f"conjugate gradients: {np.sqrt(size / first):.1e} of the start is left after {_MOST} steps")


def _differences(volume: Floats) -> list[Floats]:
    return [np.diff(volume, axis=axis) for axis in range(3)]


def _differences_adjoint(differences: list[Floats], shape: tuple[int, ...]) -> Floats:
    out = np.zeros(shape, np.float32)
    for axis, d in enumerate(differences):
        along, part = np.moveaxis(out, axis, 0), np.moveaxis(d, axis, 0)
        along[1:] += part
        along[:-1] -= part
    return out


def _pairs(support: Floats, axis: int) -> Floats:
    """1 where both neighbours along an axis lie inside."""
    moved = np.moveaxis(support, axis, 0)
    return np.moveaxis(moved[1:] * moved[:-1], 0, axis)


@dataclass(frozen=True)
class Truth:
    """A simulated scan's truth."""

    name: str
    volume: Floats  # [z, y, x] 1/mm
    grid: VolumeGrid
    frames: Frames
    noise: NDArray[np.float32]  # [views, rows, cols]

    def reduced(self, edge: int, threads: int) -> Truth:
        """The same object with `edge` voxels a side, pixels and views fewer in proportion, noise per pixel alike."""
        factor = self.volume.shape[0] // edge
        if factor <= 1:
            return self
        n = self.volume.shape[0] // factor
        cut = self.volume[: n * factor, : n * factor, : n * factor]
        volume = np.ascontiguousarray(cut.reshape(n, factor, n, factor, n, factor).mean(axis=(1, 3, 5)))
        voxel = self.grid.voxel_mm
        grid = VolumeGrid((n,) * 3, (voxel[0] * factor, voxel[1] * factor, voxel[2] * factor), self.grid.center_mm)
        frames = self.frames.binned(factor)[::factor]
        return Truth(self.name, volume, grid, frames, r2_noise(project(volume, grid, frames, threads)))


def read_truth(folder: Path, threads: int) -> Truth:
    """The truth that a scan folder carries. Raises SystemExit where it carries none."""
    header = read_header(folder)
    if header.simulation is None or header.volume is None:
        raise SystemExit(f"{folder}: carries no truth; give a scan that `splatct simulate` wrote")
    doc, detector = Document(), (header.frames.rows, header.frames.cols)
    frames = read_frames(header.simulation["frames"], "/simulation/frames", header.frames.beam, detector, doc)
    if frames is None:
        raise SystemExit(f"{folder}: {doc.problems[0]}")
    volume = np.ascontiguousarray(tifffile.imread(folder / header.simulation["volume_file"]), np.float32)
    noise = r2_noise(project(volume, header.volume, frames, threads))
    return Truth(header.name, volume, header.volume, frames, noise)


def bound(
    scan: Path | Truth, *, edge: int = 32, samples: int = 3, prior: float = 1.0, seed: int = 0,
    threads: int | None = None,
) -> dict[str, Any]:  # fmt: skip
    """The bounds of a scan folder or of a truth. Degrees and voxels, RMS over views of the three components' norm;
    `ratio_error` is one standard error of the draws."""
    threads = threads or threads_allowed()
    truth = scan if isinstance(scan, Truth) else read_truth(Path(scan), threads)
    voxel = min(truth.grid.voxel_mm)
    known = np.linalg.inv(known_fisher(truth.volume, truth.grid, truth.frames, truth.noise, threads))
    traces = np.einsum("kii->ki", known).reshape(-1, 2, 3).sum(axis=2).mean(axis=0)
    rot, trans = float(np.rad2deg(np.sqrt(traces[0]))), float(np.sqrt(traces[1])) / voxel
    small = truth.reduced(edge, threads)
    problem = JointProblem(small.volume, small.grid, small.frames, small.noise, prior, threads)
    rng = np.random.default_rng(seed)
    draws = [problem.draw(rng) for _ in range(samples)]
    alone = np.einsum("kii->ki", problem.known).mean(axis=0)
    # The same noise with the volume known is a control: its mean square is known, and moves with the draw's.
    joint, control = (np.stack([d[i] for d in draws]) ** 2 / alone for i in (0, 1))
    ratios, errors = [], []
    for part in (slice(0, 3), slice(3, 6)):
        share = alone[part] / alone[part].sum()
        per_view = (joint[..., part] @ share).ravel()
        other = (control[..., part] @ share).ravel()
        slope = float(np.cov(per_view, other)[0, 1] / max(np.var(other, ddof=1), 1e-30))
        adjusted = per_view - slope * (other - 1)
        ratio = float(np.sqrt(max(adjusted.mean(), 0.0)))
        ratios.append(ratio)
        errors.append(float(adjusted.std(ddof=1) / np.sqrt(len(adjusted)) / (2 * max(ratio, 1e-30))))
    return {
        "scan": truth.name, "views": len(truth.frames), "known_rot_deg": rot, "known_trans_vox": trans,
        "ratio_rot": ratios[0], "ratio_trans": ratios[1], "ratio_error_rot": errors[0], "ratio_error_trans": errors[1],
        "joint_rot_deg": rot * ratios[0], "joint_trans_vox": trans * ratios[1], "edge": small.volume.shape[0],
        "reduced_views": len(small.frames), "samples": samples, "prior": prior,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="+", type=Path)
    parser.add_argument("--edge", type=int, default=32, help="voxels a side of the reduced problem")
    parser.add_argument("--samples", type=int, default=3, help="draws from the posterior")
    parser.add_argument("--prior", type=float, nargs="+", default=[1.0], help="precision of the volume's prior")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path, help="also write the bounds to this file")
    args = parser.parse_args()
    print(
        "| scan | prior | known rot (deg) | known trans (voxel) | ratio rot | ratio trans | joint rot | joint trans |"
    )
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for folder in args.scans:
        for prior in args.prior:
            row = bound(folder, edge=args.edge, samples=args.samples, prior=prior, threads=args.threads)
            rows.append(row)
            print(
                "| {scan} | {prior:g} | {known_rot_deg:.4f} | {known_trans_vox:.4f} | {ratio_rot:.2f} ± "
                "{ratio_error_rot:.2f} | {ratio_trans:.2f} ± {ratio_error_trans:.2f} | {joint_rot_deg:.4f} | "
                "{joint_trans_vox:.4f} |".format(**row),
                flush=True,
            )
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
