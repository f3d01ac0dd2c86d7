"""The result folder: volume.tif, splats.npz, poses.json, report.json, report.html and, last of all,
manifest.json, whose presence says that the others are whole.

Every file is written under a temporary name and then renamed. Nothing is deleted that this module does
not itself write.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import platform
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import tifffile
from numpy.typing import NDArray

import splatcore
from splatcore.document import Document
from splatcore.durable import renamed
from splatcore.errors import ResultError, ScanError
from splatcore.geometry import Frames
from splatcore.grid import VolumeGrid
from splatcore.keeper import FILE
from splatcore.posefile import poses_document, read_poses
from splatcore.reconstruction import Reconstruction
from splatcore.splats import Splats
from splatcore.tiff import read_stack

__all__ = ["Results", "prepare_folder", "read_results", "write_results"]

FORMAT = "splatct-result/1"
_NEXT = 1 << 16  # bytes; more than what is left of a block
_MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Results:
    """A result folder, read back."""

    folder: Path
    volume: NDArray[np.float32]  # [z, y, x] 1/mm
    grid: VolumeGrid
    frames: Frames  # corrected
    poses: dict[str, Any]  # poses.json
    splats: Splats
    report: dict[str, Any]
    manifest: dict[str, Any]


def prepare_folder(folder: Path | str, overwrite: bool = False) -> Path:
    """Makes the folder, or makes sure it may be written to. Call before the work, not after it.

    Raises ResultError where it holds anything and `overwrite` is false, and where it is a scan. What an interrupted
    run left, a state and no manifest, may be gone on with."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ResultError(f"{folder} is a file, expected a folder; choose another name")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "scan.json").exists():
            raise ResultError(f"{folder} is a scan folder; write the results to a folder of their own")
        if not overwrite and not _interrupted(folder) and next(folder.iterdir(), None) is not None:
            raise ResultError(f"{folder} is not empty; choose another folder, or overwrite it with --overwrite")
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ResultError(f"{folder} cannot be written to: {error.strerror or error}") from error
    return folder


def _interrupted(folder: Path) -> bool:
    """Whether the folder holds the state of a run without results, and nothing that such a run does not write."""
    ours = {FILE, "volume.tif", "splats.npz", "poses.json", "report.json", "report.html"}
    found = {path.name.removeprefix(".").removesuffix(".part") for path in folder.iterdir()}
    return FILE in found and found <= ours


def write_results(reconstruction: Reconstruction, folder: Path | str, overwrite: bool = False) -> dict[str, Any]:
    """Writes all files of a result folder and returns the manifest."""
    from splatcore.report import render

    folder = prepare_folder(folder, overwrite)
    r = reconstruction
    if r.volume.shape != r.grid.shape:
        raise ResultError(f"the volume has shape {r.volume.shape}, its grid {r.grid.shape}")
    writers: dict[str, Callable[[BinaryIO], None]] = {
        "volume.tif": lambda file: write_volume(file, r.volume, r.grid),
        "splats.npz": lambda file: _write_splats(file, r.splats),
        "poses.json": lambda file: _write_json(file, poses_document(r)),
        "report.json": lambda file: _write_json(file, r.report),
        "report.html": lambda file: _write_text(file, render(r.report, r.volume, r.grid)),
    }
    try:
        (folder / _MANIFEST).unlink(missing_ok=True)  # what stands here is no longer whole
        files = []
        for name, write in writers.items():
            with renamed(folder / name) as file:
                write(file)
            files.append(_entry(folder / name))
        manifest = {
            "format": FORMAT,
            "scan": r.scan_name,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "files": files,
            "volume": r.grid.to_json(),
            "versions": _versions(),
            "options": r.options.to_dict(),
            "seed": r.options.seed,
            "device": r.device,
            "timings": r.timings,
        }
        with renamed(folder / _MANIFEST) as file:
            _write_json(file, manifest)
    except OSError as error:
        raise ResultError(f"{folder} cannot be written to: {error.strerror or error}") from error
    return manifest


