"""Frames in other toolkits' terms: what their formulas make of them is what ours see."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatct_client.cli import main

from splatcore.errors import ExportError
from splatcore.export import astra_vectors, rtk_geometry, upside_down
from splatcore.geometry import Frames, RigidMotions, circular

POINTS = np.random.default_rng(0).uniform(-60, 60, (20, 3))


def askew(**how: bool) -> Frames:
    plain = circular("cone", np.arange(7) * 360 / 7, 500, 700, 50, 60, (7.5, 7.0), (9.0, -12.0))
    rng = np.random.default_rng(1)
    frames = RigidMotions.exp(rng.normal(0, 0.05, (7, 3)), rng.normal(0, 4, (7, 3))).correct(plain)
    return replace(frames, **{name: -getattr(frames, name) for name in how})


def rotation(gantry: float, out_of_plane: float, in_plane: float) -> np.ndarray:
    """RTK's documentation: the rotated axes as rows, angles in degrees."""
    g, o, i = -np.deg2rad([gantry, out_of_plane, in_plane])
    around_z = np.array([[np.cos(i), -np.sin(i), 0], [np.sin(i), np.cos(i), 0], [0, 0, 1]])
    around_x = np.array([[1, 0, 0], [0, np.cos(o), -np.sin(o)], [0, np.sin(o), np.cos(o)]])
    around_y = np.array([[np.cos(g), 0, np.sin(g)], [0, 1, 0], [-np.sin(g), 0, np.cos(g)]])
    return around_z @ around_x @ around_y


@pytest.mark.parametrize("how", [{}, {"v": True}, {"u": True}, {"u": True, "v": True}], ids=str)
def test_rtk_sees_every_point_where_we_do(how):
    frames = askew(**how)
    pixels = frames.project(POINTS) - np.array([(frames.cols - 1) / 2, (frames.rows - 1) / 2])
    expected = pixels * np.array([7.0, -7.5 if upside_down(frames) else 7.5])  # circular takes (down, across)
    views = ET.fromstring(rtk_geometry(frames)).findall("Projection")
    assert len(views) == len(frames)
    points = POINTS[:, [1, 2, 0]]
    for view, mm in zip(views, expected, strict=True):
        one = {entry.tag: entry.text for entry in view}
        matrix = np.array(one["Matrix"].split(), float).reshape(3, 4)
        seen = matrix @ np.vstack([points.T, np.ones(len(points))])
        np.testing.assert_allclose((seen[:2] / seen[2]).T, mm, atol=1e-9)
        # ... and by its nine parameters
        turned = points @ rotation(*(float(one[n]) for n in ("GantryAngle", "OutOfPlaneAngle", "InPlaneAngle"))).T
        source = np.array([float(one[n]) for n in ("SourceOffsetX", "SourceOffsetY", "SourceToIsocenterDistance")])
        way = float(one["SourceToDetectorDistance"]) / (source[2] - turned[:, 2:])
        hit = source[:2] + way * (turned[:, :2] - source[:2])
        middle = np.array([float(one["ProjectionOffsetX"]), float(one["ProjectionOffsetY"])])
        np.testing.assert_allclose(hit - middle, mm, atol=1e-9)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_astra_gets_source_centre_and_steps(beam):
    frames = circular(beam, np.arange(5) * 30.0, 500, 700, 8, 9, (1.0, 1.5))
    vectors = astra_vectors(frames)
    assert vectors.shape == (5, 12)
    np.testing.assert_array_equal(vectors[:, 6:9], frames.u)
    np.testing.assert_array_equal(vectors[:, :3], frames.source)


def test_what_rtk_cannot_describe_is_refused():
    frames = askew()
    with pytest.raises(ExportError, match="rows square to columns"):
        rtk_geometry(replace(frames, v=frames.v + 0.1 * frames.u))
    with pytest.raises(ExportError, match="parallel beam"):
        rtk_geometry(circular("parallel", np.arange(3) * 60.0, 500, 700, 8, 8, (1.0, 1.0)))
    u = frames.u.copy()
    u[0] *= -1
    with pytest.raises(ExportError, match="mirrored"):
        rtk_geometry(replace(frames, u=u))


def poses(frames: Frames, file: Path) -> Path:
    views = [{"frame": frame} for frame in frames.to_json()]
    detector = {"rows": frames.rows, "cols": frames.cols}
    file.write_text(
        json.dumps({"format": "splatct-poses/1", "beam": frames.beam, "detector": detector, "views": views})
    )
    return file


def test_on_the_command_line(tmp_path, capsys):
    found, out = poses(askew(), tmp_path / "poses.json"), tmp_path / "geometry.xml"
    assert main(["export", str(found), "--as", "rtk", "-o", str(out)]) == 0
    assert "7 views" in capsys.readouterr().out
    assert len(ET.parse(out).getroot().findall("Projection")) == 7
    assert main(["export", str(found), "--as", "rtk", "-o", str(out)]) == 2  # never over what is there
    assert "exists already" in capsys.readouterr().err
    assert main(["export", str(tmp_path), "--as", "astra", "-o", str(tmp_path / "a.npy"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["geometry"] == "cone_vec"
    assert np.load(tmp_path / "a.npy").shape == (7, 12)
    assert main(["export", str(found), "--as", "rtk", "-o", str(tmp_path / "none" / "g.xml")]) == 2
    assert "cannot be written" in capsys.readouterr().err
