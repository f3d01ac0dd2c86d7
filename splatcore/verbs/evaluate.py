"""`splatct evaluate`: scores of a result where the truth is known."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

HELP = "compare a result with the truth of a simulated scan"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("results", type=Path, help="result folder")
    parser.add_argument("--truth", type=Path, required=True, help="the simulated scan's folder")


def run(args: argparse.Namespace) -> int:
    from splatcore.evaluate import evaluate, table

    scores = evaluate(args.results, args.truth)
    print(json.dumps(scores) if args.json else table(scores))
    return 0
