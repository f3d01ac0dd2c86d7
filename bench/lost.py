"""Views that began far off: how many are lost after half resolution, without and with the search for them.

    python -m bench.lost [--data DIR] [--scenes NAMES] [--errors RAD/VOXELS,...] [--seeds N,...]

Previews, which end at half resolution, of scans by our own projector at 128^3: 75 views, R2-Gaussian's noise. A view is
lost if its aligned rotation is more than 1.5 degrees from the truth. `prism` is small, hollow, of six-fold symmetry.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np

from bench.paper.scenes import SCENES, find_volume, read_volume
from splatcore.calibration import Calibration
from splatcore.evaluate import read_truth
from splatcore.gauge import align, pose_errors
from splatcore.machine import threads_allowed
from splatcore.options import Options
from splatcore.reconstruct import drain, reconstruct
from splatcore.scan import read_scan
from splatcore.scores import psnr
from splatcore.simulate import Simulation, simulate
from splatcore.splats import Floats

_LOST_DEG = 1.5


def prism(edge: int = 40) -> Floats:
    """A hollow hexagonal prism, upright. [z, y, x]"""
    z, y, x = (np.mgrid[:edge, :edge, :edge] + 0.5) / edge * 2 - 1
    turns = np.deg2rad([0.0, 60.0, 120.0])
    apothem = np.max([np.abs(np.cos(turn) * x + np.sin(turn) * y) for turn in turns], axis=0)
    return ((apothem < 0.6) & (np.abs(z) < 0.6) & (np.hypot(x, y) > 0.25)).astype(np.float32)


def outcome(folder: Path, threads: int) -> tuple[int, float, float, float]:
    """Views lost, median rotation error in degrees, aligned PSNR, seconds of one preview."""
    _, truth, unit, frames = read_truth(folder)
    began = time.monotonic()
    result = drain(reconstruct(read_scan(folder), Options(quality="preview", threads=threads)))
    seconds = time.monotonic() - began
    similarity, aligned = align(frames, result.corrected)
    error = np.rad2deg(np.linalg.norm(pose_errors(frames, aligned).vectors()[0], axis=1))
    volume = result.splats.moved(similarity).voxelize(result.grid, threads)
    return int((error > _LOST_DEG).sum()), float(np.median(error)), psnr(volume, truth, unit), seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of NAME_128.npz, for scenes that are not committed")
    parser.add_argument("--scenes", default="head,chest,pelvis,prism", help=f"of prism, {', '.join(SCENES)}")
    parser.add_argument("--errors", default="0.1/5,0.15/7", help="standard deviations, RAD/VOXELS; default %(default)s")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--threads", type=int, default=threads_allowed())
    args = parser.parse_args()
    for name in args.scenes.split(","):
        if name != "prism" and name not in SCENES:
            parser.error(f"--scenes: got {name!r}, expected of prism, {', '.join(SCENES)}")
    print("| | lost: without, with | median: without, with | PSNR: without, with | seconds: without, with |")
    print("|---|---:|---:|---:|---:|")
    for name in args.scenes.split(","):
        volume = prism() if name == "prism" else read_volume(find_volume(SCENES[name], 128, args.data), 128)
        for errors in args.errors.split(","):
            rotation, translation = (float(part) for part in errors.split("/"))
            for seed in (int(part) for part in args.seeds.split(",")):
                what = Simulation(sigma_rot=rotation, sigma_trans=translation, noise="r2", seed=seed)
                with tempfile.TemporaryDirectory() as scan:
                    simulate(volume, Path(scan), what, args.threads, name)
                    with patch.object(Calibration, "find_lost", return_value=0):
                        without = outcome(Path(scan), args.threads)
                    found = outcome(Path(scan), args.threads)
                cells = " | ".join(
                    f"{a:{spec}}, {b:{spec}}"
                    for a, b, spec in zip(without, found, ("d", ".3f", ".2f", ".0f"), strict=True)
                )
                print(f"| {name}, {errors}, seed {seed} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
