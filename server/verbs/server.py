"""`splatct server`: the HTTP service alone; workers and Redis run elsewhere."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "run the HTTP service (workers are started separately)"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, help="the data folder (SPLATCT_DATA, default ./splatct-data)")
    parser.add_argument(
        "--host", help="address to listen on (SPLATCT_HOST, default 127.0.0.1); beyond loopback only with keys"
    )
    parser.add_argument("--port", type=int, help="port to listen on (SPLATCT_PORT, default 8080)")
    parser.add_argument("--tie-to", type=int, metavar="PID", help=argparse.SUPPRESS)  # for `splatct up`


def run(args: argparse.Namespace) -> int:
    import logging
    import os
    import signal
    from types import FrameType

    import uvicorn

    from server import logs
    from server.app import create_app
    from server.heap import share_one_heap
    from server.opening import make_ready
    from server.settings import Settings
    from server.wire import uvicorn_config
    from worker.lifeline import die_with_parent

    if args.tie_to is not None:
        die_with_parent(args.tie_to, signal.SIGTERM)
    share_one_heap()
    given = {name: getattr(args, name) for name in ("data", "host", "port")}
    settings = Settings.read(given)
    os.umask(0o077)
    logs.configure(settings.log_format)
    make_ready(settings)
    logging.getLogger("splatct.server").info("http://%s:%d, data in %s", settings.host, settings.port, settings.data)
    app = create_app(settings)

    class Server(uvicorn.Server):
        """Sends away those who wait for news before it waits for open requests to end."""

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            service = getattr(app.state, "service", None)  # none while it still starts
            if service is not None:
                service.watch.close()
            super().handle_exit(sig, frame)

    config = uvicorn_config(app, settings.host, settings.port, forwarded_allow_ips=settings.trusted_proxies)
    server = Server(config)
    server.run()
    return 0 if server.started else 3
