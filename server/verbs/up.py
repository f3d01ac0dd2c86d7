"""`splatct up`: everything on this machine with one command: Redis, the server, the workers."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "run the whole service on this machine: queue, server and worker"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, help="the data folder (SPLATCT_DATA, default ./splatct-data)")
    parser.add_argument("--port", type=int, help="port to listen on (SPLATCT_PORT, default 8080)")
    parser.add_argument("--workers", type=int, default=1, help="jobs to run at the same time (default 1)")


def run(args: argparse.Namespace) -> int:
    import logging
    import os

    from server.everything import run_everything
    from server.settings import Settings

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    os.umask(0o077)
    given = {name: getattr(args, name) for name in ("data", "port")}
    settings = Settings.read(given)

    def ready(url: str) -> None:
        print(f"SplatCT is ready: {url}  (Ctrl-C stops it)", flush=True)

    return run_everything(settings, args.workers, bool(os.environ.get("SPLATCT_REDIS_URL")), ready)
