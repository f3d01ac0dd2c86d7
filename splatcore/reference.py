"""The core's twin in plain float64 torch: slow, obvious, differentiable by autograd. The oracle of the tests.

Equations are those of R2-Gaussian and of Choi et al. (CVPR 2026, "the paper"): a Gaussian of density rho and
covariance C is sent to ray space by phi (eq. 2), whose derivative J at the mean gives C' = J C J' (eq. 4); its
integral along the third axis of ray space is a 2-D Gaussian of amplitude rho sqrt(2 pi |C'| / |S|) (eq. 5), S the
upper left 2x2 block of C'. Shapes: n splats, r rows, c columns. mm, 1/mm, unitless line integrals.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacrev, vmap

CUTOFF = 16.0  # squared standard deviations at which a Gaussian ends, on the detector and among voxels


def rotations(quats: Tensor) -> Tensor:
    """R(q / |q|): a Gaussian's own axes are its columns. [n, 4] w x y z -> [n, 3, 3]"""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)  # 4 x [n]
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # 9 x [n]  # fmt: skip
    return torch.stack(entries, dim=1).reshape(-1, 3, 3)  # [n, 3, 3]


def moved(means: Tensor, axes: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
    """The object after x -> Exp(omega) x + tau. motion [6]: omega rad, tau mm."""
    x, y, z = motion[:3]  # 3 x []
    zero = torch.zeros_like(x)  # []
    w = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)  # [3, 3]: the matrix of omega x (.)
    turn = term = torch.eye(3, dtype=w.dtype)  # [3, 3]
    for k in range(1, 40):  # exp(w), smooth at zero; to the last digits up to half a turn
        term = term @ w / k  # [3, 3]
        turn = turn + term  # [3, 3]
    return means @ turn.T + motion[3:], turn @ axes  # [n, 3], [n, 3, 3]


@dataclass(frozen=True)
class Footprints:
    """2-D Gaussians on the detector."""

    center: Tensor  # [n, 2] column, row
    covariance: Tensor  # [n, 2, 2] px^2
    amplitude: Tensor  # [n] line integral through the centre
    visible: Tensor  # [n] before the source as a whole, to 4 standard deviations

    def squared_distance(self, rows: int, cols: int) -> Tensor:
        """dx' S^-1 dx at every pixel. [n, r, c]"""
        row, column = torch.arange(rows, dtype=torch.float64), torch.arange(cols, dtype=torch.float64)  # [r], [c]
        pixels = torch.stack([column.expand(rows, cols), row[:, None].expand(rows, cols)], dim=-1)  # [r, c, 2]
        dx = pixels - self.center[:, None, None, :]  # [n, r, c, 2]
        return torch.einsum("nrci,nij,nrcj->nrc", dx, torch.linalg.inv(self.covariance), dx)  # [n, r, c]


def footprints(
    means: Tensor,  # [n, 3] mm
    scales: Tensor,  # [n, 3] mm
    quats: Tensor,  # [n, 4]
    density: Tensor,  # [n] 1/mm
    motion: Tensor,  # [6] rad, mm
    frame: Tensor,  # [4, 3] mm: source (parallel: ray direction), detector centre, u, v
    cone: bool,
    rows: int,
    cols: int,
) -> Footprints:
    """Project every Gaussian by the derivative of phi at its mean (eq. 2, 4, 5)."""
    first, center, u, v = frame  # 4 x [3]
    third = center - first if cone else first  # [3]
    to_pixels = torch.linalg.inv(torch.stack([u, v, third], dim=1))  # [3, 3]
    origin = first if cone else center  # [3]

    def phi(x: Tensor) -> Tensor:
        """Ray space (eq. 2): column and row from the detector's centre, and the length along the ray in mm."""
        q = to_pixels @ (x - origin)  # [3]
        if cone:
            return torch.stack([q[0] / q[2], q[1] / q[2], (x - origin).norm()])  # [3]
        return torch.stack([q[0], q[1], (x - origin) @ first / first.norm()])  # [3]

    means, axes = moved(means, rotations(quats), motion)  # [n, 3], [n, 3, 3]
    covariance = axes @ torch.diag_embed(scales**2) @ axes.mT  # [n, 3, 3] mm^2
    depth = (means - origin) @ to_pixels[2]  # [n]: share of the way from source to detector
    spread = torch.einsum("i,nij,j->n", to_pixels[2], covariance, to_pixels[2]).sqrt()  # [n]: its standard deviation
    visible = depth > 4 * spread if cone else torch.ones(len(means), dtype=torch.bool)  # [n]
    means = torch.where(visible[:, None], means, center)  # [n, 3]: a harmless place for the others
    jacobian = vmap(jacrev(phi))(means)  # [n, 3, 3] px/mm and mm/mm
    ray_space = jacobian @ covariance @ jacobian.mT  # [n, 3, 3]
    flat = ray_space[:, :2, :2]  # [n, 2, 2] px^2
    # |C'| = |J|^2 (s0 s1 s2)^2
    det = torch.linalg.det(jacobian).abs() * scales.prod(dim=1)  # [n]
    amplitude = density * (2 * torch.pi) ** 0.5 * det / torch.linalg.det(flat).sqrt()  # [n]
    middle = torch.tensor([(cols - 1) / 2, (rows - 1) / 2], dtype=torch.float64)  # [2]
    return Footprints(vmap(phi)(means)[:, :2] + middle, flat, amplitude, visible)


