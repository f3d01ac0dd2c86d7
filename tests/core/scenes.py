"""Splats and views that are awkward on purpose: needles, edges, behind the source. All in float64 torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splatcore.geometry import Beam, Frames, RigidMotions, circular

ROWS, COLS = 37, 53  # neither fills whole bands of rows nor whole registers
NO_MOTION = torch.zeros(6, dtype=torch.float64)
MOTION = torch.tensor([0.21, -0.33, 0.48, 2.0, -3.0, 1.5], dtype=torch.float64)  # omega rad, tau mm


@dataclass(frozen=True)
class Cloud:
    """Splats as the core takes them."""

    means: Tensor  # [n, 3] mm
    scales: Tensor  # [n, 3] mm
    quats: Tensor  # [n, 4]
    density: Tensor  # [n] 1/mm

    def tensors(self) -> list[Tensor]:
        return [self.means, self.scales, self.quats, self.density]

    def to(self, dtype: torch.dtype) -> Cloud:
        return Cloud(*(t.to(dtype) for t in self.tensors()))

    def leaves(self) -> list[Tensor]:
        return [t.clone().requires_grad_() for t in self.tensors()]

    def numpy(self) -> list[np.ndarray]:
        return [t.numpy() for t in self.tensors()]

    def __getitem__(self, chosen: Tensor) -> Cloud:
        return Cloud(*(t[chosen] for t in self.tensors()))


def frames(beam: Beam, views: int = 5, rows: int = ROWS, cols: int = COLS) -> Frames:
    """A circular orbit, knocked askew. About 5 mm a pixel at the isocentre, so the field is 265 x 190 mm."""
    plain = circular(beam, np.arange(views) * 360 / views + 11, 500, 700, rows, cols, (7.0, 6.5), (12, -9))
    rng = np.random.default_rng(3)
    return RigidMotions.exp(rng.normal(0, 0.2, (views, 3)), rng.normal(0, 5, (views, 3))).correct(plain)


def frame(beam: Beam, view: int = 2) -> Tensor:
    """[4, 3] mm"""
    return torch.tensor(frames(beam).packed()[view])


def cloud(n: int = 40, seed: int = 0, sigma: float = 8.0, spread: float = 80.0) -> Cloud:
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng, dtype=torch.float64)

    means = (2 * uniform(n, 3) - 1) * spread * torch.tensor([1.0, 1.0, 0.7], dtype=torch.float64)
    return Cloud(means, sigma * torch.exp(0.4 * normal(n, 3)), 1.7 * normal(n, 4), 0.001 + 0.009 * uniform(n))


def needles() -> Cloud:
    """One long axis or one short one, 40 to 1: down to a fifth of a pixel across."""
    c = cloud(40, seed=1)
    scales = torch.ones(40, 3, dtype=torch.float64)
    scales[:20, 0], scales[20:, 1] = 40.0, 1.0
    scales[20:, [0, 2]] = 15.0
    return Cloud(c.means, scales, c.quats, c.density)


def edges(beam: Beam) -> Cloud:
    """Centres on and around the border of the detector, corners included; half of every splat is off it."""
    c = cloud(40, seed=2, sigma=10.0)
    view = frames(beam)[2:3]
    side = torch.linspace(0, 1, 11, dtype=torch.float64)[:-1].numpy()
    last_c, last_r = COLS - 1.0, ROWS - 1.0
    column = np.concatenate([side * last_c, 0 * side + last_c, (1 - side) * last_c, 0 * side])
    row = np.concatenate([0 * side, side * last_r, 0 * side + last_r, (1 - side) * last_r])
    column, row = column - (COLS - 1) / 2, row - (ROWS - 1) / 2
    point = view.detector_center + column[:, None] * view.u + row[:, None] * view.v
    share = np.linspace(0.5, 0.9, 40)[:, None]  # of the way to the detector
    means = view.source + share * (point - view.source) if beam == "cone" else point - 200 * share * view.source
    return Cloud(torch.tensor(means), c.scales, c.quats, c.density)


def behind(beam: Beam) -> Cloud:
    """A third behind the source, some in and about its plane, the others before it; parallel: far up the ray."""
    c = cloud(30, seed=4)
    view = frames(beam)[2:3]
    normal = np.cross(view.u[0], view.v[0])
    normal *= np.sign(normal @ (view.detector_center[0] - view.origin()[0] + (beam == "parallel") * view.source[0]))
    normal /= np.linalg.norm(normal)
    means = c.means.clone()
    means[:10] += torch.tensor(view.origin()[0] - 300 * normal)
    means[10:14] = torch.tensor(view.origin()[0] + 50 * view.u[0] / np.linalg.norm(view.u[0]))
    means[11:14] += torch.tensor([[5.0], [15.0], [-5.0]], dtype=torch.float64) * torch.tensor(normal)
    return Cloud(means, c.scales, c.quats, c.density)


SCENES: dict[str, Callable[[Beam], Cloud]] = {
    "cloud": lambda beam: cloud(),
    "needles": lambda beam: needles(),
    "edges": edges,
    "behind": behind,
}
