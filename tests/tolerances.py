"""What the kernels may differ by, each entry beside the worst that was observed.

Values are relative to the largest pixel or voxel. Gradients are relative to the row of the splat itself, or to a
hundredth of the largest row where that is more: a row that cancels has no relative accuracy, but one that is missing
shows. The observations are worst over scenes, beams and the avx512, avx2 and plain builds; entries are about
twice that. Needles (40 to 1) lose what the condition of their footprint takes.
"""

from __future__ import annotations

import torch
from torch import Tensor

# what, type: usual scenes, needles
_TABLE: dict[tuple[str, str], tuple[float, float]] = {
    ("value", "float32"): (6e-6, 5e-5),  # 3.1e-6, 2.2e-5
    ("means", "float32"): (7e-5, 9e-4),  # 3.2e-5, 5.0e-4
    ("scales", "float32"): (6e-5, 9e-4),  # 2.5e-5, 4.4e-4
    ("quats", "float32"): (8e-5, 1e-3),  # 3.9e-5, 7.0e-4
    ("density", "float32"): (1.6e-4, 9e-4),  # 7.6e-5, 5.2e-4
    ("motion", "float32"): (2e-5, 1e-4),  # 1.0e-5, 5.1e-5
    ("value", "float64"): (3e-14, 1.2e-13),  # 1.4e-14, 5.9e-14
    ("means", "float64"): (1.6e-13, 1.4e-12),  # 7.8e-14, 7.0e-13
    ("scales", "float64"): (1.6e-13, 1.8e-12),  # 8.2e-14, 8.7e-13
    ("quats", "float64"): (1.6e-13, 4e-11),  # 8.2e-14, 1.9e-11
    ("density", "float64"): (6e-13, 1.8e-12),  # 3.1e-13, 9.0e-13
    ("motion", "float64"): (4e-14, 7e-13),  # 1.6e-14, 3.3e-13
}

# |<Ax, y> - <x, A'y>| / (|Ax| |y|) for operators that are linear
ADJOINT: dict[str, float] = {
    "float32": 1e-6,
    "float64": 1e-15,
}


def name_of(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def tolerance(what: str, dtype: torch.dtype, scene: str) -> float:
    return _TABLE[what, name_of(dtype)][scene == "needles"]


def value_error(actual: Tensor, expected: Tensor) -> float:
    return float((actual.double() - expected).abs().max() / expected.abs().max())


def gradient_error(actual: Tensor, expected: Tensor) -> float:
    """The worst row of a gradient [n], [n, 3] or [n, 4]; a motion's [6] is one row."""
    shape = (1, -1) if expected.shape == (6,) else (len(expected), -1)
    a, e = actual.double().reshape(shape), expected.reshape(shape)  # [n, k]
    size = e.norm(dim=1)  # [n]
    return float(((a - e).norm(dim=1) / size.clamp(min=0.01 * float(size.max()))).max())
