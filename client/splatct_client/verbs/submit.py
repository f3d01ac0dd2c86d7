"""`splatct submit SCAN`: upload a scan, queue its reconstruction, and if asked wait for the results. Started again
after it was cut off it goes on where it was.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from splatct_client.scanfolder import read_scan_folder
from splatct_client.verbs import add_job_options, add_server_option, check_out, connect, job_options

HELP = "upload a scan folder to a server and queue its reconstruction"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scan", metavar="SCAN", type=Path, help="a scan folder: scan.json and the files it names")
    add_server_option(parser)
    add_job_options(parser)


def run(args: argparse.Namespace) -> int:
    from splatct_client.following import see_through
    from splatct_client.journal import Journal
    from splatct_client.sending import send, submit_once

    scan = read_scan_folder(args.scan)
    check_out(args)
    with connect(args) as client:
        options = job_options(args, client)  # before a long upload, not after it
        journal = Journal(client.base_url, args.scan)
        scan_id = send(client, scan, journal)
        return see_through(args, client, submit_once(client, journal, scan_id, options, args.name, args.priority))
