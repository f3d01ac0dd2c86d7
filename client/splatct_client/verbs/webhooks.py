"""`splatct webhooks`: addresses that the server tells of the ends of jobs."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from splatct_client.verbs import add_server_option, connect, print_json, table

if TYPE_CHECKING:
    from splatct_client.models import Delivery

HELP = "addresses that are told when jobs end: list, add, remove, deliveries"
EVENTS = ("job.succeeded", "job.failed", "job.cancelled")


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    shown = actions.add_parser("list", help="show all")
    add = actions.add_parser("add", help="tell this address; the secret for its signatures is printed this once")
    add.add_argument("url", metavar="URL", help="such as https://lab.example.org/ct-done")
    add.add_argument("--event", choices=EVENTS, action="append", help="only this; may be repeated (default: all)")
    remove = actions.add_parser("remove", help="tell an address no more")
    deliveries = actions.add_parser("deliveries", help="what an address was told, and how that went")
    for action in (remove, deliveries):
        action.add_argument("id", metavar="ID", help="as `splatct webhooks list` shows it")
    for action in (shown, add, remove, deliveries):
        add_server_option(action)
        help = "print one JSON object on stdout, errors too"
        action.add_argument("--json", action="store_true", default=argparse.SUPPRESS, help=help)


def run(args: argparse.Namespace) -> int:
    with connect(args) as client:
        if args.action == "add":
            made = client.add_webhook(args.url, args.event)
            text = f"webhook {made.id} tells {made.url} of {', '.join(made.events)}"
            text += f"\nsecret, shown this once: {made.secret}"
            _show(args, {"webhook": made.to_json()}, text)
        elif args.action == "list":
            webhooks = client.webhooks()
            rows = [(w.id, " ".join(w.events), w.url) for w in webhooks]
            text = table(("ID", "EVENTS", "URL"), rows) if rows else "no webhooks; `splatct webhooks add URL` makes one"
            _show(args, {"webhooks": [webhook.to_json() for webhook in webhooks]}, text)
        elif args.action == "remove":
            client.remove_webhook(args.id)
            _show(args, {"removed": args.id}, f"webhook {args.id} is removed")
        else:
            found = client.deliveries(args.id)
            told = [_told(delivery) for delivery in found]
            heads = ("MADE", "EVENT", "STATE", "TRIES", "HTTP", "JOB", "ERROR")
            text = table(heads, told) if told else "nothing was to be told yet"
            _show(args, {"deliveries": [delivery.to_json() for delivery in found]}, text)
    return 0


def _told(one: Delivery) -> tuple[str, ...]:
    numbers = str(one.attempts), str(one.status or "-")
    return (one.created_at or "")[:19], one.event, one.state, *numbers, one.job_id, one.error or ""


def _show(args: argparse.Namespace, value: dict[str, object], text: str) -> None:
    print_json(value) if args.json else print(text)
