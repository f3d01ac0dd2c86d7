"""Slices of a reconstructed volume as PNG pictures, read from disk without loading the volume."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from PIL import Image

from worker.jobfolder import write_atomically

_SAMPLE = 2_000_000  # voxels looked at for the grey window
_PERCENTILES = (0.5, 99.5)
_AXES = {"z": 0, "y": 1, "x": 2}


def render(
    file: Path, axis: str, index: int, low: float | None, high: float | None, window: Path | None = None
) -> bytes:
    """Slice `index` along `axis` of a volume.

    window: where the grey window of a volume that stays as it is is kept, once it was asked for.
    Raises IndexError outside the volume, FileNotFoundError without one."""
    volume = _volume(file)
    plane = volume[(slice(None),) * _AXES[axis] + (index,)]
    if low is None or high is None:
        auto_low, auto_high = _kept(window, volume) if window else _range(volume)
        low = auto_low if low is None else low
        high = auto_high if high is None else high
    return _png(np.asarray(plane, np.float32)[::-1], low, high)


def _volume(path: Path) -> Any:
    """The volume [z, y, x], mapped. Our own engine wrote it, plain and contiguous."""
    with path.open("rb") as file:  # once: a draft may be replaced at any moment
        tiff = tifffile.TiffFile(file, is_ome=False)
        page, offset = tiff.pages.first, tiff.series[0].dataoffset
        if offset is None or page.dtype is None:
            raise ValueError(f"{path} is not one contiguous array")
        shape = (len(tiff.pages), *page.shape)
        return np.memmap(file, page.dtype.newbyteorder(tiff.byteorder), "r", offset, shape)


def _kept(window: Path, volume: Any) -> tuple[float, float]:
    try:
        kept = json.loads(window.read_bytes())
        return float(kept["low"]), float(kept["high"])
    except (FileNotFoundError, ValueError, KeyError):
        low, high = _range(volume)
    write_atomically(window, json.dumps({"low": low, "high": high}).encode())
    return low, high


def _range(volume: Any) -> tuple[float, float]:
    """The default grey window: most of the volume's own range."""
    step = max(1, round((volume.size / _SAMPLE) ** (1 / 3)))
    low, high = (float(value) for value in np.percentile(volume[::step, ::step, ::step], _PERCENTILES))
    return low, high


def _png(plane: np.ndarray[Any, np.dtype[np.float32]], low: float, high: float) -> bytes:
    scaled = (plane.astype(np.float64) - low) * (255.0 / max(high - low, 1e-30))  # low and high are anybody's
    grey = np.clip(np.nan_to_num(scaled), 0, 255).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(grey).save(out, "PNG", compress_level=3)
    return out.getvalue()
