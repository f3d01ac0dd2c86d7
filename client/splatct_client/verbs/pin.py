"""`splatct pin JOB...`: keep jobs, or scans, from being cleaned away, however old they grow."""

from __future__ import annotations

import argparse

from splatct_client.verbs import add_server_option, connect, print_json

HELP = "keep a job or a scan, however old it grows"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("job", metavar="JOB", nargs="*", help="ids of jobs")
    parser.add_argument("--scan", metavar="SCAN", action="append", default=[], help="the id of a scan; may be repeated")
    add_server_option(parser)


def run(args: argparse.Namespace) -> int:
    return change(args, pinned=True)


def change(args: argparse.Namespace, pinned: bool) -> int:
    from splatct_client.errors import InputError

    if not (args.job or args.scan):
        raise InputError("which? Expected ids of jobs, or --scan SCAN")
    with connect(args) as client:
        jobs = [client.pin(job, pinned) for job in args.job]
        scans = [client.pin_scan(scan, pinned) for scan in args.scan]
    if args.json:
        print_json({"jobs": [job.to_json() for job in jobs], "scans": [scan.to_json() for scan in scans]})
        return 0
    for kind, things in (("job", jobs), ("scan", scans)):
        for thing in things:
            print(f"{kind} {thing.id} is {'pinned' if thing.pinned else 'not pinned'}")
    return 0
