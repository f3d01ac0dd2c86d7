"""`splatct fetch JOB -o OUT`: the results of a finished job. Asked again after a cut, it goes on where it was."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from splatct_client.errors import InputError, JobFailed
from splatct_client.following import end_text, watch
from splatct_client.verbs import add_server_option, connect, print_json

HELP = "download a job's results, checked against their sha256"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("job", metavar="JOB", help="the job's id")
    add_server_option(parser)
    parser.add_argument("-o", "--out", metavar="OUT", type=Path, required=True, help="the folder for the results")
    parser.add_argument("--only", metavar="FILE", action="append", help="only this result file; may be repeated")
    parser.add_argument(
        "--partial", action="store_true", help="what a job had when it was cancelled or its time was up"
    )
    parser.add_argument("--wait", action="store_true", help="wait for the job to finish first")
    parser.add_argument("--overwrite", action="store_true", help="let OUT have files in it")


def run(args: argparse.Namespace) -> int:
    from splatct_client.outfolder import check_out_folder, fetch_results

    check_out_folder(args.out, overwrite=args.overwrite, job_id=args.job)
    with connect(args) as client:
        job = watch(client, args.job) if args.wait else client.job(args.job)
        if job.state in ("failed", "cancelled") and not args.partial:
            raise JobFailed(end_text(job))
        if not job.finished:
            raise InputError(f"job {job.id} is {job.state} and has no results yet; --wait stays until it has finished")
        paths = fetch_results(client, job.id, args.out, args.only, "partial" if args.partial else "results")
    print(f"results are in {args.out}", file=sys.stderr if args.json else sys.stdout)
    if args.json:
        print_json({"job": job.to_json(), "files": [str(path) for path in paths]})
    return 0
