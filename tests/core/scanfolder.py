"""Writes small scan folders for tests, and tells what bad ones are blamed for."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from splatcore.errors import ScanError
from splatcore.scan import check_scan, read_scan

ROWS, COLS, VIEWS = 12, 16, 9

SCAN: dict[str, Any] = {
    "format": "splatct-scan/1",
    "name": "small",
    "projections": {"files": ["projections.tif"], "kind": "line_integrals", "scale": 1.0},
    "geometry": {
        "beam": "cone",
        "dso_mm": 500.0,
        "dsd_mm": 700.0,
        "detector": {"rows": ROWS, "cols": COLS, "pixel_mm": [2.0, 1.5], "offset_mm": [0.0, 0.0]},
        "angles_deg": [40.0 * k for k in range(VIEWS)],
    },
    "volume": {"shape": [6, 7, 8], "voxel_mm": [1.0, 1.5, 2.0]},
}


def plain_images(dtype: str = "float32") -> np.ndarray:
    """A blob in every view, 0 at the border. [VIEWS, ROWS, COLS]"""
    r, c = np.mgrid[:ROWS, :COLS]
    blob = np.maximum(0, 1 - ((r - 5.5) / 4) ** 2 - ((c - 7.5) / 5) ** 2)
    return np.stack([blob * (1 + k / 100) for k in range(VIEWS)]).astype(dtype)


def change(scan: dict[str, Any], pointer: str, value: Any) -> None:
    """Sets (or with `...` deletes) what a JSON pointer names."""
    *path, last = pointer.strip("/").split("/")
    target: Any = scan
    for key in path:
        target = target[int(key)] if isinstance(target, list) else target[key]
    if value is ...:
        del target[last]
    elif isinstance(target, list):
        target[int(last)] = value
    else:
        target[last] = value


def write_scan(
    folder: Path, images: np.ndarray | None = None, changes: dict[str, Any] | None = None, **tiff: Any
) -> Path:
    """A good scan folder, with changes by JSON pointer."""
    folder.mkdir(parents=True, exist_ok=True)
    scan = copy.deepcopy(SCAN)
    for pointer, value in (changes or {}).items():
        change(scan, pointer, value)
    (folder / "scan.json").write_text(json.dumps(scan))
    write_tiff(folder / "projections.tif", plain_images() if images is None else images, **tiff)
    return folder


def write_tiff(path: Path, images: np.ndarray, **options: Any) -> None:
    tifffile.imwrite(path, images, photometric="minisblack", **options)


def problems(folder: Path) -> str:
    """Everything a bad scan is blamed for; reading and checking must agree on it."""
    with pytest.raises(ScanError) as checked:
        check_scan(folder)
    with pytest.raises(ScanError) as read:
        read_scan(folder)
    assert str(read.value) == str(checked.value)
    return str(checked.value)
