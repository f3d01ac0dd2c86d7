"""`splatct unpin JOB...`: let jobs, or scans, be cleaned away again when their time has come."""

from __future__ import annotations

import argparse

from splatct_client.verbs.pin import change, configure

__all__ = ["HELP", "configure", "run"]

HELP = "let a job or a scan be cleaned away again when its time has come"


def run(args: argparse.Namespace) -> int:
    return change(args, pinned=False)
