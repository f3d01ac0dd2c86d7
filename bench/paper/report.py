"""results.md and results.json: the tables, the scenes, the machine, and how to get there again."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import splatcore
from bench.paper import tables
from bench.paper.keys import engine_digest
from bench.paper.plan import Extent
from bench.paper.run import Bench, Outcome
from bench.paper.scenes import SCENES, find_volume


def facts(bench: Bench, command: str) -> dict[str, Any]:
    """What a reader needs to judge seconds and to repeat the run."""
    versions = {name: metadata.version(name) for name in ("numpy", "scipy")} | {"splatct": splatcore.__version__}
    return {
        "command": command, "date": datetime.now(UTC).isoformat(timespec="seconds"), "processor": _processor(),
        "threads": bench.threads, "platform": platform.platform(), "python": platform.python_version(),
        "versions": versions, "engine": engine_digest(),
    }  # fmt: skip


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def write(
    out: Path, bench: Bench, extent: Extent, found: Mapping[str, list[Outcome]], command: str
) -> tuple[Path, Path]:  # fmt: skip
    """Both files, for the outcomes of each preset. Returns (results.md, results.json)."""
    out.mkdir(parents=True, exist_ok=True)
    about = facts(bench, command)
    unique = {o.cell.key: o for outcomes in found.values() for o in outcomes}
    document = {
        "format": "splatct-bench/1", **about, "scenes": _scenes(bench, extent),
        "tables": {name: [o.cell.key for o in outcomes] for name, outcomes in found.items()},
        "cells": [outcome.document() for outcome in unique.values()],
    }  # fmt: skip
    as_json, as_text = out / "results.json", out / "results.md"
    as_json.write_text(json.dumps(document, indent=1, default=float) + "\n", encoding="utf-8")
    as_text.write_text(_markdown(bench, extent, found, about), encoding="utf-8")
    return as_text, as_json


def _scenes(bench: Bench, extent: Extent) -> list[dict[str, Any]]:
    rows = []
    for name in extent.scenes:
        scene = SCENES[name]
        try:
            file = find_volume(scene, extent.edge, bench.data).name
        except FileNotFoundError as error:
            file = str(error)
        rows.append({"scene": name, "object": scene.what, "origin": scene.origin, "licence": scene.licence,
                     "the paper's own data set": scene.in_paper, "file": file})  # fmt: skip
    return rows


def _markdown(bench: Bench, extent: Extent, found: Mapping[str, list[Outcome]], about: dict[str, Any]) -> str:
    parts = ["# SplatCT beside the paper and others", ""]
    parts += [f"`{about['command']}`", "", f"{about['date']}, {about['processor']}, {about['threads']} threads, Python "
              f"{about['python']}, SplatCT {about['versions']['splatct']} (engine {about['engine']})", ""]  # fmt: skip
    scenes = _scenes(bench, extent)
    parts += ["## Scenes", "", tables.table(list(scenes[0]), [[_plain(v) for v in row.values()] for row in scenes]), ""]
    for name, outcomes in found.items():
        for title, make in tables.TABLES[name]:
            parts += [f"## {title}", "", make(tables.Found(outcomes)), ""]
    everything = tables.Found({o.cell.key: o for outcomes in found.values() for o in outcomes}.values())
    parts += [
        "## Cells that failed",
        "",
        tables.failures(everything),
        "",
        "## Commands",
        "",
        _commands(bench, everything),
    ]
    return "\n".join(parts) + "\n"


def _plain(value: Any) -> str:
    return {True: "yes", False: "no"}.get(value, str(value)) if isinstance(value, bool) else str(value)


def _commands(bench: Bench, found: tables.Found) -> str:
    """One scan and one result by hand, for each scan; scans by RTK's projector are made by the bench alone."""
    lines = []
    for scan in found.scans():
        if scan.projector != "own":
            continue
        try:
            volume = find_volume(SCENES[scan.scene], scan.edge, bench.data)
        except FileNotFoundError:
            continue
        if volume.stem != f"{SCENES[scan.scene].stem}_{scan.edge}" or scan.to_full_range:
            continue  # decimated or rescaled on the way: no single command makes it
        lines.append(scan.command(volume, f"scans/{scan.scene}-{scan.key}"))
    after = "splatct reconstruct SCAN -o OUT [--calibrate none|static|full]\nsplatct evaluate OUT --truth SCAN"
    return "```\n" + "\n".join([*lines, after]) + "\n```"
