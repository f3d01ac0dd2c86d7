"""RTK sees what our frames say: `pytest -m rtk`, RTK in this Python or in the one that SPLATCT_RTK_PYTHON names."""

from __future__ import annotations

import os
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from phantom import phantom

from bench.paper.rtk.remote import RTK, RtkError
from splatcore.export import rtk_geometry
from splatcore.geometry import Frames, RigidMotions, circular
from splatcore.grid import VolumeGrid
from splatcore.scores import psnr
from splatcore.simulate import project

pytestmark = pytest.mark.rtk

GRID = VolumeGrid((32, 32, 32), (6.25, 6.25, 6.25))


@pytest.fixture(scope="module")
def rtk() -> RTK:
    found = RTK(os.environ.get("SPLATCT_RTK_PYTHON", sys.executable))
    found.require()
    return found


def askew(views: int, **how: bool) -> Frames:
    """Frames off the circle, and stored mirrored where asked."""
    plain = circular("cone", np.arange(views) * 360 / views, 500, 700, 50, 60, (7.5, 7.0), (9.0, -12.0))
    rng = np.random.default_rng(1)
    frames = RigidMotions.exp(rng.normal(0, 0.05, (views, 3)), rng.normal(0, 4, (views, 3))).correct(plain)
    if how.get("flip_u"):
        frames = replace(frames, u=-frames.u)
    if how.get("flip_v"):
        frames = replace(frames, v=-frames.v)
    return frames


@pytest.mark.parametrize("how", [{}, {"flip_v": True}, {"flip_u": True}], ids=["plain", "upside down", "mirrored"])
def test_its_projections_are_ours(rtk: RTK, how: dict[str, bool]) -> None:
    """Both are Joseph's projector, written twice: they agree to single precision, and any slip of axes would show."""
    volume, frames = phantom(32) * np.float32(0.01), askew(5, **how)
    theirs, ours = rtk.project(volume, GRID, frames, 1), project(volume, GRID, frames, 1)
    assert np.sqrt(np.mean((theirs - ours) ** 2)) < 1e-6 * ours.max()
    assert np.sqrt(np.mean((theirs[:, ::-1] - ours) ** 2)) > 0.05 * ours.max()


@pytest.mark.parametrize("method, count, least", [("fdk", 1, 19), ("sart", 2, 30), ("osem", 2, 24), ("tvcg", 2, 24)])
def test_every_method_reconstructs_from_frames_off_the_circle(rtk: RTK, method: str, count: int, least: float) -> None:
    volume, frames = phantom(32) * np.float32(0.01), askew(40)
    images = project(volume, GRID, frames, 1)
    (found,), peak = rtk.reconstruct(method, images, frames, GRID, 1, (count,), {"subset": 1, "relaxation": 1.0})
    assert psnr(found.volume, volume, 0.01) > least
    assert found.iterations == count and peak > 50


def test_geometry_xml_holds_every_view(rtk: RTK) -> None:
    text = rtk.geometry_xml(askew(3))
    assert text.count("<Matrix>") == 3
    distances = [float(value) for value in re.findall(r"<SourceToIsocenterDistance>([^<]+)<", text)]
    assert len(distances) == 3 and all(450 < d < 550 for d in distances)


@pytest.mark.parametrize("how", [{}, {"flip_v": True}], ids=["plain", "upside down"])
def test_its_own_writer_says_what_our_export_says(rtk: RTK, how: dict[str, bool]) -> None:
    frames = askew(4, **how)
    theirs, ours = (_numbers(text) for text in (rtk.geometry_xml(frames), rtk_geometry(frames)))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


def _numbers(text: str) -> np.ndarray:
    """The matrices of a geometry file. [views, 12]"""
    matrices = [re.sub(r"\s+", " ", m).split() for m in re.findall(r"<Matrix>([^<]*)</Matrix>", text)]
    return np.array(matrices, float)


def test_what_rtk_cannot_describe_is_refused(rtk: RTK) -> None:
    frames = askew(3)
    slanted = replace(frames, v=frames.v + 0.1 * frames.u)
    with pytest.raises(RtkError, match="rows square to columns"):
        rtk.geometry_xml(slanted)
    with pytest.raises(RtkError, match="parallel"):
        rtk.geometry_xml(circular("parallel", np.arange(3) * 60.0, 500, 700, 8, 8, (1.0, 1.0)))
