"""The scans of the bench: one object, one badly calibrated scanner, projected by our own projector or by RTK's."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tifffile

from bench.paper.keys import key_of
from bench.paper.rtk.remote import RTK
from bench.paper.scenes import SCENES, find_volume, read_volume
from splatcore.evaluate import read_truth
from splatcore.simulate import Simulation, add_noise, simulate

Projector = Literal["own", "rtk"]


@dataclass(frozen=True)
class ScanSpec:
    """Everything that decides what a scan holds. Poses err as in the paper: per axis and view, normal, independent."""

    scene: str
    edge: int = 128  # voxels; detectors have twice as many pixels
    views: int = 75
    sigma_rot: float = 0.03  # rad
    sigma_trans: float = 1.0  # voxels
    noise: Literal["none", "r2"] = "r2"
    projector: Projector = "own"
    seed: int = 0
    offset_u_px: float = 0.0
    roll_deg: float = 0.0
    axis_pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    to_full_range: bool = False  # the object's largest value becomes 1, as R2-Gaussian has it

    @property
    def key(self) -> str:
        return key_of(asdict(self))

    def simulation(self, noise: Literal["none", "r2"]) -> Simulation:
        return Simulation(
            views=self.views, sigma_rot=self.sigma_rot, sigma_trans=self.sigma_trans, noise=noise, seed=self.seed,
            offset_px=(self.offset_u_px, 0.0), roll_deg=self.roll_deg, axis_pitch_deg=self.axis_pitch_deg,
            yaw_deg=self.yaw_deg,
        )  # fmt: skip

    def command(self, volume: Path, out: str) -> str:
        """The same scan by hand, as far as our own projector makes it from a file of its size."""
        static = "".join(
            f" {name} {value}"
            for name, value in (
                ("--true-offset-px", f"{self.offset_u_px:g} 0" if self.offset_u_px else ""),
                ("--true-roll-deg", self.roll_deg),
                ("--true-axis-pitch-deg", self.axis_pitch_deg),
                ("--true-yaw-deg", self.yaw_deg),
            )
            if value
        )
        return (
            f"splatct simulate --volume {volume.name} --out {out} --views {self.views} --sigma-rot {self.sigma_rot:g} "
            f"--sigma-trans {self.sigma_trans:g} --noise {self.noise} --seed {self.seed}{static}"
        )


def make_scan(spec: ScanSpec, work: Path, data: Path | None, threads: int, rtk: RTK) -> Path:
    """The scan's folder in `work`, made unless it is there. Raises FileNotFoundError and RtkError."""
    folder = work / "scans" / f"{spec.scene}-{spec.key}"
    if (folder / "scan.json").exists():
        return folder
    part = folder.with_name(f".{folder.name}.part")  # takes its name when it is whole
    shutil.rmtree(part, ignore_errors=True)
    volume = read_volume(find_volume(SCENES[spec.scene], spec.edge, data), spec.edge, spec.to_full_range)
    own = spec.projector == "own"
    document = simulate(volume, part, spec.simulation(spec.noise if own else "none"), threads, spec.scene)
    if not own:
        _project_again(part, document, spec, rtk, threads)
    part.rename(folder)
    return folder


def _project_again(folder: Path, document: dict[str, Any], spec: ScanSpec, rtk: RTK, threads: int) -> None:
    """RTK's line integrals in place of ours, with the same noise's seed."""
    header, truth, _, frames = read_truth(folder)
    assert header.volume is not None
    clean = rtk.project(truth, header.volume, frames, threads)
    what = spec.simulation(spec.noise)
    noisy = add_noise(clean, what.noise, what.i0, what.sigma_counts, np.random.default_rng([what.seed, 1]))
    tifffile.imwrite(folder / "projections.tif", noisy, photometric="minisblack", bigtiff=True)
    document["simulation"]["projector"] = "RTK Joseph"
    (folder / "scan.json").write_text(json.dumps(document), encoding="utf-8")
