"""What README.md and the docs tell people to type exists: verbs and their options, make targets, names, links, keys."""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import re
import shlex
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
import tifffile

from splatcore.scan import check_scan

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "client/README.md", ROOT / "examples/README.md", *sorted(ROOT.glob("docs/**/*.md"))]
VERBS = {entry.name: entry for entry in entry_points(group="splatct.verbs")}


def blocks(page: Path, *languages: str) -> list[str]:
    """The fenced code blocks of a page in these languages, and the indented ones for "sh"."""
    text = page.read_text(encoding="utf-8")
    found = [body for language, body in re.findall(r"^```(\w*)\n(.*?)^```", text, re.M | re.S) if language in languages]
    if "sh" in languages:
        prose = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
        found += ["\n".join(re.findall(r"^ {4}(.*)$", prose, re.M))]
    return found


def commands(page: Path, program: str) -> list[list[str]]:
    """The arguments of every call of a program in a page's code."""
    found = []
    for block in blocks(page, "sh"):
        for line in re.sub(r"\\\n", " ", block).splitlines():
            if re.match(rf"{program}\b", line.strip()):
                found.append(shlex.split(line, comments=True)[1:])
    return found


CALLS = [(page.relative_to(ROOT), call) for page in PAGES for call in commands(page, "splatct")]


def test_the_readme_shows_every_way_to_use_it() -> None:
    shown = {call[0] for page, call in CALLS if str(page) == "README.md"}
    assert {"check", "reconstruct", "evaluate", "simulate", "up", "submit", "jobs", "fetch", "cancel"} <= shown


@pytest.mark.parametrize(("page", "call"), CALLS, ids=lambda value: " ".join(value) if isinstance(value, list) else "")
def test_every_call_parses(page: Path, call: list[str]) -> None:
    verb, *arguments = call
    assert verb in VERBS, f"{page}: no verb {verb}"
    parser = argparse.ArgumentParser(exit_on_error=False)
    VERBS[verb].load().configure(parser)
    if "--json" not in parser.format_usage():
        parser.add_argument("--json", action="store_true")
    parser.parse_args(arguments)


def test_every_make_target_exists() -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M)
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        named = re.findall(r"`make ([a-z-]+)", text) + [call[0] for call in commands(page, "make")]
        assert set(named) <= set(targets), page


def test_every_link_leads_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert "://" in target or (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_python_name_exists() -> None:
    for page in PAGES:
        for block in blocks(page, "python"):
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom) and node.module:
                    module = importlib.import_module(node.module)
                    for alias in node.names:
                        found = getattr(module, alias.name)
                        assert callable(found), f"{page.name}: {node.module}.{alias.name} is {found!r}"


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "docs/conventions.md"], ids=lambda page: page.name)
def test_the_scan_folder_shown_is_valid(page: Path, tmp_path: Path) -> None:
    document = next(d for d in map(json.loads, blocks(page, "json")) if d.get("format") == "splatct-scan/1")
    (tmp_path / "scan.json").write_text(json.dumps(document))
    detector = document["geometry"]["detector"]
    images = np.zeros((len(document["geometry"]["angles_deg"]), detector["rows"], detector["cols"]), np.float32)
    tifffile.imwrite(tmp_path / document["projections"]["files"][0], images, photometric="minisblack")
    check_scan(tmp_path, pixels=False)


@pytest.mark.slow
def test_the_library_example_works_on_the_simulated_cube(tmp_path: Path) -> None:
    """README's cube, its `simulate` and `evaluate` lines and its library example, as a reader would type them."""
    make_cube, use_library = blocks(ROOT / "README.md", "python")
    calls = commands(ROOT / "README.md", "splatct")
    simulate = next(call for call in calls if call[0] == "simulate")

    def python(*arguments: str) -> str:
        done = subprocess.run([sys.executable, *arguments], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    python("-c", make_cube)
    python("-m", "splatct_client", *simulate)
    assert "(64, 64, 64)" in python("-c", use_library)
    scores = json.loads(python("-m", "splatct_client", "evaluate", "library-result", "--truth", "my-scan", "--json"))
    assert scores["rot_deg"] < 0.5 * scores["nominal"]["rot_deg"]
