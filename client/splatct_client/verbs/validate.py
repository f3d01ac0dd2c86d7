"""`splatct validate SCAN`: what a reconstruction would cost on the server. Nothing is run."""

from __future__ import annotations

import argparse

from splatct_client.bar import seconds_text, size_text
from splatct_client.verbs import add_option_options, add_server_option, connect, job_options, print_json

HELP = "what a reconstruction of a scan at the server would cost, without running it"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scan", metavar="SCAN", help="a scan's id; `splatct scans` lists them")
    add_server_option(parser)
    add_option_options(parser)


def run(args: argparse.Namespace) -> int:
    with connect(args) as client:
        estimate = client.validate(args.scan, job_options(args, client))
    if args.json:
        print_json({"estimate": estimate})
        return 0
    free = {name: estimate.get(f"{name}_free_bytes") or 0 for name in ("memory", "disk")}
    for name in ("memory", "disk"):
        beside = f", {size_text(free[name])} free" if free[name] else ""
        print(f"{name:<7} {size_text(estimate[f'{name}_bytes'])}{beside}")
    print(f"{'time':<7} about {seconds_text(estimate['seconds'])}")
    for warning in estimate["warnings"]:
        print(f"warning {warning}")
    return 0
