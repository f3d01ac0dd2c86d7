"""`splatct jobs`: a table of the newest jobs; `splatct jobs JOB`: everything about one."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from splatct_client.bar import seconds_text
from splatct_client.verbs import add_server_option, connect, print_json, table

if TYPE_CHECKING:
    from splatct_client.models import Job

HELP = "list a server's jobs, or show one"
STATES = ("queued", "running", "cancelling", "succeeded", "failed", "cancelled")
LARGEST_LIST = 1000


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("job", metavar="JOB", nargs="?", help="a job's id; without it, a table of all")
    add_server_option(parser)
    parser.add_argument("--state", choices=STATES, help="only jobs in this state")
    parser.add_argument("--limit", metavar="N", type=_count, default=20, help="at most N jobs (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    with connect(args) as client:
        if args.job:
            job = client.job(args.job)
            print_json({"job": job.to_json()}) if args.json else print(_card(job))
            return 0
        jobs = client.jobs(state=args.state, limit=args.limit)
    if args.json:
        print_json({"jobs": [job.to_json() for job in jobs]})
    elif jobs:
        print(_table(jobs))
    else:
        print("no jobs yet; `splatct submit SCAN` sends one" if not args.state else f"no {args.state} jobs")
    return 0


def _count(text: str) -> int:
    if not (text.isdecimal() and 1 <= int(text) <= LARGEST_LIST):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number from 1 to {LARGEST_LIST}")
    return int(text)


def _table(jobs: list[Job]) -> str:
    rows = [(j.id, j.state, f"{j.progress:.0%}", (j.created_at or "")[:19], j.name or j.scan_name) for j in jobs]
    return table(("JOB", "STATE", "DONE", "CREATED", "NAME"), rows)


def _card(job: Job) -> str:
    place = None if job.queue_position is None else f"number {job.queue_position} in line"
    facts = {
        "job": job.id,
        "name": job.name,
        "scan": f"{job.scan_name} ({job.scan_id})",
        "state": f"{job.state}, {place}" if place else job.state,
        "progress": f"{job.progress:.0%}",
        "doing": job.message,
        "left": None if job.eta_s is None else seconds_text(job.eta_s),
        "attempt": str(job.attempt) if job.attempt > 1 else None,
        "priority": job.priority if job.priority != "normal" else None,
        "restarts": job.restart_of,
        "pinned": "yes" if job.pinned else None,
        "options": json.dumps(job.options, ensure_ascii=False),
        "created": job.created_at,
        "started": job.started_at,
        "finished": job.finished_at,
        "error": job.error.message if job.error else None,
    }
    return "\n".join(f"{label:<9} {text}" for label, text in facts.items() if text)
