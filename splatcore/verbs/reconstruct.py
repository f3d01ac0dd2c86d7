"""`splatct reconstruct`: the engine on the command line, no server anywhere."""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from splatcore.options import add_arguments, from_arguments

if TYPE_CHECKING:  # --help must not wait for numpy
    from splatcore.keeper import Keeper

HELP = "reconstruct a scan and correct its geometry"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scan", type=Path, help="folder with scan.json and TIFF files")
    parser.add_argument("-o", "--out", type=Path, required=True, help="the result folder to write")
    parser.add_argument("--overwrite", action="store_true", help="write into a folder that is not empty")
    parser.add_argument(
        "--poses", type=Path, help="poses.json of an earlier scan: start from its frames, not scan.json's"
    )
    parser.add_argument(
        "--checkpoint-dir", type=Path, help="where the run's state is kept, from which it goes on after an "
        "interruption; default: the result folder"
    )  # fmt: skip
    parser.add_argument(
        "--checkpoint-s", type=float, default=None, metavar="SECONDS",
        help="at least so long between two writings of the state; default 10; 0: keep none",
    )  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="no progress")
    add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    from dataclasses import replace

    from splatcore.errors import OptionsError
    from splatcore.keeper import EVERY_S, FILE, Keeper
    from splatcore.posefile import frames_for
    from splatcore.reconstruct import reconstruct
    from splatcore.results import prepare_folder, write_results
    from splatcore.scan import read_scan

    options = from_arguments(args)
    every_s = EVERY_S if args.checkpoint_s is None else args.checkpoint_s
    if not 0 <= every_s < math.inf:
        raise OptionsError(f"checkpoint-s: got {every_s}, expected seconds, or 0 to keep no state")
    prepare_folder(args.out, args.overwrite)
    folder = args.checkpoint_dir or args.out
    folder.mkdir(parents=True, exist_ok=True)
    keeper = Keeper(folder / FILE if every_s else None, every_s)
    scan = read_scan(args.scan)
    if args.poses:
        scan = replace(scan, frames=frames_for(scan.frames, args.poses))
    events = reconstruct(scan, options, keeper)
    last = ""
    with _stopping(keeper):
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
    keeper.forget()
    if args.json:
        print(json.dumps({"out": str(args.out), "verdict": result.report["verdict"], "timings": manifest["timings"]}))
    else:
        print(result.report["verdict"])
        print(f"{args.out}: volume.tif, poses.json, report.html, splats.npz ({result.timings['total']:.1f} s)")
    return 0


@contextmanager
def _stopping(keeper: Keeper) -> Iterator[None]:
    """Inside, the first Ctrl-C or SIGTERM lets the run keep its state; the second ends it at once."""
    from splatcore.keeper import Wish

    def stop(_signal: int, _frame: FrameType | None) -> None:
        if keeper.wish is Wish.STOP:
            raise KeyboardInterrupt
        keeper.wish = Wish.STOP
        how = "; the same command will go on from here" if keeper.file else ""
        print(f"\nstopping{how} (once more: at once)", file=sys.stderr, flush=True)

    before = {which: signal.signal(which, stop) for which in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for which, handler in before.items():
            signal.signal(which, handler)


def _show(fraction: float, seconds: float, message: str) -> None:
    """One line that is written over on a terminal, one line an event elsewhere."""
    end = "" if sys.stderr.isatty() else "\n"
    start = "\r\x1b[K" if sys.stderr.isatty() else ""
    print(f"{start}{fraction:4.0%} {seconds:6.1f} s  {message}", end=end, file=sys.stderr, flush=True)
