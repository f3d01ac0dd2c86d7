"""The paper's claims, one switch at a time.

    python bench/ablations.py VOLUME [VOLUME ...] [--steps 30000] [--bin 1] [--quick] [--json FILE]

VOLUME is a cube as `splatct simulate` takes it. Two tables:

1. The paper's method as it is; with total variation while poses move; with the pose gradient through the splats'
   means alone (its Fig. 4: without the path through their covariance); and with poses held fixed. A run shorter
   than the paper's 30,000 steps moves poses by as much larger steps, so that they reach as far.
2. FDK of N views with perturbed poses against FDK of the same views unperturbed: the paper's eq. 1 has the error
   fall as 1/sqrt(N). That is the part by which draws of the perturbation differ (their scatter); what they have in
   common is a blur, which no number of views averages out.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from twin import reduced

from splatcore import r2
from splatcore.evaluate import evaluate
from splatcore.geometry import circular
from splatcore.grid import VolumeGrid
from splatcore.machine import threads_allowed
from splatcore.options import Options
from splatcore.r2 import STEPS, Switches
from splatcore.reconstruct import drain
from splatcore.results import write_results
from splatcore.scan import read_scan
from splatcore.simulate import Simulation, draw_motions, load_volume, project, simulate
from splatcore.start import fdk

_DRAWS = 4  # of the perturbation, for the scatter of FDK


def switches(steps: int) -> dict[str, Switches]:
    """What is varied, under its name in the table."""
    rate = max(1.0, STEPS / steps)
    return {
        "the paper's method": Switches(pose_rate=rate),
        "with TV": Switches(pose_rate=rate, variation=True),
        "without the covariance path": Switches(pose_rate=rate, covariance_path=False),
        "poses fixed": Switches(moving=False),
    }


def runs(volume: np.ndarray, name: str, args: argparse.Namespace, threads: int) -> list[dict[str, Any]]:
    """One row of scores for each switch."""
    found = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "scan"
        what = Simulation(views=args.views, sigma_rot=args.sigma_rot, sigma_trans=args.sigma_trans, seed=args.seed)
        simulate(volume, folder, what, threads, name)
        scan = read_scan(folder)
        options = Options(method="paper", steps=args.steps, splats=args.splats, threads=threads)
        for label, chosen in switches(args.steps).items():
            result = drain(r2.reconstruct(scan, options, chosen))
            write_results(result, Path(temporary) / "out", overwrite=True)
            scores = evaluate(Path(temporary) / "out", folder, threads)
            row = {"scan": name, "variant": label, "splats": len(result.splats), **scores}
            found.append(row)
            print(
                "| {scan} | {variant} | {psnr:.2f} | {psnr_aligned:.2f} | {rot_deg_aligned:.3f} | "
                "{trans_vox_aligned:.3f} | {rpe_px_aligned:.2f} | {splats} | {seconds:.0f} |".format(**row),
                flush=True,
            )
    return found


def fdk_errors(volume: np.ndarray, args: argparse.Namespace, threads: int) -> list[dict[str, float]]:
    """RMS change of FDK by the perturbation at 25, 50, 100, ... views, in units of the true attenuation, no noise:
    all of it, and the part that differs between draws of the perturbation."""
    edge = volume.shape[0]
    grid = VolumeGrid((edge,) * 3, (200.0 / edge,) * 3)
    pixels, most = 2 * edge, args.most_views
    nominal = circular("cone", np.arange(most) * 360 / most, 500, 700, pixels, pixels, (400 / pixels,) * 2)
    right = project(volume, grid, nominal, threads)
    rng = np.random.default_rng(args.seed)
    drawn = [draw_motions(most, args.sigma_rot, args.sigma_trans * 200 / edge, rng) for _ in range(_DRAWS)]
    wrong = [project(volume, grid, motions.correct(nominal), threads) for motions in drawn]
    rows, views = [], most
    while views >= 25:
        some = slice(None, None, most // views)
        clean = fdk(right[some], nominal[some], grid, threads)
        changes = np.stack([fdk(stack[some], nominal[some], grid, threads) - clean for stack in wrong])
        whole = float(np.sqrt((changes.astype(np.float64) ** 2).mean()))
        scatter = float(np.sqrt(changes.var(axis=0, ddof=1, dtype=np.float64).mean()))
        rows.append({"views": views, "error": whole, "scatter": scatter})
        views //= 2
    return rows[::-1]


def exponent(rows: list[dict[str, float]], key: str) -> float:
    """e of `key` ~ N^e, by least squares on logarithms."""
    return float(np.polyfit(np.log([row["views"] for row in rows]), np.log([row[key] for row in rows]), 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes", nargs="+", type=Path)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--splats", type=int, help="at the start; default 50,000")
    parser.add_argument("--views", type=int, default=75)
    parser.add_argument("--most-views", type=int, default=400, help="of the FDK table: 25 times a power of two")
    parser.add_argument("--sigma-rot", type=float, default=0.03, metavar="RAD")
    parser.add_argument("--sigma-trans", type=float, default=1.0, metavar="VOXELS")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bin", type=int, default=1, help="average blocks of the volume's voxels first")
    parser.add_argument("--only", choices=["switches", "fdk"], help="one of the two tables")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="a quarter of the resolution, 1,500 steps, 4,000 splats: shows that it runs, not what a switch brings",
    )
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    args = parser.parse_args()
    if args.quick:
        args.bin, args.steps, args.splats = 4 * args.bin, 1500, 4000
    threads = threads_allowed()
    volumes = {path.stem: reduced(load_volume(path), args.bin) for path in args.volumes}
    document: dict[str, Any] = {}
    if args.only != "fdk":
        print("| scan | variant | PSNR | PSNR aligned | rot (deg) | trans (voxel) | rpe (px) | splats | seconds |")
        print("|---|---|---|---|---|---|---|---|---|")
        document["switches"] = [row for name, volume in volumes.items() for row in runs(volume, name, args, threads)]
    if args.only != "switches":
        print("\n| scan | views | RMS change of FDK | its scatter |\n|---|---|---|---|")
        document["fdk"] = []
        for name, volume in volumes.items():
            rows = fdk_errors(volume, args, threads)
            for row in rows:
                print(f"| {name} | {row['views']} | {row['error']:.5f} | {row['scatter']:.5f} |")
            whole, scatter = exponent(rows, "error"), exponent(rows, "scatter")
            print(f"\n{name}: the whole change goes as N^{whole:.2f}, its scatter as N^{scatter:.2f}\n", flush=True)
            document["fdk"].append({"scan": name, "rows": rows, "exponent": whole, "scatter_exponent": scatter})
    if args.json:
        args.json.write_text(json.dumps(document, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
