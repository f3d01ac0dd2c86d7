"""Scans of a known volume with a badly calibrated scanner: what `splatct simulate` writes.

The perturbation is the paper's: every view's object moves by a rigid motion of its own, rotation vector and
translation drawn from normal distributions per axis. The noise is R2-Gaussian's (TIGRE's CTnoise after division
by the largest line integral) or physical. One world unit of the literature is 100 mm here: the object's cube is 200 mm
wide, source to axis 500 mm, source to detector 700 mm, detector 400 mm, and a voxel value of 1 is 0.01 /mm.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tifffile

from splatcore import _native
from splatcore.errors import OptionsError, Problem, ResultError, ScanError
from splatcore.geometry import Array, Frames, RigidMotions, circular, rotation_from_vector
from splatcore.grid import VolumeGrid
from splatcore.splats import Floats, grid_array

_WIDTH_MM, _DSO_MM, _DSD_MM, _DETECTOR_MM, _UNIT = 200.0, 500.0, 700.0, 400.0, 0.01

# What can be simulated, lowest and highest.
_RANGES = {
    "views": (1, 100_000), "det": (1, 32_768), "arc_deg": (1e-3, 36_000.0), "sigma_rot": (0.0, 10.0),
    "sigma_trans": (0.0, 1e4), "i0": (1.0, 1e15), "sigma_counts": (0.0, 1e15), "seed": (0, 2**63 - 1),
    "offset_px": (-1e5, 1e5), "roll_deg": (-360.0, 360.0), "tilt_deg": (-89.0, 89.0), "yaw_deg": (-89.0, 89.0),
    "axis_pitch_deg": (-89.0, 89.0), "drift_rot_deg": (0.0, 90.0), "drift_trans_vox": (0.0, 1e4),
}  # fmt: skip
_DRIFT_WAVES = 3  # half waves over the scan

Noise = Literal["none", "r2", "physical"]
Store = Literal["float32", "uint16"]
DriftAxes = Literal["camera", "turntable"]


@dataclass(frozen=True)
class Simulation:
    """What to simulate. Static errors are what scan.json does not tell the reconstruction."""

    views: int = 75
    det: int | None = None  # detector rows = columns; default twice the volume's edge
    arc_deg: float = 360.0
    sigma_rot: float = 0.0  # rad per axis
    sigma_trans: float = 0.0  # voxels per axis
    noise: Noise = "r2"
    i0: float = 1e4
    sigma_counts: float = 10.0  # electronic noise, counts
    seed: int = 0
    offset_px: tuple[float, float] = (0.0, 0.0)  # u, v
    roll_deg: float = 0.0
    tilt_deg: float = 0.0  # of the detector about u
    yaw_deg: float = 0.0  # of the detector about v
    axis_pitch_deg: float = 0.0  # the rotation axis leans along the beam
    reverse: bool = False
    flip_u: bool = False
    flip_v: bool = False
    store: Store = "float32"
    drift_rot_deg: float = 0.0  # smooth motion over the scan, RMS of its angle
    drift_trans_vox: float = 0.0  # and of its translation
    drift_axes: DriftAxes = "camera"  # a part of the scanner drifts, or the object on its turntable

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if number is not None and not low <= number <= high:  # true for nan
                    raise OptionsError(f"{name}: got {number:g}, expected {low:g} to {high:g}")


def draw_motions(views: int, sigma_rot: float, sigma_trans_mm: float, rng: np.random.Generator) -> RigidMotions:
    """The paper's perturbation: independent normal rotation vectors (rad) and translations (mm), per axis."""
    return RigidMotions.exp(rng.normal(0, sigma_rot, (views, 3)), rng.normal(0, sigma_trans_mm, (views, 3)))


def draw_drift(nominal: Frames, what: Simulation, voxel_mm: float, rng: np.random.Generator) -> RigidMotions:
    """A smooth motion over the scan: every component a random sum of the first half waves, the n-th as large as 1/n.
    Each has mean zero (a constant in camera axes is a static error), the whole the stated root mean square."""
    views = len(nominal)
    phase = np.pi * (np.arange(views) + 0.5) / views
    waves = np.stack([np.cos(n * phase) / n for n in range(1, _DRIFT_WAVES + 1)], axis=1)
    curve = waves @ rng.normal(size=(_DRIFT_WAVES, 6))
    parts = []
    for part, size in ((curve[:, :3], np.deg2rad(what.drift_rot_deg)), (curve[:, 3:], what.drift_trans_vox * voxel_mm)):
        scaled = part * size / np.sqrt((part**2).sum(axis=1).mean())
        parts.append(np.einsum("vji,vj->vi", nominal.axes(), scaled) if what.drift_axes == "camera" else scaled)
    return RigidMotions.exp(*parts)


def add_noise(line_integrals: Floats, noise: Noise, i0: float, sigma_counts: float, rng: np.random.Generator) -> Floats:
    """R2-Gaussian's noise, -log((Poisson(i0 e^(-p/m)) + N(0, sigma)) / i0) m with m = max p, negatives to zero;
    "physical" is the same with m = 1. Counts below one half are taken as one half."""
    peak = float(line_integrals.max()) if noise == "r2" else 1.0
    if noise == "none" or peak <= 0:
        return line_integrals
    counts = rng.poisson(i0 * np.exp(-line_integrals.astype(np.float64) / peak)) + rng.normal(
        0.0, sigma_counts, line_integrals.shape
    )
    noisy = -np.log(np.maximum(counts, 0.5) / i0) * peak
    return np.maximum(noisy, 0.0).astype(np.float32)


