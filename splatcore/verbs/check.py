"""`splatct check`: is this scan usable, what is it, and what will it cost?"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from splatcore.errors import OptionsError
from splatcore.options import Options

HELP = "check a scan folder: problems, facts, memory and time"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scan", type=Path, help="folder with scan.json and TIFF files")
    parser.add_argument("--headers-only", action="store_true", help="look at scan.json and TIFF headers, not at pixels")
    parser.add_argument(
        "--options",
        metavar="NAME=VALUE",
        nargs="+",
        help="estimate the cost with these options of reconstruct",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(args: argparse.Namespace) -> int:
    from splatcore.check import answer

    options = None if args.options is None else _options(args.options)  # a wrong one is told before a long look
    status, text = answer(args.scan, pixels=not args.headers_only)
    if status == 0 and options is not None:
        text = json.dumps({**json.loads(text), "estimate": _estimate(json.loads(text)["facts"], options)})
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
    if "estimate" in found:
        cost = found["estimate"]
        memory, disk = cost["memory_bytes"] / 1e9, cost["disk_bytes"] / 1e9
        text = f"{memory:.1f} GB of memory, {cost['seconds']:.0f} s on two cores, {disk:.2f} GB of disk (rough)"
        print(f"{'with options':<15} {text}")
        print("".join(f"{'warning':<15} {text}\n" for text in cost["warnings"]), end="")
    return 0


def _options(pairs: list[str]) -> Options:
    given = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not (name and equals):
            raise OptionsError(f"options: got {pair!r}, expected NAME=VALUE, as in quality=preview")
        try:
            given[name] = json.loads(text)
        except ValueError:
            given[name] = text
    return Options.from_dict(given)


def _estimate(facts: dict[str, Any], options: Options) -> dict[str, Any]:
    from splatcore.estimate import estimate, warnings
    from splatcore.machine import memory_bytes

    found = estimate(facts["views"], facts["rows"], facts["cols"], facts["volume_shape"], options)
    free = shutil.disk_usage(Path.cwd()).free
    return {**found.to_json(), "warnings": warnings(found, memory_free=memory_bytes()[0], disk_free=free)}


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
