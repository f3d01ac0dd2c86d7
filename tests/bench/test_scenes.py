"""Where objects come from, and what their scans hold."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bench.paper.rtk.remote import RTK
from bench.paper.scans import ScanSpec, make_scan
from bench.paper.scenes import COMMITTED, SCENES, find_volume, read_volume
from splatcore.gauge import pose_errors
from splatcore.scan import read_scan


def test_exactly_what_may_be_passed_on_is_committed() -> None:
    committed = {path.name for path in COMMITTED.glob("*.npz")}
    assert committed == {f"{scene.stem}_128.npz" for scene in SCENES.values() if scene.shipped}
    assert not {"teapot", "bonsai", "engine"} & {scene.name for scene in SCENES.values() if scene.shipped}
    notice = (COMMITTED / "README.md").read_text(encoding="utf-8")
    for scene in SCENES.values():
        assert not scene.shipped or (f"{scene.stem}_128.npz" in notice and scene.licence in notice), scene.name
    assert sum(path.stat().st_size for path in COMMITTED.glob("*.npz")) < 2_000_000


@pytest.mark.parametrize("name", [scene.name for scene in SCENES.values() if scene.shipped])
def test_committed_objects_lie_inside_the_cylinder(name: str) -> None:
    volume = read_volume(find_volume(SCENES[name], 128, None), 128)
    axis = (np.arange(128) + 0.5) / 64 - 1
    outside = axis[:, None] ** 2 + axis[None, :] ** 2 > 1.03**2
    assert volume.shape == (128,) * 3 and 0.5 < volume.max() <= 1
    assert not volume[:, outside].any()


def test_a_scene_that_cannot_be_shipped_says_where_it_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"teapot_N.npz with N a multiple of 128 in .*--data"):
        find_volume(SCENES["teapot"], 128, tmp_path)


def test_coarser_objects_are_block_means_and_the_nearest_size_serves(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for edge in (8, 16, 12):
        np.savez(tmp_path / f"teapot_{edge}.npz", volume=rng.integers(0, 200, (edge,) * 3).astype(np.uint8))
    assert find_volume(SCENES["teapot"], 8, tmp_path).name == "teapot_8.npz"
    assert find_volume(SCENES["teapot"], 4, tmp_path).name == "teapot_8.npz"
    file = tmp_path / "teapot_16.npz"
    with np.load(file) as arrays:
        whole = arrays["volume"] / 255
    half = read_volume(file, 8)
    assert half[3, 1, 5] == pytest.approx(whole[6:8, 2:4, 10:12].mean(), rel=1e-6)
    assert read_volume(file, 8, to_full_range=True).max() == 1


def test_a_scan_is_made_once_and_holds_what_was_asked_for(tmp_path: Path, data: Path, tiny: ScanSpec) -> None:
    folder = make_scan(tiny, tmp_path, data, 1, RTK())
    assert make_scan(tiny, tmp_path, data, 1, RTK("no such python")) == folder
    scan = read_scan(folder)
    assert scan.projections.shape == (12, 48, 48) and scan.volume.shape == (24, 24, 24)
    document = json.loads((folder / "scan.json").read_text())
    assert document["simulation"]["options"]["noise"] == "r2"
    assert not list(tmp_path.glob("scans/.*")), "no half-made scan is left behind"


def test_every_parameter_of_a_scan_is_in_its_key(tiny: ScanSpec) -> None:
    from dataclasses import fields, replace

    others = {"scene": "head", "noise": "none", "projector": "rtk", "to_full_range": True}
    keys = {tiny.key}
    for field in fields(tiny):
        changed = replace(tiny, **{field.name: others.get(field.name, getattr(tiny, field.name) or 0 + 7)})
        if changed == tiny:
            changed = replace(tiny, **{field.name: getattr(tiny, field.name) + 1})
        keys.add(changed.key)
    assert len(keys) == 1 + len(fields(tiny))


def test_static_errors_reach_the_true_frames(tmp_path: Path, data: Path) -> None:
    from splatcore.evaluate import read_truth

    spec = ScanSpec("teapot", edge=24, views=8, sigma_rot=0.0, sigma_trans=0.0, roll_deg=1.0)
    header, _, _, true = read_truth(make_scan(spec, tmp_path, data, 1, RTK()))
    omega, _ = pose_errors(true, header.frames).vectors()
    assert np.rad2deg(np.linalg.norm(omega, axis=1)) == pytest.approx(np.ones(8), abs=1e-6)
