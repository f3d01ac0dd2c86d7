"""`splatct scans`: the scans at the server, newest first."""

from __future__ import annotations

import argparse

from splatct_client.bar import size_text
from splatct_client.verbs import add_server_option, connect, print_json, table

HELP = "list the scans at a server"


def configure(parser: argparse.ArgumentParser) -> None:
    add_server_option(parser)


def run(args: argparse.Namespace) -> int:
    with connect(args) as client:
        scans = client.scans()
    if args.json:
        print_json({"scans": [scan.to_json() for scan in scans]})
    elif scans:
        rows = [
            (s.id, (s.created_at or "")[:19], size_text(s.bytes), "pinned" if s.pinned else "", s.name) for s in scans
        ]
        print(table(("SCAN", "SENT", "SIZE", "", "NAME"), rows))
    else:
        print("no scans yet; `splatct submit SCAN` sends one")
    return 0
