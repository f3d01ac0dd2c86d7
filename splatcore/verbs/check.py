"""`splatct check`: is this scan usable, what is it, and what will it cost?"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

HELP = "check a scan folder: problems, facts, memory and time"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scan", type=Path, help="folder with scan.json and TIFF files")
    parser.add_argument("--headers-only", action="store_true", help="look at scan.json and TIFF headers, not at pixels")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(args: argparse.Namespace) -> int:
    from splatcore.check import answer

    status, text = answer(args.scan, pixels=not args.headers_only)
    if args.json:
        print(text)
        return status
    found = json.loads(text)
    if status:
        problems = found["problems"]
        print(f"{args.scan}: {len(problems)} problem{'s' if len(problems) > 1 else ''}", file=sys.stderr)
        for problem in problems:
            print(f"  {problem['where'] or 'scan'}: {problem['what']}", file=sys.stderr)
            if problem["hint"]:
                print(f"      {problem['hint']}", file=sys.stderr)
        return status
    print("\n".join(_lines(found["facts"])))
    return 0


def _lines(facts: dict[str, Any]) -> list[str]:
    """The facts as a person reads them."""

    def times(numbers: list[float]) -> str:
        return " x ".join(f"{n:g}" for n in numbers)

    derived = " (derived from the field of view)" if facts["volume_derived"] else ""
    frames = ", frames given view by view" if facts["by_frames"] else ""
    rows = [
        ("scan", facts["name"]),
        ("views", f"{facts['views']} of {facts['rows']} rows x {facts['cols']} columns, {facts['dtype']}"),
        ("kind", f"{facts['kind']}, {facts['beam']} beam{frames}"),
        ("arc", f"{facts['arc_deg']:.1f} degrees, largest step {facts['max_gap_deg']:.2f}"),
        ("volume", f"{times(facts['volume_shape'])} voxels of {times(facts['voxel_mm'])} mm [z, y, x]{derived}"),
        ("files", f"{facts['bytes'] / 1e6:.1f} MB"),
    ]
    values = facts["line_integral"]
    if values is not None:
        air = "" if facts["air_level"] is None else f", {facts['air_level']:.4g} at the border"
        rows.append(("line integrals", f"{values['min']:.4g} to {values['max']:.4g}{air}"))
    if facts["bad_pixels"]:
        rows.append(("bad pixels", f"{facts['bad_pixels']} per view"))
    memory, seconds = facts["estimated_memory_bytes"] / 1e9, facts["estimated_seconds"]
    rows.append(("estimate", f"{memory:.1f} GB of memory, {seconds:.0f} s on two cores (rough)"))
    lines = [f"{label:<15} {value}" for label, value in rows]
    return lines + [f"{'warning':<15} {text}" for text in facts["warnings"]]
