"""What the distributions promise: verbs that load, one version, pinned packages, every data file in the wheel."""

from __future__ import annotations

import ast
import re
import tomllib
from fnmatch import fnmatch
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
MAIN: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
CLIENT: dict[str, Any] = tomllib.loads((ROOT / "client/pyproject.toml").read_text())
VERBS = {
    name: module
    for project in (MAIN, CLIENT)
    for name, module in project["project"]["entry-points"]["splatct.verbs"].items()
}


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    given = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): pinned for name, pinned in given}


def test_the_installed_verbs_are_those_of_the_projects() -> None:
    assert {entry.name: entry.value for entry in entry_points(group="splatct.verbs")} == VERBS


@pytest.mark.parametrize("entry", entry_points(group="splatct.verbs"), ids=lambda entry: entry.name)
def test_every_verb_loads_and_says_what_it_does(entry: Any) -> None:
    verb = entry.load()
    assert verb.HELP and callable(verb.configure) and callable(verb.run)


def test_one_version_everywhere() -> None:
    import splatct_client

    import splatcore

    declared = MAIN["project"]["version"]
    assert CLIENT["project"]["version"] == declared
    assert version("splatct") == version("splatct-client") == declared
    assert splatcore.__version__ == splatct_client.__version__ == declared
    assert f"## [{declared}]" in (ROOT / "CHANGELOG.md").read_text()


def test_the_public_names_of_the_engine_are_what_they_say() -> None:
    """`from splatcore import name` gives the thing, never the module of that name, whatever was imported before."""
    import splatcore

    for file in (ROOT / "splatcore").glob("*.py"):
        assert file.stem not in splatcore.__all__, file.stem
    assert all(callable(getattr(splatcore, name)) for name in splatcore.__all__ if name != "__version__")


def test_every_data_file_of_the_packages_is_in_the_wheel() -> None:
    """The wheel takes whole folders; nothing in .gitignore or the build's excludes may hide a file of theirs."""
    packages = MAIN["tool"]["scikit-build"]["wheel"]["packages"]
    data = [
        path
        for package in packages
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix not in (".py", ".pyc", ".so")
    ]
    names = {path.name for path in data}
    assert {"page.css", "base.html", "api.js", "favicon.svg", "report.css", "py.typed"} <= names
    ignored = [line.rstrip("/") for line in (ROOT / ".gitignore").read_text().splitlines() if line]
    for path in data:
        for part in path.relative_to(ROOT).parts:
            assert not any(fnmatch(part, pattern) for pattern in ignored), path


def test_every_import_of_the_packages_is_declared() -> None:
    """A third-party module imported by what we ship is among the dependencies that we declare."""
    import sys

    own = {"server", "worker", "splatcore", "splatct_client"}
    distribution = {
        "PIL": "pillow",
        "pydantic_settings": "pydantic-settings",
        "starlette": "fastapi",
        "anyio": "fastapi",
    }
    for project, folders in ((MAIN, ["server", "worker", "splatcore"]), (CLIENT, ["client/splatct_client"])):
        declared = {canonicalize_name(Requirement(d).name) for d in project["project"]["dependencies"]}
        for file in (file for folder in folders for file in (ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                found = [a.name for a in node.names] if isinstance(node, ast.Import) else []
                found += [node.module or ""] if isinstance(node, ast.ImportFrom) and node.level == 0 else []
                for name in {full.partition(".")[0] for full in found} - own - set(sys.stdlib_module_names):
                    assert canonicalize_name(distribution.get(name, name)) in declared, f"{file}: {name}"


def test_all_requirements_are_pinned_and_the_pins_satisfy_them() -> None:
    pinned = pins()
    requirements = [*MAIN["project"]["dependencies"], *CLIENT["project"]["dependencies"]]
    requirements += MAIN["project"]["optional-dependencies"]["dev"]
    requirements += MAIN["build-system"]["requires"] + CLIENT["build-system"]["requires"]
    for text in requirements:
        needed = Requirement(text)
        if needed.name == "splatct-client":
            continue
        assert needed.specifier.contains(pinned[canonicalize_name(needed.name)]), text
    assert pinned["torch"] == "2.13.0"


def test_the_build_tools_of_make_and_docker_are_pinned_and_alike() -> None:
    made = re.search(r"^BUILD_TOOLS := (.*)$", (ROOT / "Makefile").read_text(), re.M)
    assert made is not None
    tools = set(made[1].split())
    assert tools <= set(pins())
    dockerfile = (ROOT / "docker/Dockerfile").read_text()
    assert all(tool in dockerfile for tool in tools - {"editables"})
