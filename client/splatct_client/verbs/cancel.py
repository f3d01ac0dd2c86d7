"""`splatct cancel JOB...`: stop queued or running jobs. Cancelling twice does no harm."""

from __future__ import annotations

import argparse

from splatct_client.verbs import add_server_option, connect, print_json

HELP = "stop queued or running jobs"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("job", metavar="JOB", nargs="+", help="the ids of the jobs")
    add_server_option(parser)


def run(args: argparse.Namespace) -> int:
    jobs = []
    with connect(args) as client:
        for job_id in args.job:
            jobs.append(client.cancel(job_id))
            if not args.json:
                print(f"job {jobs[-1].id} is {jobs[-1].state}", flush=True)
    if args.json:
        print_json({"jobs": [job.to_json() for job in jobs]})
    return 0
