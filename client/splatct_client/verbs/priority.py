"""`splatct priority LEVEL JOB...`: another place among one's own waiting jobs."""

from __future__ import annotations

import argparse

from splatct_client.verbs import PRIORITIES, add_server_option, connect, print_json

HELP = "give waiting jobs another place among your own"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("level", metavar="LEVEL", choices=PRIORITIES, help="low, normal or high")
    parser.add_argument("job", metavar="JOB", nargs="+", help="ids of jobs")
    add_server_option(parser)


def run(args: argparse.Namespace) -> int:
    with connect(args) as client:
        jobs = [client.prioritise(job, args.level) for job in args.job]
    if args.json:
        print_json({"jobs": [job.to_json() for job in jobs]})
        return 0
    for job in jobs:
        place = "" if job.queue_position is None else f", number {job.queue_position} in line"
        print(f"job {job.id} has priority {job.priority}{place}")
    return 0
