"""bench/paper as a person runs it: one command, tables with the truth in them, and nothing computed twice."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_one_command_writes_the_tables_and_goes_on_where_it_was(tmp_path: Path) -> None:
    command = [
        sys.executable, "-m", "bench.paper", "--only", "headline", "--edge", "32", "--views", "24", "--scenes", "head",
        "--methods", "nominal;ours;ceiling", "--work", str(tmp_path / "work"), "--out", str(tmp_path / "out"),
    ]  # fmt: skip
    first = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert first.returncode == 0, first.stdout + first.stderr
    text = (tmp_path / "out" / "results.md").read_text(encoding="utf-8")
    assert "| head (own) |" in text and "--only headline" in text and "Visible Human" in text
    json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "work" / "cells").iterdir()}
    assert len([path for path in kept if not path.name.endswith(".poses.json")]) == 3
    again = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert again.returncode == 0, again.stdout + again.stderr
    assert kept == {path: path.stat().st_mtime_ns for path in (tmp_path / "work" / "cells").iterdir()}


def test_an_unknown_scene_or_method_is_named() -> None:
    for option, value in (("--scenes", "unicorn"), ("--methods", "magic")):
        told = subprocess.run(
            [sys.executable, "-m", "bench.paper", "--only", "headline", option, value],
            cwd=ROOT, capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        assert told.returncode != 0
        assert value in told.stdout + told.stderr
        assert "Traceback" not in told.stderr
