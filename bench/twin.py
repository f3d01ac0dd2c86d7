"""The paper's twin experiment (its section 3): is it the geometry, or is it the small number of views?

    python bench/twin.py VOLUME [VOLUME ...] [--views 75] [--dense 300] [--method splatct] [--quick] [--json FILE]

VOLUME is a cube as `splatct simulate` takes it. Four steps:

1. A dense scan with perturbed poses; its FDK with the nominal poses is the pseudo truth.
2. The pseudo truth is re-projected along the nominal frames of the sparse views: a twin whose geometry is right.
3. Sparse views of both, the real and the twin, are reconstructed in the same way with the nominal frames held fixed;
   the real ones once more with calibration (--calibrate full of the engine's own method).
4. Residuals are compared along edges. A misplaced view leaves them signed: a shift of the view then explains them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatcore import _native
from splatcore.machine import threads_allowed
from splatcore.options import Options
from splatcore.poses import accumulate
from splatcore.reconstruct import drain, reconstruct
from splatcore.reconstruction import Reconstruction
from splatcore.scan import Scan, read_scan
from splatcore.simulate import Simulation, add_noise, load_volume, project, simulate
from splatcore.start import fdk

_EDGES = 0.1  # share of the pixels, those of the steepest model image, that count as edges


@dataclass(frozen=True)
class Residuals:
    """What a reconstruction leaves of its views, medians over them."""

    rms: float  # of all pixels, share of the images' RMS
    edge_to_flat: float  # RMS on edges over RMS elsewhere
    shift_px: float  # length of the shift of the image that explains most of the residual
    share: float  # of the residual's variance that a rigid motion of the view explains
    bias: float  # |mean| of the residual times the sign of the slope along u on edges, over its RMS there


def residuals(scan: Scan, result: Reconstruction, threads: int) -> Residuals:
    """Of the scan's images against the splats seen from the result's own frames."""
    frames, images = result.corrected, scan.projections
    renderer = _native.Renderer32(frames.rows, frames.cols, threads)
    model = np.empty((frames.rows, frames.cols), np.float32)
    rows = []
    for frame, image in zip(frames.packed(), images, strict=True):
        renderer.render(frame, frames.beam == "cone", *result.splats.arrays(), model)
        residual = (image - model).astype(np.float64)
        down, along = np.gradient(model.astype(np.float64))
        steep = np.hypot(down, along)
        edge = steep >= np.quantile(steep, 1 - _EDGES)
        slopes = np.stack([along[edge], down[edge]])
        shift = np.linalg.lstsq(slopes.T, residual[edge], rcond=None)[0]
        on, off = np.sqrt((residual[edge] ** 2).mean()), np.sqrt((residual[~edge] ** 2).mean())
        signed = residual[edge] * np.sign(along[edge])
        rows.append([np.sqrt((residual**2).mean()), on / off, np.hypot(*shift), abs(signed.mean()) / on])
    rms, ratio, shift_px, bias = np.median(np.array(rows), axis=0)
    normals = accumulate(renderer, result.splats, frames, images, None, float(images.max()))
    signal = float(np.sqrt((images.astype(np.float64) ** 2).mean()))
    return Residuals(
        float(rms / signal), float(ratio), float(shift_px), float(np.median(normals.explained())), float(bias)
    )


def experiment(path: Path, args: argparse.Namespace, threads: int) -> list[dict[str, Any]]:
    """The four steps on one volume: a row for the real views, the twin, and the real views calibrated."""
    step = max(1, args.dense // args.views)
    what = Simulation(views=args.views * step, sigma_rot=args.sigma_rot, sigma_trans=args.sigma_trans, seed=args.seed)
    volume = reduced(load_volume(path), args.bin)
    with tempfile.TemporaryDirectory() as folder:
        simulate(volume, folder, what, threads, path.stem)
        dense = read_scan(folder)
    pseudo = np.maximum(fdk(dense.projections, dense.frames, dense.volume, threads), 0)
    sparse = replace(dense, projections=np.ascontiguousarray(dense.projections[::step]), frames=dense.frames[::step])
    clean = project(pseudo, dense.volume, sparse.frames, threads)
    noisy = add_noise(clean, what.noise, what.i0, what.sigma_counts, np.random.default_rng([what.seed, 2]))
    twin = replace(sparse, projections=noisy)
    given: dict[str, Any] = {"calibrate": "none", "threads": threads, "method": args.method, "steps": args.steps}
    found = []
    for label, scan, options in (
        ("real", sparse, given),
        ("twin", twin, given),
        ("real, calibrated", sparse, {"calibrate": "full", "threads": threads}),
    ):
        result = drain(reconstruct(scan, Options.from_dict(options)))
        found.append({"scan": path.stem, "views": label, **residuals(scan, result, threads).__dict__})
    return found


def reduced(volume: np.ndarray, factor: int) -> np.ndarray:
    """Means of factor^3 blocks of a cube whose edge it divides."""
    edge = volume.shape[0] // factor
    cut = volume[: edge * factor, : edge * factor, : edge * factor]
    means = cut.reshape(edge, factor, edge, factor, edge, factor).mean(axis=(1, 3, 5))
    return np.ascontiguousarray(means, np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes", nargs="+", type=Path)
    parser.add_argument("--views", type=int, default=75)
    parser.add_argument("--dense", type=int, default=300, help="views of the dense scan, a multiple of --views")
    parser.add_argument("--sigma-rot", type=float, default=0.03, metavar="RAD")
    parser.add_argument("--sigma-trans", type=float, default=1.0, metavar="VOXELS")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--method", default="splatct", help="of the two with fixed frames; the paper used r2")
    parser.add_argument("--steps", type=int, help="of methods r2 and paper")
    parser.add_argument("--bin", type=int, default=1, help="average blocks of the volume's voxels first")
    parser.add_argument("--quick", action="store_true", help="a quarter of the resolution and two dense views for one")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    args = parser.parse_args()
    if args.quick:
        args.bin, args.dense = 4 * args.bin, 2 * args.views
    line = "| {scan} | {views} | {rms:.2%} | {edge_to_flat:.2f} | {shift_px:.3f} | {share:.1%} | {bias:.3f} |"
    print("| scan | views | residual | edge/flat | shift (px) | explained by motion | signed bias |")
    print("|---|---|---|---|---|---|---|")
    rows: list[dict[str, Any]] = []
    for path in args.volumes:
        for row in experiment(path, args, threads_allowed()):
            rows.append(row)
            print(line.format(**row), flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
