"""The server and the worker must start light: neither may load torch, now or by accident later."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def loaded_by(code: str) -> set[str]:
    """Top-level modules in a fresh interpreter after `code`."""
    script = f"{code}\nimport sys\nprint(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "client")])}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=environment, check=True, cwd=ROOT
    )
    return set(done.stdout.split())


@pytest.mark.parametrize(
    ("code", "forbidden"),
    [
        ("import splatcore, splatcore.options, splatcore.errors, splatcore.progress", {"torch", "numpy"}),
        ("import server.app, server.everything, server.checking", {"torch", "scipy"}),
        ("import worker.hand, worker.supervise", {"torch", "numpy", "server"}),
        ("import worker.engine", {"torch", "numpy", "rq", "redis", "sqlalchemy", "server"}),
        ("import worker.contract, worker.jobfolder, worker.journal", {"torch", "numpy", "pydantic", "sqlalchemy"}),
        (
            "import server.verbs.server, server.verbs.up, worker.verbs.worker",
            {"torch", "numpy", "fastapi", "rq", "sqlalchemy", "pydantic"},
        ),
    ],
)
def test_what_a_module_must_not_load(code: str, forbidden: set[str]) -> None:
    assert not loaded_by(code) & forbidden


def test_the_check_sees_what_it_should() -> None:
    assert "numpy" in loaded_by("import numpy")
