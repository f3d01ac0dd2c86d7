"""How near calibration comes to knowing the poses: one scan with its truth, three reconstructions, one table.

    python bench/ceiling.py SCAN [SCAN ...] [--json FILE]

`nominal` trusts scan.json, `calibrated` is --calibrate full, `true poses` is the ceiling: the same options with
the true frames in place of the nominal ones. Each runs in this process, one after the other.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench.peak import peak_mib
from splatcore.document import Document
from splatcore.evaluate import evaluate
from splatcore.machine import threads_allowed
from splatcore.options import Options
from splatcore.reconstruct import drain, reconstruct
from splatcore.results import write_results
from splatcore.scan import Scan, read_scan
from splatcore.scangeometry import read_frames


def with_true_frames(scan: Scan) -> Scan:
    """The scan as if its scanner had been calibrated perfectly."""
    if scan.simulation is None:
        raise SystemExit(f"{scan.name}: carries no truth; give a scan that `splatct simulate` wrote")
    doc, detector = Document(), (scan.frames.rows, scan.frames.cols)
    frames = read_frames(scan.simulation["frames"], "/simulation/frames", scan.frames.beam, detector, doc)
    if frames is None:
        raise SystemExit(f"{scan.name}: {doc.problems[0]}")
    return replace(scan, frames=frames)


def scores(scan: Scan, calibrate: str, folder: Path) -> dict[str, Any]:
    result = drain(reconstruct(scan, Options.from_dict({"calibrate": calibrate})))
    with tempfile.TemporaryDirectory() as out:
        write_results(result, out)
        return evaluate(out, folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="+", type=Path)
    parser.add_argument("--json", type=Path, help="also write the scores to this file")
    args = parser.parse_args()
    print(f"{threads_allowed()} threads\n")
    print(
        "| scan | geometry | PSNR raw | PSNR aligned | SSIM aligned | rot (deg) | trans (voxel) | rpe (px) | seconds |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    rows: list[dict[str, Any]] = []
    for folder in args.scans:
        scan = read_scan(folder)
        for label, given, calibrate in (
            ("nominal", scan, "none"),
            ("calibrated", scan, "full"),
            ("true poses", with_true_frames(scan), "none"),
        ):
            found = scores(given, calibrate, folder)
            rows.append({"scan": scan.name, "geometry": label, **found})
            aligned = [found[f"{name}_aligned"] for name in ("psnr", "ssim", "rot_deg", "trans_vox", "rpe_px")]
            print(
                "| {} | {} | {:.2f} | {:.2f} | {:.4f} | {:.3f} | {:.3f} | {:.3f} | {:.0f} |".format(
                    scan.name, label, found["psnr"], *aligned, found["seconds"]
                ),
                flush=True,
            )
    print(f"\npeak memory {peak_mib():.0f} MiB")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
