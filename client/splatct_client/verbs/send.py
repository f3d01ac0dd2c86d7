"""`splatct send FOLDER`: upload a scan while the scanner still writes it, then queue its reconstruction."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from splatct_client.verbs import add_job_options, add_server_option, check_out, connect, job_options

HELP = "upload views as a scanner writes them, and queue the reconstruction when the scan is whole"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "folder",
        metavar="FOLDER",
        type=Path,
        help="where the scanner writes; whole once scan.json and all it names are",
    )
    add_server_option(parser)
    add_job_options(parser)
    parser.add_argument(
        "--settle", metavar="S", type=_seconds, default=2.0,
        help="seconds that a file must stand still to count as written (default: %(default)g)",
    )  # fmt: skip
    parser.add_argument("--idle", metavar="S", type=_seconds, help="give up after so many seconds without a new file")


def run(args: argparse.Namespace) -> int:
    from splatct_client.following import see_through
    from splatct_client.growing import GrowingScan, send_growing
    from splatct_client.journal import Journal
    from splatct_client.sending import submit_once

    scan = GrowingScan(args.folder, args.settle, lambda text: print(text, file=sys.stderr, flush=True))
    check_out(args)
    with connect(args) as client:
        options = job_options(args, client)
        journal = Journal(client.base_url, args.folder)
        scan_id = send_growing(client, scan, args.name or args.folder.resolve().name, journal, args.idle)
        return see_through(args, client, submit_once(client, journal, scan_id, options, args.name, args.priority))


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds < 1e6:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number of seconds from 0 up")
    return seconds