def render(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    density: Tensor,
    motion: Tensor,
    frame: Tensor,
    cone: bool,
    rows: int,
    cols: int,
) -> Tensor:
    """The image of all splats (eq. 5), each cut off at 4 standard deviations. Shapes as in `footprints`. [r, c]"""
    splats = footprints(means, scales, quats, density, motion, frame, cone, rows, cols)
    m = splats.squared_distance(rows, cols)  # [n, r, c]
    shown = (m < CUTOFF) & splats.visible[:, None, None]  # [n, r, c]
    values = splats.amplitude[:, None, None] * torch.exp(-m / 2)  # [n, r, c]
    return torch.where(shown, values, 0.0).sum(dim=0)  # [r, c]


def voxel_distance(means: Tensor, scales: Tensor, quats: Tensor, grid: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """(p - mean)' C^-1 (p - mean) at every voxel centre p. [n, z, y, x]

    grid [2, 3]: voxel size z, y, x and centre x, y, z, mm; shape (z, y, x)."""
    z, y, x = (
        (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * step + middle
        for count, step, middle in zip(shape, grid[0], grid[1].flip(0), strict=True)
    )  # [z], [y], [x] mm
    zz, yy, xx = torch.meshgrid(z, y, x, indexing="ij")  # 3 x [z, y, x]
    away = torch.stack([xx, yy, zz], dim=-1) - means[:, None, None, None, :]  # [n, z, y, x, 3]
    own = torch.einsum("nij,nzyxi->nzyxj", rotations(quats), away) / scales[:, None, None, None, :]  # [n, z, y, x, 3]
    return own.square().sum(dim=-1)  # [n, z, y, x]


def voxelize(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    density: Tensor,
    grid: Tensor,
    shape: tuple[int, int, int],
) -> Tensor:
    """The density at voxel centres, each Gaussian cut off at 4 standard deviations. [z, y, x] 1/mm"""
    m = voxel_distance(means, scales, quats, grid, shape)  # [n, z, y, x]
    return torch.where(m < CUTOFF, density[:, None, None, None] * torch.exp(-m / 2), 0.0).sum(dim=0)  # [z, y, x]


def line_integrals(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    density: Tensor,
    motion: Tensor,
    frame: Tensor,
    cone: bool,
    rows: int,
    cols: int,
) -> Tensor:
    """The exact integral of every whole Gaussian along the ray of every pixel, without the affine map of eq. 4.

    A Gaussian rho exp(-(x - m)' A (x - m) / 2) along o + t d, |d| = 1, is a 1-D Gaussian in t:
    rho sqrt(2 pi / d'Ad) exp(-[(o - m)'A(o - m) - (d'A(o - m))^2 / d'Ad] / 2). Shapes as in `footprints`. [n, r, c]
    """
    means, axes = moved(means, rotations(quats), motion)  # [n, 3], [n, 3, 3]
    precision = axes @ torch.diag_embed(scales**-2) @ axes.mT  # [n, 3, 3] 1/mm^2
    first, center, u, v = frame  # 4 x [3]
    row = torch.arange(rows, dtype=torch.float64) - (rows - 1) / 2  # [r]
    column = torch.arange(cols, dtype=torch.float64) - (cols - 1) / 2  # [c]
    pixel = center + column[None, :, None] * u + row[:, None, None] * v  # [r, c, 3] mm
    d = pixel - first if cone else first.expand_as(pixel)  # [r, c, 3]
    d = d / d.norm(dim=-1, keepdim=True)  # [r, c, 3]
    away = pixel - means[:, None, None, :]  # [n, r, c, 3]: o - m, o on the detector
    dd = torch.einsum("rci,nij,rcj->nrc", d, precision, d)  # [n, r, c]
    do = torch.einsum("rci,nij,nrcj->nrc", d, precision, away)  # [n, r, c]
    oo = torch.einsum("nrci,nij,nrcj->nrc", away, precision, away)  # [n, r, c]
    return density[:, None, None] * torch.sqrt(2 * torch.pi / dd) * torch.exp(-(oo - do * do / dd) / 2)  # [n, r, c]
