"""Are the uncertainties that a reconstruction states right? The share of pose errors within one and two of them.

    python bench/coverage.py SCAN [SCAN ...] [--json FILE]

Reconstructs every simulated scan with --calibrate full, aligns the poses with the truth (gauge.align), and divides
every component of every view's error by its stated standard deviation. Of normal errors with true deviations 68 % lie
within one and 95 % within two; `rms` is the root mean square of the quotient, which should be 1. Columns are the
components of poses.json: rotation and translation about the world's x, y, z.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from splatcore.document import Document
from splatcore.gauge import align, pose_errors
from splatcore.geometry import Array, Frames
from splatcore.options import Options
from splatcore.reconstruct import drain, reconstruct
from splatcore.scan import Scan, read_scan
from splatcore.scangeometry import read_frames

COMPONENTS = ("rx", "ry", "rz", "tx", "ty", "tz")


def true_frames(scan: Scan) -> Frames:
    """The frames of a simulated scan's truth. Raises SystemExit where it carries none."""
    doc, detector = Document(), (scan.frames.rows, scan.frames.cols)
    frames = None
    if scan.simulation is not None:
        frames = read_frames(scan.simulation["frames"], "/simulation/frames", scan.frames.beam, detector, doc)
    if frames is None:
        raise SystemExit(f"{scan.name}: carries no truth; give a scan that `splatct simulate` wrote")
    return frames


def quotients(true: Frames, estimated: Frames, sigma_rotation: Array, sigma_translation: Array) -> Array:
    """Aligned pose errors over their stated standard deviations (rad, mm). [views, 6]"""
    error = pose_errors(true, align(true, estimated)[1]).vectors()
    return np.concatenate([error[0] / sigma_rotation, error[1] / sigma_translation], axis=1)


def coverage(name: str, quotient: Array) -> dict[str, Any]:
    size = np.abs(quotient)
    return {
        "scan": name,
        "views": len(quotient),
        "within_1": dict(zip(COMPONENTS, (size < 1).mean(axis=0).tolist(), strict=True)),
        "within_2": dict(zip(COMPONENTS, (size < 2).mean(axis=0).tolist(), strict=True)),
        "rms": dict(zip(COMPONENTS, np.sqrt((size**2).mean(axis=0)).tolist(), strict=True)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="+", type=Path)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path, help="also write the shares to this file")
    args = parser.parse_args()
    print(f"| scan | share | {' | '.join(COMPONENTS)} | all |\n|---|---|{'---|' * 7}")
    rows, everything = [], []
    for folder in args.scans:
        scan = read_scan(folder)
        result = drain(reconstruct(scan, Options(calibrate="full", threads=args.threads)))
        found = quotients(
            true_frames(scan), result.corrected, np.deg2rad(result.sigma_rotation_deg), result.sigma_translation_mm
        )
        everything.append(found)
        rows.append(coverage(scan.name, found))
        _print(rows[-1])
    if len(everything) > 1:
        rows.append(coverage("all together", np.concatenate(everything)))
        _print(rows[-1])
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def _print(row: dict[str, Any]) -> None:
    for name, key in (("within 1 sigma", "within_1"), ("within 2 sigma", "within_2")):
        shares = [row[key][component] for component in COMPONENTS]
        cells = " | ".join(f"{share:.0%}" for share in [*shares, float(np.mean(shares))])
        print(f"| {row['scan']} | {name} | {cells} |")
    rms = [row["rms"][component] for component in COMPONENTS]
    cells = " | ".join(f"{value:.2f}" for value in [*rms, float(np.sqrt(np.mean(np.square(rms))))])
    print(f"| {row['scan']} | rms | {cells} |", flush=True)


if __name__ == "__main__":
    main()