def true_frames(nominal: Frames, what: Simulation, voxel_mm: float, rng: np.random.Generator) -> Frames:
    """Where source and detector really were: moved views on a scanner with static errors."""
    motions = draw_motions(what.views, what.sigma_rot, what.sigma_trans * voxel_mm, rng)
    if what.drift_rot_deg or what.drift_trans_vox:
        motions = draw_drift(nominal, what, voxel_mm, np.random.default_rng([what.seed, 2])) @ motions
    lean = RigidMotions(_turn(nominal.axes()[:, 0], what.axis_pitch_deg), np.zeros((what.views, 3)))
    off = nominal.shifted_detector(*what.offset_px)
    axes = off.axes()
    turn = _turn(axes[:, 2], what.roll_deg) @ _turn(axes[:, 0], what.tilt_deg) @ _turn(axes[:, 1], what.yaw_deg)
    mounted = replace(off, u=np.einsum("vij,vj->vi", turn, off.u), v=np.einsum("vij,vj->vi", turn, off.v))
    return (lean @ motions).correct(mounted)


def _turn(axis: Array, degrees: float) -> Array:
    return rotation_from_vector(axis * np.deg2rad(degrees))


def project(volume: Floats, grid: VolumeGrid, frames: Frames, threads: int) -> Floats:
    """Line integrals of a voxel volume [z, y, x] 1/mm along the rays of all pixels. [views, rows, cols]"""
    images = np.empty((len(frames), frames.rows, frames.cols), np.float32)
    for k, frame in enumerate(frames.packed()):
        _native.project_volume(frame, frames.beam == "cone", grid_array(grid), volume, images[k], threads)
    return images


def simulate(
    volume: Floats, out: Path | str, what: Simulation, threads: int, name: str = "simulated"
) -> dict[str, Any]:
    """Write a scan folder with its truth. volume [z, y, x]: a cube, 1 is 0.01 /mm. Returns scan.json."""
    if volume.ndim != 3 or len(set(volume.shape)) != 1 or not np.isfinite(volume).all():
        raise ScanError(
            [Problem("volume", f"got an array of shape {volume.shape}", "a finite cube [z, y, x] is expected")]
        )
    edge = volume.shape[0]
    pixels, voxel = what.det or 2 * edge, _WIDTH_MM / edge
    grid = VolumeGrid((edge,) * 3, (voxel,) * 3)
    pitch = _DETECTOR_MM / pixels
    angles = np.arange(what.views) * what.arc_deg / what.views
    signed = -angles if what.reverse else angles
    scanner = circular("cone", signed, _DSO_MM, _DSD_MM, pixels, pixels, (pitch, pitch))
    true = true_frames(scanner, what, voxel, np.random.default_rng(what.seed))
    attenuation = np.ascontiguousarray(volume * np.float32(_UNIT), np.float32)
    clean = project(attenuation, grid, true, threads)
    images = add_noise(clean, what.noise, what.i0, what.sigma_counts, np.random.default_rng([what.seed, 1]))
    if what.flip_u:
        images, true = images[:, :, ::-1], replace(true, u=-true.u)
    if what.flip_v:
        images, true = images[:, ::-1, :], replace(true, v=-true.v)
    document: dict[str, Any] = {
        "format": "splatct-scan/1",
        "name": name,
        "projections": {"files": ["projections.tif"], "kind": "line_integrals", "scale": 1.0},
        "geometry": {
            "beam": "cone",
            "dso_mm": _DSO_MM,
            "dsd_mm": _DSD_MM,
            "detector": {"rows": pixels, "cols": pixels, "pixel_mm": [pitch, pitch], "offset_mm": [0.0, 0.0]},
            "angles_deg": angles.tolist(),
        },
        "volume": {"shape": [edge] * 3, "voxel_mm": [voxel] * 3},
        "simulation": {
            "volume_file": "truth.tif",
            "attenuation_unit": _UNIT,
            "frames": true.to_json(),
            "options": asdict(what),
        },
    }
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        scale = _write_images(out / "projections.tif", np.ascontiguousarray(images), what.store)
        document["projections"]["scale"] = scale
        tifffile.imwrite(out / "truth.tif", attenuation, photometric="minisblack", compression="zlib", predictor=False)
        (out / "scan.json").write_text(json.dumps(document), encoding="utf-8")
    except OSError as error:  # numpy says of a full disk how many bytes it wrote, and neither why nor where
        raise ResultError(f"{out} cannot be written to: {error.strerror or error}; is the disk full?") from error
    return document


def _write_images(path: Path, images: Floats, store: Store) -> float:
    """Write the stack; returns the scale that turns stored pixels into line integrals. uint16 keeps 1/4000 of the
    largest value, a quarter of R2 noise's standard deviation and less, and compresses well."""
    if store == "float32":
        tifffile.imwrite(path, images, photometric="minisblack", bigtiff=True)
        return 1.0
    scale = float(images.max()) / 4000 or 1.0
    stored = np.round(images / scale).astype(np.uint16)
    tifffile.imwrite(path, stored, photometric="minisblack", compression="zlib", predictor=False)
    return scale


def load_volume(path: Path) -> Floats:
    """A cube from .npz (key `volume`, or its only array), .npy or .tif; 8-bit data are divided by 255."""
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as arrays:
                name = "volume" if "volume" in arrays.files else arrays.files[0]
                volume = arrays[name]
        elif path.suffix == ".npy":
            volume = np.load(path, allow_pickle=False)
        else:
            volume = tifffile.imread(path, is_ome=False)
    except (OSError, ValueError, IndexError, tifffile.TiffFileError) as error:
        raise ScanError(
            [Problem(str(path), f"cannot be read as a volume: {error}", "give a .npz, .npy or .tif file")]
        ) from error
    scaled = volume / np.float32(255) if volume.dtype == np.uint8 else volume
    return np.ascontiguousarray(scaled, np.float32)
