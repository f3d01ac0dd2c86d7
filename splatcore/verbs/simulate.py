"""`splatct simulate`: a scan of a known volume on a badly calibrated scanner, with its truth."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

HELP = "simulate a scan of a volume, with pose errors and noise"


def configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--volume", type=Path, required=True, help="cube [z,y,x]: .npz (key volume), .npy or .tif; 1.0 is 0.01 /mm")
    add("--out", "-o", type=Path, required=True, help="the scan folder to write")
    add("--views", type=int, default=75)
    add("--det", type=int, help="detector rows = columns; default twice the volume's edge")
    add("--arc-deg", type=float, default=360.0)
    add("--sigma-rot", type=float, default=0.0, metavar="RAD", help="rotation error per axis and view")
    add("--sigma-trans", type=float, default=0.0, metavar="VOXELS", help="translation error per axis and view")
    add("--drift-rot-deg", type=float, default=0.0, metavar="DEG", help="smooth rotation over the scan, RMS")
    add("--drift-trans-vox", type=float, default=0.0, metavar="VOXELS", help="smooth translation over the scan, RMS")
    add("--drift-axes", choices=["camera", "turntable"], default="camera", help="what drifts: a part of the scanner, "
        "or the object on its turntable")  # fmt: skip
    add("--seed", type=int, default=0)
    add("--noise", choices=["none", "r2", "physical"], default="r2")
    add("--i0", type=float, default=1e4, help="photons per pixel in air")
    add("--true-offset-px", type=float, nargs=2, default=[0.0, 0.0], metavar=("U", "V"))
    add("--true-roll-deg", type=float, default=0.0)
    add("--true-tilt-deg", type=float, default=0.0)
    add("--true-yaw-deg", type=float, default=0.0)
    add("--true-axis-pitch-deg", type=float, default=0.0)
    add("--reverse", action="store_true", help="the turntable turns the other way")
    add("--flip-u", action="store_true", help="the images are stored mirrored left to right")
    add("--flip-v", action="store_true", help="the images are stored upside down")
    add("--store", choices=["float32", "uint16"], default="float32", help="uint16: small files, 1/4000 of the maximum")
    add("--threads", type=int)
    add("--overwrite", action="store_true")


def run(args: argparse.Namespace) -> int:
    from splatcore.errors import OptionsError, Problem, ScanError
    from splatcore.machine import threads_allowed
    from splatcore.simulate import Simulation, load_volume, simulate

    if args.threads is not None and not 1 <= args.threads <= 1024:
        raise OptionsError(f"threads: got {args.threads}, expected 1 to 1024")
    if args.out.exists() and not args.out.is_dir():
        raise ScanError([Problem(str(args.out), "is a file, expected a folder", "choose another name")])
    if args.out.exists() and any(args.out.iterdir()) and not args.overwrite:
        raise ScanError([Problem(str(args.out), "is not empty", "choose another folder, or give --overwrite")])
    what = Simulation(
        views=args.views, det=args.det, arc_deg=args.arc_deg, sigma_rot=args.sigma_rot, sigma_trans=args.sigma_trans,
        noise=args.noise, i0=args.i0, seed=args.seed, offset_px=tuple(args.true_offset_px), roll_deg=args.true_roll_deg,
        tilt_deg=args.true_tilt_deg, yaw_deg=args.true_yaw_deg, axis_pitch_deg=args.true_axis_pitch_deg,
        reverse=args.reverse, flip_u=args.flip_u, flip_v=args.flip_v, store=args.store,
        drift_rot_deg=args.drift_rot_deg, drift_trans_vox=args.drift_trans_vox, drift_axes=args.drift_axes,
    )  # fmt: skip
    scan = simulate(load_volume(args.volume), args.out, what, args.threads or threads_allowed(), args.volume.stem)
    detector = scan["geometry"]["detector"]
    facts = {"scan": str(args.out), "views": args.views, "rows": detector["rows"], "cols": detector["cols"]}
    print(json.dumps(facts) if args.json else f"{args.out}: {args.views} views of {facts['rows']} x {facts['cols']}")
    return 0
