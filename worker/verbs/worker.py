"""`splatct worker`: takes jobs from the queue and runs them, one at a time."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "run jobs from the queue, one at a time"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, help="the data folder shared with the server (SPLATCT_DATA)")
    parser.add_argument("--tie-to", type=int, metavar="PID", help=argparse.SUPPRESS)  # for `splatct up`


def run(args: argparse.Namespace) -> int:
    import logging
    import os
    import signal

    import worker.supervise  # noqa: F401 (here once, or every job's forked child would import it anew)
    from worker.hand import WorkLoop
    from worker.lifeline import die_with_parent
    from worker.settings import WorkerSettings

    if args.tie_to is not None:
        die_with_parent(args.tie_to, signal.SIGTERM)
    settings = WorkerSettings.read({"data": args.data})
    os.environ.update(settings.to_environment())  # the forked child reads its settings anew
    os.umask(0o077)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    logging.getLogger("splatct.worker").info("worker ready, data in %s", settings.data)
    WorkLoop(settings.redis_url).run()
    return 0
