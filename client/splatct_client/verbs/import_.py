"""`splatct import FOLDER`: take a scan from the server's own disks, and queue its reconstruction."""

from __future__ import annotations

import argparse

from splatct_client.verbs import add_job_options, add_server_option, check_out, connect, job_options

HELP = "take a scan that lies on the server's own disks, and queue its reconstruction"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "folder", metavar="FOLDER", help="as the server knows it: scanner3/monday; who runs it says which there are"
    )
    add_server_option(parser)
    add_job_options(parser)


def run(args: argparse.Namespace) -> int:
    from splatct_client.following import see_through
    from splatct_client.sending import commit, given_up_if_refused

    check_out(args)
    with connect(args) as client:
        options = job_options(args, client)
        upload = client.import_scan(args.folder)
        with given_up_if_refused(client, upload.id, None):
            scan_id = commit(client, upload.id)
        return see_through(args, client, client.submit(scan_id, options, args.name, args.priority))
