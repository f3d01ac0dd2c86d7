"""SplatCT's core: Gaussian splats through X-ray geometry. Its meaning is in csrc/api.hpp.

Arrays are C-contiguous, from numpy or torch (CPU, without gradient), never copied. `Real` arrays are float32 for
`Renderer32` and float64 for `Renderer64`; the functions take either, all of them alike. Double arrays are float64.
n splats: means [n, 3] mm, scales [n, 3] mm, quats [n, 4] w x y z, density [n] 1/mm. `v_x` is dL/dx, as large as x.
frame [4, 3]: source (parallel: ray direction), detector centre, u, v, mm. grid [2, 3]: voxel z, y, x and centre
x, y, z, mm. Every function gives the same bits for any number of threads.
"""

from typing import Any, TypeAlias

from numpy.typing import NDArray
from torch import Tensor

Real: TypeAlias = NDArray[Any] | Tensor
Double: TypeAlias = NDArray[Any] | Tensor

class _Renderer:
    """Draws splats onto one detector size, with the reverse of it; owns scratch memory. One call at a time."""

    def __init__(self, rows: int, cols: int, threads: int) -> None: ...
    @property
    def rows(self) -> int: ...
    @property
    def cols(self) -> int: ...
    def render(
        self,
        frame: Double,
        cone: bool,
        means: Real,
        scales: Real,
        quats: Real,
        density: Real,
        image: Real,  # [rows, cols], overwritten
    ) -> None: ...
    def render_vjp(
        self,
        frame: Double,
        cone: bool,
        means: Real,
        scales: Real,
        quats: Real,
        density: Real,
        v_image: Real,  # [rows, cols]
        v_means: Real,  # this and the following: overwritten
        v_scales: Real,
        v_quats: Real,
        v_density: Real,
        v_motion: Double,  # [6]: the object's motion x -> x + omega x x + tau; rad, mm
    ) -> None: ...
    def loss_vjp(
        self,
        frame: Double,
        cone: bool,
        means: Real,
        scales: Real,
        quats: Real,
        density: Real,
        target: Real,  # [rows, cols]
        mask: Real | None,  # [rows, cols]
        huber_delta: float,
        dssim: float,  # share of D-SSIM in the loss, 0 to 1
        data_range: float,
        v_means: Real,  # this and the following: overwritten
        v_scales: Real,
        v_quats: Real,
        v_density: Real,
        v_motion: Double | None = None,  # [6] as in render_vjp
    ) -> float: ...
    def motion_normal(
        self,
        frame: Double,
        cone: bool,
        means: Real,
        scales: Real,
        quats: Real,
        density: Real,
        target: Real,  # [rows, cols]
        mask: Real | None,  # [rows, cols]
        huber_delta: float,
        hessian: Double,  # [12, 12], overwritten: omega, tau, strain xx yy zz yz xz xy
        gradient: Double,  # [12], overwritten
    ) -> tuple[float, float, float, float]:
        """Returns sum w r^2, sum r^2, sum |r|, pixels."""

class Renderer32(_Renderer): ...
class Renderer64(_Renderer): ...

def voxelize(
    grid: Double,
    means: Real,
    scales: Real,
    quats: Real,
    density: Real,
    volume: Real,  # [nz, ny, nx], overwritten
    threads: int,
) -> None: ...
def voxelize_vjp(
    grid: Double,
    means: Real,
    scales: Real,
    quats: Real,
    density: Real,
    v_volume: Real,  # [nz, ny, nx]
    v_means: Real,  # this and the following: overwritten
    v_scales: Real,
    v_quats: Real,
    v_density: Real,
    threads: int,
) -> None: ...
def total_variation(
    volume: Real,  # [nz, ny, nx]
    gradient: Real,  # [nz, ny, nx], overwritten
    threads: int,
) -> float:
    """Returns the mean |difference| of neighbouring voxels along the three axes."""

def adam(
    means: Real,  # this and the following to `second`: updated
    log_scales: Real,
    quats: Real,
    raw_density: Real,
    scales: Real,
    density: Real,
    first: Real,  # [11 n] moments: means, scales, quats, density
    second: Real,  # [11 n]
    v_means: Real,
    v_scales: Real,
    v_quats: Real,
    v_density: Real,
    rate_mean: float,  # mm
    rate_scale: float,
    rate_quat: float,
    rate_density: float,
    scale_low: float,  # mm
    scale_high: float,  # mm
    density_unit: float,  # 1/mm
    step: int,  # from 1
    threads: int,
) -> None: ...
def project_volume(
    frame: Double,
    cone: bool,
    grid: Double,
    volume: Real,  # [nz, ny, nx] 1/mm
    image: Real,  # [rows, cols], overwritten
    threads: int,
) -> None: ...
def project_volume_adjoint(
    frame: Double,
    cone: bool,
    grid: Double,
    image: Real,  # [rows, cols]
    volume: Real,  # [nz, ny, nx], added to
    threads: int,
) -> None: ...
def backproject(
    frame: Double,
    cone: bool,
    grid: Double,
    image: Real,  # [rows, cols]
    weight: float,
    volume: Real,  # [nz, ny, nx], added to
    threads: int,
) -> None: ...
def choose_isa(name: str | None = None) -> str:
    """Use this instruction set from now on (renderers made before keep theirs); None: the best.

    Raises ValueError where this processor or build has no such."""

def peak_fma(rounds: int, threads: int) -> float:
    """Run independent float multiply-adds; returns how many were done."""
