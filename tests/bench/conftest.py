"""A bench on an object made on the spot, and a scan of it that takes no time."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from bench.paper.rtk.remote import RTK
from bench.paper.run import Bench
from bench.paper.scans import ScanSpec

sys.path.append(str(Path(__file__).parents[1] / "core"))

from phantom import phantom


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A --data folder whose teapot is the phantom, 24 voxels a side."""
    folder = tmp_path_factory.mktemp("data")
    np.savez(folder / "teapot_24.npz", volume=np.round(255 * phantom(24)).astype(np.uint8))
    return folder


@pytest.fixture
def bench(tmp_path: Path, data: Path) -> Bench:
    """Its RTK is a Python that has none."""
    return Bench(tmp_path / "work", data, threads=1, rtk=RTK(sys.executable))


@pytest.fixture
def tiny() -> ScanSpec:
    return ScanSpec("teapot", edge=24, views=12)
