"""Schemathesis over all that the OpenAPI document describes, with a key and without: no answer is a server error."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from .stack import Stack, commit, scan_files, submit

SECONDS = 45
# Schemathesis asks how to write a body of a kind that is tus' own.
HOOKS = """
import json
import schemathesis

@schemathesis.serializer("application/offset+octet-stream")
def chunk(context, value):
    return value if isinstance(value, bytes) else json.dumps(value, default=str).encode()
"""


def fuzz(stack: Stack, folder: Path, key: str | None) -> str:
    """What it printed. Exit status 0: it found nothing."""
    header = [] if key is None else ["--header", f"Authorization: Bearer {key}"]
    command = [
        sys.executable, "-m", "schemathesis.cli", "run", str(stack.http.base_url.join("/openapi.json")), *header,
        "--checks", "not_a_server_error", "--max-examples", "25", "--max-time", str(SECONDS), "--workers", "2",
        "--phases", "coverage,fuzzing", "--generation-deterministic", "--suppress-health-check", "all", "--warnings",
        "off", "--no-color", "--continue-on-failure", "--request-timeout", "65",
        "--exclude-path-regex", "^/v1/events$|events/stream$",  # streams stay open
    ]  # fmt: skip
    (folder / "hooks.py").write_text(HOOKS)
    environment = {**os.environ, "SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(folder)}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=SECONDS * 8, check=False
    )
    assert done.returncode == 0, done.stdout[-10_000:] + done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("with_key", [True, False])
def test_no_request_makes_the_server_fail(stack: Stack, tmp_path: Path, with_key: bool) -> None:
    stack.environment |= {"SPLATCT_RATE_PER_S": "0", "SPLATCT_FAILURES_PER_MIN": "0"}
    stack.server.kill()
    stack.server.wait()
    server = stack.start_server()
    stack.start_worker()
    key = stack.new_key("first", "admin")[1]
    with stack.client(key) as http:  # something to be found
        submit(http, commit(http, scan_files()))
        stack.until(lambda: http.get("/readyz").status_code == 200, what="a worker is there")
    said = fuzz(stack, tmp_path, key if with_key else None)
    assert "Test cases" in said or "generated" in said, said[-3000:]
    assert server.poll() is None
    log = (tmp_path / "log.txt").read_text(errors="replace")
    assert "Traceback" not in log, log[log.index("Traceback") - 500 :][:5000]
