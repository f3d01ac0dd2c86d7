"""Our scans in RTK's terms: geometry, projections, volumes (https://www.openrtk.org, `pip install itk-rtk`).

Runs in any Python that has numpy and itk-rtk; it imports nothing of splatcore, so that RTK (1.9 GB) may live in an
environment of its own. RTK turns its gantry about y. A cyclic change of axes takes our z there without mirroring
anything: RTK's (x, y, z) are our (y, z, x), and a volume [z, y, x] becomes [x, z, y].

RTK also wants (row direction) x (column direction) to point from the detector to the source. Where a frame's u x v
points the other way, its rows are counted backwards: v is negated and the images are flipped upside down.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from time import perf_counter
from typing import Any

import itk
import numpy as np
from itk import RTK
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

_IMAGE = itk.Image[itk.F, 3]
# Voxels around the volume while it is reconstructed: RTK's projector stops at the outermost voxel centres, its
# voxel-based back projector does not, and what only one of them sees grows without bound.
_MARGIN = 2
_SQUARE = 1e-6  # how far u and v may be from perpendicular, and pixels from equal


@dataclass(frozen=True)
class Views:
    """Cone-beam frames as plain arrays: source, detector_center, u, v [views, 3] mm, and the images' size."""

    source: Doubles
    detector_center: Doubles
    u: Doubles
    v: Doubles
    rows: int
    cols: int

    def upside_down(self) -> bool:
        """Whether u x v points away from the source, in all views alike."""
        facing = np.einsum("vi,vi->v", np.cross(self.u, self.v), self.source - self.detector_center) > 0
        if facing.any() != facing.all():
            raise ValueError("some views are mirrored and some are not: RTK takes one orientation per scan")
        return not facing.all()

    def pixel_mm(self) -> tuple[float, float]:
        """(along u, along v), the same in every view or RTK cannot describe the scan."""
        sizes = np.linalg.norm(np.stack([self.u, self.v]), axis=2)
        slant = np.abs(np.einsum("vi,vi->v", self.u, self.v)) / (sizes[0] * sizes[1])
        if slant.max() > _SQUARE or (np.ptp(sizes, axis=1) / sizes[:, 0]).max() > _SQUARE:
            raise ValueError("RTK needs rows square to columns and pixels of one size in all views")
        return float(sizes[0, 0]), float(sizes[1, 0])


@dataclass(frozen=True)
class Grid:
    """splatcore's VolumeGrid as plain numbers: shape and voxel_mm [z, y, x], center_mm (x, y, z)."""

    shape: tuple[int, int, int]
    voxel_mm: tuple[float, float, float]
    center_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def padded(self, voxels: int) -> Grid:
        """The grid with so many more voxels on every side."""
        deep, high, wide = (n + 2 * voxels for n in self.shape)
        return Grid((deep, high, wide), self.voxel_mm, self.center_mm)

    def cylinder(self) -> NDArray[np.bool_]:
        """The voxels inside the inscribed upright cylinder. [z, y, x]"""
        rows, cols = (np.abs(np.arange(n) - (n - 1) / 2) / (n / 2) for n in self.shape[1:])
        disc = rows[:, None] ** 2 + cols[None, :] ** 2 <= 1
        return np.broadcast_to(disc, self.shape)


def version() -> str:
    return f"itk-rtk {metadata.version('itk-rtk')}"


def warm_up() -> None:
    """Loads what `reconstruct` needs, which takes RTK ten seconds and more."""
    for name in ("FDK", "SART", "OSEM", "ConjugateGradient"):
        getattr(RTK, f"{name}ConeBeamReconstructionFilter")
    RTK.ThreeDCircularProjectionGeometry.New()


def set_threads(threads: int) -> None:
    itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(threads)
    itk.MultiThreaderBase.SetGlobalMaximumNumberOfThreads(threads)


