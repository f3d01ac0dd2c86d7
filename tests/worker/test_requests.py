"""What the engine process does for others while it runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from splatcore.grid import VolumeGrid
from worker.jobfolder import JobFolder
from worker.requests import Requests

GRID = VolumeGrid((2, 3, 4), (1.0, 2.0, 3.0))


@pytest.fixture
def folder(tmp_path: Path) -> JobFolder:
    folder = JobFolder(tmp_path, "job")
    folder.path.mkdir(parents=True)
    return folder


def test_a_newer_draft_takes_the_place_of_an_older(folder: JobFolder) -> None:
    requests = Requests(folder, 0.0)
    for value in (1.0, 2.0):
        assert requests.show(lambda value=value: np.full(GRID.shape, value, np.float32), GRID)
        np.testing.assert_array_equal(tifffile.imread(folder.draft), np.full(GRID.shape, value))
    folder.tidy()
    assert list(folder.path.iterdir()) == []


def test_a_draft_that_cannot_be_written_leaves_the_older(folder: JobFolder, capsys: pytest.CaptureFixture[str]) -> None:
    requests = Requests(folder, 0.0)
    assert requests.show(lambda: np.ones(GRID.shape, np.float32), GRID)

    def full() -> np.ndarray:
        raise OSError(28, "No space left on device")

    assert not requests.show(full, GRID)
    assert "No space left" in capsys.readouterr().err
    assert tifffile.imread(folder.draft).max() == 1
    assert [file.name for file in folder.path.iterdir()] == ["draft.tif"]