def read_results(folder: Path | str, verify: bool = False) -> Results:
    """A result folder, whole. `verify` compares every file with the manifest's sha256 as well."""
    folder = Path(folder)
    doc = Document()
    manifest = _read_json(folder / _MANIFEST, doc)
    report = _read_json(folder / "report.json", doc)
    if manifest.get("format") != FORMAT:
        raise ResultError(f"{folder / _MANIFEST}: format is {manifest.get('format')!r}, expected {FORMAT!r}")
    try:
        if verify:
            for entry in manifest["files"]:
                if _entry(folder / entry["name"]) != entry:
                    raise ResultError(f"{folder / entry['name']} differs from the manifest; fetch or compute it again")
        given = manifest["volume"]
        grid = VolumeGrid(tuple(given["shape"]), tuple(given["voxel_mm"]), tuple(given["center_mm"]))
        volume = read_stack(folder / "volume.tif")
        with (folder / "splats.npz").open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            splats = Splats(*(arrays[name] for name in ("means_mm", "scales_mm", "quats_wxyz", "density_per_mm")))
        poses, frames = read_poses(folder / "poses.json")
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile, ScanError) as error:
        raise ResultError(f"{folder} is not a whole result folder: {error}") from error
    if volume.shape != grid.shape:
        raise ResultError(f"{folder / 'volume.tif'} has shape {volume.shape}, the manifest says {grid.shape}")
    return Results(folder, volume, grid, frames, poses, splats, report, manifest)


def write_volume(file: BinaryIO, volume: NDArray[np.float32], grid: VolumeGrid) -> None:
    """Plain contiguous pages; voxel size as resolution (per centimetre) and in the description."""
    z_mm, y_mm, x_mm = grid.voxel_mm
    try:
        tifffile.imwrite(
            file,
            np.ascontiguousarray(volume, np.float32),
            bigtiff=True,
            photometric="minisblack",
            resolution=(10 / x_mm, 10 / y_mm),
            resolutionunit="CENTIMETER",
            software=f"SplatCT {splatcore.__version__}",
            metadata={
                "axes": "ZYX",
                "unit": "mm",
                "spacing": z_mm,
                "voxel_mm": list(grid.voxel_mm),
                "center_mm": list(grid.center_mm),
                "quantity": "attenuation, 1/mm",
            },
        )
    except OSError as error:
        if error.errno is None:  # numpy tells how much it wrote, not why no more: the next bytes do
            file.seek(0, os.SEEK_END)
            file.write(bytes(_NEXT))
            file.flush()
        raise


def _write_splats(file: BinaryIO, splats: Splats) -> None:
    means, scales, quats, density = (np.asarray(array, np.float32) for array in splats.arrays())
    np.savez(file, means_mm=means, scales_mm=scales, quats_wxyz=quats, density_per_mm=density)


def _write_json(file: BinaryIO, document: dict[str, Any]) -> None:
    try:
        text = json.dumps(document, allow_nan=False, indent=1, default=_plain)
    except ValueError as error:
        raise ResultError(
            f"not strict JSON: {error} at {', '.join(_not_finite(document)) or 'unknown place'}"
        ) from error
    _write_text(file, text + "\n")


def _write_text(file: BinaryIO, text: str) -> None:
    file.write(text.encode())


def _plain(value: object) -> Any:
    """numpy's numbers and arrays as JSON knows them."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")


def _not_finite(value: Any, pointer: str = "") -> Iterator[str]:
    """Pointers of the numbers that JSON cannot hold."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float) and not math.isfinite(value):
        yield pointer
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _not_finite(item, f"{pointer}/{key}")
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from _not_finite(item, f"{pointer}/{i}")


def _entry(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"name": path.name, "size": path.stat().st_size, "sha256": digest}


def _versions() -> dict[str, str]:
    found = {"splatct": splatcore.__version__, "python": platform.python_version(), "platform": platform.platform()}
    for name in ("numpy", "scipy", "torch"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def _read_json(path: Path, doc: Document) -> dict[str, Any]:
    loaded = doc.load(path)
    if loaded is None or doc.problems:
        raise ResultError(f"{path.parent} is not a whole result folder: " + "; ".join(map(str, doc.problems)))
    return loaded
