"""`splatct export`: corrected poses for other toolkits."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

HELP = "write a result's corrected poses as another toolkit's geometry"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("results", type=Path, help="result folder, or a poses.json")
    parser.add_argument("--as", dest="toolkit", choices=["rtk", "astra"], required=True,
                        help="rtk: geometry XML; astra: vectors [views, 12] as .npy")  # fmt: skip
    parser.add_argument("-o", "--out", type=Path, required=True, help="file to write; must not exist")


def run(args: argparse.Namespace) -> int:
    import numpy as np

    from splatcore.durable import renamed
    from splatcore.errors import ExportError
    from splatcore.export import astra_vectors, rtk_geometry, upside_down
    from splatcore.posefile import read_poses

    frames = read_poses(args.results / "poses.json" if args.results.is_dir() else args.results)[1]
    if args.out.exists():
        raise ExportError(f"{args.out}: exists already; name another file, or remove it")
    try:
        if args.toolkit == "rtk":
            text, flipped = rtk_geometry(frames), upside_down(frames)
            note = "RTK's axes x, y, z are ours y, z, x: a volume [z, y, x] is its [x, z, y]; "
            note += "turn every projection upside down (flip rows)" if flipped else "projections as they are"
            with renamed(args.out) as file:
                file.write(text.encode())
            said: dict[str, str | bool] = {"flip_rows": flipped}
        else:
            kind = "cone_vec" if frames.beam == "cone" else "parallel3d_vec"
            note = f"astra.create_proj_geom('{kind}', {frames.rows}, {frames.cols}, vectors)"
            with renamed(args.out) as file:
                np.save(file, astra_vectors(frames))
            said = {"geometry": kind}
    except OSError as error:
        raise ExportError(f"{args.out}: cannot be written: {error.strerror or error}") from error
    if args.json:
        print(json.dumps({"file": str(args.out), "views": len(frames), **said}))
    else:
        print(f"{args.out}: {len(frames)} views. {note}")
    return 0
