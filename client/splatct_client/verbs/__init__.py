"""The client's verbs. Each module is light to import; httpx is loaded when a verb runs."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatct_client.client import Client

DEFAULT_SERVER = "http://127.0.0.1:8080"


def add_server_option(parser: argparse.ArgumentParser) -> None:
    default = os.environ.get("SPLATCT_SERVER") or DEFAULT_SERVER
    help = "the server's address (default: SPLATCT_SERVER, else %(default)s)"
    parser.add_argument("--server", metavar="URL", default=default, help=help)
    help = "a file with the key that opens the server (default: the key itself in SPLATCT_KEY, else none)"
    parser.add_argument("--key-file", metavar="FILE", type=Path, help=help)


def connect(args: argparse.Namespace) -> Client:
    from splatct_client.client import Client
    from splatct_client.credentials import find_key

    return Client(args.server, key=find_key(args.key_file))


def print_json(value: dict[str, Any]) -> None:
    print(json.dumps(value, ensure_ascii=False))