def _image(values: Floats, spacing: tuple[float, ...], middle: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Any:
    """An itk image of an array [k, j, i], spacing and middle in (i, j, k)."""
    image = itk.image_from_array(np.ascontiguousarray(values, np.float32))
    image.SetSpacing(list(spacing))
    sizes = values.shape[::-1]
    image.SetOrigin([m - (n - 1) / 2 * step for n, step, m in zip(sizes, spacing, middle, strict=True)])
    return image


def volume_image(volume: Floats, grid: Grid, margin: int = 0) -> Any:
    """A volume [z, y, x] for RTK. `margin` voxels of zero around it make a projector that stops at the outermost
    voxel centres see the whole of the outermost voxels."""
    x, y, z = grid.center_mm
    dz, dy, dx = grid.voxel_mm
    return _image(np.pad(volume, margin).transpose(2, 0, 1), (dy, dz, dx), (y, z, x))


def volume_array(image: Any) -> Floats:
    """The inverse of `volume_image` without margin. [z, y, x]"""
    return np.ascontiguousarray(itk.array_from_image(image).transpose(1, 2, 0), np.float32)


def stack_image(images: Floats, views: Views) -> Any:
    """Projections [views, rows, cols] for RTK."""
    across, down = views.pixel_mm()
    image = _image(images[:, ::-1] if views.upside_down() else images, (across, down, 1.0))
    origin = image.GetOrigin()
    image.SetOrigin([origin[0], origin[1], 0.0])
    return image


def stack_array(image: Any, views: Views) -> Floats:
    """The inverse of `stack_image`. [views, rows, cols]"""
    images = itk.array_from_image(image)
    return np.ascontiguousarray(images[:, ::-1] if views.upside_down() else images, np.float32)


def geometry(views: Views) -> Any:
    """RTK's ThreeDCircularProjectionGeometry of the frames. Raises ValueError where RTK cannot describe them."""
    sign = -1.0 if views.upside_down() else 1.0
    views.pixel_mm()
    found = RTK.ThreeDCircularProjectionGeometry.New()
    point, vector = itk.Point[itk.D, 3], itk.Vector[itk.D, 3]

    def placed(kind: Any, xyz: Doubles) -> Any:
        result = kind()
        for axis, value in enumerate(np.roll(xyz, -1)):  # ours (y, z, x)
            result[axis] = float(value)
        return result

    for source, center, u, v in zip(views.source, views.detector_center, views.u, views.v, strict=True):
        row, column = u / np.linalg.norm(u), sign * v / np.linalg.norm(v)
        if not found.AddProjection(
            placed(point, source), placed(point, center), placed(vector, row), placed(vector, column)
        ):
            raise ValueError("RTK refused a view")
    return found


def write_geometry(views: Views, path: str) -> None:
    """RTK's geometry XML, as rtkfdk, rtksart and the rest read it with --geometry."""
    writer = RTK.ThreeDCircularProjectionGeometryXMLFileWriter.New()
    writer.SetFilename(path)
    places = geometry(views)  # the writer keeps a bare pointer
    writer.SetObject(places)
    writer.WriteFile()


def project(volume: Floats, grid: Grid, views: Views) -> Floats:
    """Line integrals by RTK's CPU Joseph projector. volume [z, y, x] 1/mm -> [views, rows, cols]"""
    joseph = RTK.JosephForwardProjectionImageFilter[_IMAGE, _IMAGE].New()
    empty = np.zeros((len(views.source), views.rows, views.cols), np.float32)
    joseph.SetInput(0, stack_image(empty, views))
    joseph.SetInput(1, volume_image(volume, grid, margin=1))
    joseph.SetGeometry(geometry(views))
    joseph.Update()
    return stack_array(joseph.GetOutput(), views)


def reconstruct(
    method: str, images: Floats, views: Views, grid: Grid, snapshots: list[int], **knobs: float
) -> Iterator[tuple[int, float, Floats]]:
    """(iterations, seconds so far, volume [z, y, x] 1/mm) after each of the ascending iteration counts `snapshots`.

    Methods: fdk (hann), sart (relaxation, subset), osem (subset), cg (tikhonov), tvcg (tv). Knobs count the
    attenuation in 1/mm. Positivity where the method has it; voxels outside the inscribed cylinder are zero.
    """
    start, mask, work = perf_counter(), grid.cylinder(), grid.padded(_MARGIN)
    stack, places = stack_image(images, views), geometry(views)
    inner = tuple(slice(_MARGIN, -_MARGIN) for _ in range(3))
    # OSEM multiplies: zero would stay zero.
    empty = np.full(work.shape, _mean_attenuation(images, grid) if method == "osem" else 0.0, np.float32)
    volume, done = empty, 0
    for count in snapshots:
        restart = method == "cg"  # a warm start would forget the conjugate directions
        first, steps = (empty, count) if restart else (volume, count - done)
        volume = volume_array(_run(method, volume_image(first, work), stack, places, views, work, steps, knobs))
        done = count
        yield count, perf_counter() - start, volume[inner] * mask


def _mean_attenuation(images: Floats, grid: Grid) -> float:
    """A uniform object's attenuation with about the projections' mean. 1/mm"""
    return float(images.max() / (grid.shape[2] * grid.voxel_mm[2])) / 2


def _run(
    method: str, first: Any, stack: Any, places: Any, views: Views, grid: Grid, steps: int, knobs: dict[str, float]
) -> Any:
    if method == "fdk":
        run = RTK.FDKConeBeamReconstructionFilter[_IMAGE].New()
        run.SetInput(0, first)
        run.SetInput(1, stack)
        run.GetRampFilter().SetTruncationCorrection(0.0)
        run.GetRampFilter().SetHannCutFrequency(knobs.get("hann", 0.0))
    elif method in ("sart", "osem"):
        kind = RTK.SARTConeBeamReconstructionFilter if method == "sart" else RTK.OSEMConeBeamReconstructionFilter
        run = kind[_IMAGE, _IMAGE].New()
        run.SetInput(0, first)
        run.SetInput(1, stack)
        run.SetNumberOfProjectionsPerSubset(int(knobs.get("subset", 5)))
        run.SetNumberOfIterations(steps)
        if method == "sart":
            run.SetLambda(knobs.get("relaxation", 0.3))
            run.SetEnforcePositivity(True)
            run.SetDisableDisplacedDetectorFilter(True)
    elif method == "tvcg":
        return _regularised(first, stack, places, views, grid, steps, knobs)
    elif method == "cg":
        run = RTK.ConjugateGradientConeBeamReconstructionFilter[_IMAGE].New()
        run.SetInputVolume(first)
        run.SetInputProjectionStack(stack)
        run.SetInputWeights(stack_image(np.ones((len(views.source), views.rows, views.cols), np.float32), views))
        run.SetSupportMask(volume_image(grid.cylinder().astype(np.float32), grid))
        run.SetCudaConjugateGradient(False)
        run.SetDisableDisplacedDetectorFilter(True)
        run.SetNumberOfIterations(steps)
        run.SetTikhonov(knobs.get("tikhonov", 0.0))
        run.SetGamma(knobs.get("laplacian", 0.0))
    else:
        raise ValueError(f"method: got {method!r}, expected fdk, sart, osem, cg or tvcg")
    if method != "fdk":
        kind = type(run)
        run.SetForwardProjectionFilter(kind.ForwardProjectionType_FP_JOSEPH)
        # The voxel-based back projection is not the projector's transpose; conjugate gradients need that it is.
        exact = kind.BackProjectionType_BP_JOSEPH
        run.SetBackProjectionFilter(exact if method == "cg" else kind.BackProjectionType_BP_VOXELBASED)
    run.SetGeometry(places)
    run.Update()
    return run.GetOutput()


def _regularised(
    first: Any, stack: Any, places: Any, views: Views, grid: Grid, rounds: int, knobs: dict[str, float]
) -> Any:
    """Rounds of conjugate gradients, positivity and total variation, which is RTK's regularised conjugate gradients.
    From its own parts: its filter of that name asks for a region of the projections as large as the volume, and
    refuses scans with fewer views than the volume has slices (itk-rtk 2.7)."""
    volume = first
    for _ in range(rounds):
        volume = _run("cg", volume, stack, places, views, grid, int(knobs.get("inner", 4)), knobs)
        positive = np.maximum(volume_array(volume), 0)
        smooth = RTK.TotalVariationDenoisingBPDQImageFilter[_IMAGE, itk.Image[itk.CovariantVector[itk.F, 3], 3]].New()
        smooth.SetInput(volume_image(positive, grid))
        smooth.SetGamma(knobs.get("tv", 5e-5))
        smooth.SetNumberOfIterations(10)
        smooth.Update()
        volume = smooth.GetOutput()
    return volume
