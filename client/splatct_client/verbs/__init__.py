"""The client's verbs. Each module is light to import; httpx is loaded when a verb runs."""

from __future__ import annotations

import argparse
import json
import os
from typing import Any

DEFAULT_SERVER = "http://127.0.0.1:8080"


def add_server_option(parser: argparse.ArgumentParser) -> None:
    default = os.environ.get("SPLATCT_SERVER") or DEFAULT_SERVER
    help = "the server's address (default: SPLATCT_SERVER, else %(default)s)"
    parser.add_argument("--server", metavar="URL", default=default, help=help)


def print_json(value: dict[str, Any]) -> None:
    print(json.dumps(value, ensure_ascii=False))
