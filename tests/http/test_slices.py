"""Slices are read straight from the file that the engine's own writer makes."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from server import slices
from splatcore.grid import VolumeGrid
from splatcore.results import write_volume
from worker.jobfolder import JobFolder


@pytest.mark.parametrize("shape", [(9, 4, 3), (3, 4, 5), (1, 16, 16)])
def test_a_volume_of_the_engine(tmp_path: Path, shape: tuple[int, int, int]) -> None:
    volume = np.random.default_rng(0).uniform(0, 0.02, shape).astype("float32")
    folder = JobFolder(tmp_path, "job")
    folder.results.mkdir(parents=True)
    with (folder.results / "volume.tif").open("wb") as file:
        write_volume(file, volume, VolumeGrid(shape, (1.0, 1.0, 1.0)))
    for axis, planes in (("z", volume), ("y", volume.swapaxes(0, 1)), ("x", np.moveaxis(volume, 2, 0))):
        index = len(planes) - 1
        picture = np.asarray(
            Image.open(io.BytesIO(slices.render(folder.results / "volume.tif", axis, index, 0.0, 0.02)))
        )
        np.testing.assert_allclose(picture, planes[index][::-1] / 0.02 * 255, atol=1.0)
        with pytest.raises(IndexError):
            slices.render(folder.results / "volume.tif", axis, len(planes), None, None)


def test_a_flat_volume_and_bad_numbers_are_shown_too(tmp_path: Path) -> None:
    volume = np.zeros((3, 4, 5), "float32")
    volume[1, 1, 1] = np.nan
    folder = JobFolder(tmp_path, "job")
    folder.results.mkdir(parents=True)
    with (folder.results / "volume.tif").open("wb") as file:
        write_volume(file, volume, VolumeGrid(volume.shape, (1.0, 1.0, 1.0)))
    assert slices.render(folder.results / "volume.tif", "z", 1, None, None).startswith(b"\x89PNG")
