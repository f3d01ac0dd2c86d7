"""`splatct restart JOB`: a new job of a finished one's scan, with other options if asked. With the same ones it goes on
from where a failed or cancelled job was.
"""

from __future__ import annotations

import argparse

from splatct_client.verbs import add_job_options, add_server_option, check_out, connect, job_options

HELP = "run a finished job's scan again, with other options if asked"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("job", metavar="JOB", help="the id of the finished job")
    add_server_option(parser)
    add_job_options(parser)


def run(args: argparse.Namespace) -> int:
    from splatct_client.following import see_through

    check_out(args)
    with connect(args) as client:
        options = job_options(args, client)
        return see_through(args, client, client.restart(args.job, options, args.name, args.priority))
