"""A job from its submission to its results, as a person at a terminal sees it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from splatct_client.bar import Bar, seconds_text
from splatct_client.errors import JobFailed

if TYPE_CHECKING:
    from splatct_client.client import Client
    from splatct_client.models import Job


def see_through(args: argparse.Namespace, client: Client, job: Job) -> int:
    """Say where the job is; with `--wait` or `-o` stay until it has ended, and fetch what it made."""
    from splatct_client.outfolder import fetch_results
    from splatct_client.verbs import print_json

    tell(args, f"job {job.id} is {job.state}; its page: {client.base_url}/jobs/{job.id}")
    fetched: list[Path] = []
    if args.wait or args.out:
        job = watch(client, job.id)
        if job.state != "succeeded":
            raise JobFailed(end_text(job))
        tell(args, end_text(job))
    if args.out:
        fetched = fetch_results(client, job.id, args.out)
        tell(args, f"results are in {args.out}")
    elif not args.json:
        print(f"fetch the results with `splatct fetch {job.id} -o OUT`")
    if args.json:
        print_json({"job": job.to_json(), "files": [str(path) for path in fetched]})
    return 0


def watch(client: Client, job_id: str) -> Job:
    """Wait for the end with a live bar. Leaving the bar leaves the job alone."""
    try:
        with Bar("job   ") as bar:
            return client.wait(job_id, lambda job: bar.show(job.progress, progress_text(job)))
    except KeyboardInterrupt:
        print(f"the job goes on; see `splatct jobs {job_id}`, stop it with `splatct cancel {job_id}`", file=sys.stderr)
        raise


def progress_text(job: Job) -> str:
    if job.state == "queued":
        return "queued" if job.queue_position is None else f"queued, number {job.queue_position} in line"
    left = f", {seconds_text(job.eta_s)} left" if job.eta_s is not None and not job.finished else ""
    return f"{job.message or job.stage or job.state}{left}"


def end_text(job: Job) -> str:
    text = f"job {job.id} {job.state}"
    return f"{text}: {job.error.message}" if job.error else text


def tell(args: argparse.Namespace, text: str) -> None:
    """For people; with `--json` stdout is for programs."""
    print(text, file=sys.stderr if args.json else sys.stdout, flush=True)
