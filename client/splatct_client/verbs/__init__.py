"""The client's verbs. Each module is light to import; httpx is loaded when a verb runs."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatct_client.client import Client

DEFAULT_SERVER = "http://127.0.0.1:8080"
PRIORITIES = ("low", "normal", "high")


def add_server_option(parser: argparse.ArgumentParser) -> None:
    default = os.environ.get("SPLATCT_SERVER") or DEFAULT_SERVER
    help = "the server's address (default: SPLATCT_SERVER, else %(default)s)"
    parser.add_argument("--server", metavar="URL", default=default, help=help)
    help = "a file with the key that opens the server (default: the key itself in SPLATCT_KEY, else none)"
    parser.add_argument("--key-file", metavar="FILE", type=Path, help=help)


def add_option_options(parser: argparse.ArgumentParser) -> None:
    """Of the engine."""
    parser.add_argument("--calibrate", metavar="MODE", help="full, static or none; short for --option calibrate=MODE")
    parser.add_argument(
        "--option", metavar="NAME=VALUE", action="append", default=[], help="an option of the engine; may be repeated"
    )


def add_job_options(parser: argparse.ArgumentParser) -> None:
    """For verbs that make a job."""
    parser.add_argument("--name", help="the job's name (default: the scan's)")
    add_option_options(parser)
    parser.add_argument("--priority", choices=PRIORITIES, help="among your own jobs; default normal")
    parser.add_argument("--wait", action="store_true", help="stay until the job has finished")
    parser.add_argument("-o", "--out", metavar="OUT", type=Path, help="wait, then fetch the results into this folder")
    parser.add_argument("--overwrite", action="store_true", help="let OUT have files in it")


def check_out(args: argparse.Namespace) -> None:
    """Before anything is sent: may results be written where they are asked for?"""
    from splatct_client.outfolder import check_out_folder

    if args.out:
        check_out_folder(args.out, overwrite=args.overwrite)


def job_options(args: argparse.Namespace, client: Client) -> dict[str, Any]:
    """Those given, compared with what the server says it knows."""
    from splatct_client.options import check_options, parse_options

    options = parse_options(args.option, args.calibrate)
    check_options(options, client.options())
    return options


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns as wide as their widest cell; the last one as it comes."""
    lines = [tuple(heads), *map(tuple, rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(heads) - 1)]
    return "\n".join(
        "  ".join([*(cell.ljust(width) for cell, width in zip(line, widths, strict=False)), line[-1]]).rstrip()
        for line in lines
    )


def connect(args: argparse.Namespace) -> Client:
    from splatct_client.client import Client
    from splatct_client.credentials import find_key

    return Client(args.server, key=find_key(args.key_file))


def print_json(value: dict[str, Any]) -> None:
    print(json.dumps(value, ensure_ascii=False))
