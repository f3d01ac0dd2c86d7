"""`splatct reconstruct`: the engine on the command line, no server anywhere."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from splatcore.options import add_arguments, from_arguments

HELP = "reconstruct a scan and correct its geometry"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scan", type=Path, help="folder with scan.json and TIFF files")
    parser.add_argument("-o", "--out", type=Path, required=True, help="the result folder to write")
    parser.add_argument("--overwrite", action="store_true", help="write into a folder that is not empty")
    parser.add_argument(
        "--poses", type=Path, help="poses.json of an earlier scan: start from its frames, not scan.json's"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")
    add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    from dataclasses import replace

    from splatcore.posefile import frames_for
    from splatcore.reconstruct import reconstruct
    from splatcore.results import prepare_folder, write_results
    from splatcore.scan import read_scan

    options = from_arguments(args)
    prepare_folder(args.out, args.overwrite)
    scan = read_scan(args.scan)
    if args.poses:
        scan = replace(scan, frames=frames_for(scan.frames, args.poses))
    events = reconstruct(scan, options)
    last = ""
    try:
        while True:
            event = next(events)
            if not args.quiet and event.message != last:
                _show(event.fraction, event.seconds, event.message)
            last = event.message
    except StopIteration as end:
        result = end.value
    if not args.quiet and sys.stderr.isatty():
        print(file=sys.stderr)
    manifest = write_results(result, args.out, overwrite=True)
    if args.json:
        print(json.dumps({"out": str(args.out), "verdict": result.report["verdict"], "timings": manifest["timings"]}))
    else:
        print(result.report["verdict"])
        print(f"{args.out}: volume.tif, poses.json, report.html, splats.npz ({result.timings['total']:.1f} s)")
    return 0


def _show(fraction: float, seconds: float, message: str) -> None:
    """One line that is written over on a terminal, one line an event elsewhere."""
    end = "" if sys.stderr.isatty() else "\n"
    start = "\r\x1b[K" if sys.stderr.isatty() else ""
    print(f"{start}{fraction:4.0%} {seconds:6.1f} s  {message}", end=end, file=sys.stderr, flush=True)
