"""The check's process: its limits hold, and what it says is told apart from its own failures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from server.checking import CheckFailed, check_scan
from splatcore.errors import ScanError

Check = Callable[..., dict[str, Any]]


@pytest.fixture
def check(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Check:
    """Runs `code` as the check."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "scan").mkdir()

    def run(code: str, memory_mib: int = 1024) -> dict[str, Any]:
        (tmp_path / "told.py").write_text(code)
        return check_scan(tmp_path / "scan", "told", memory_mib)

    return run


def test_facts(check: Check, tmp_path: Path) -> None:
    facts = check('import json, sys; print(json.dumps({"facts": {"folder": sys.argv[1]}}))')
    assert facts == {"folder": str(tmp_path / "scan")}


def test_problems(check: Check) -> None:
    with pytest.raises(ScanError) as caught:
        check('import sys; print(\'{"problems": [{"where": "a.tif", "what": "torn"}]}\'); sys.exit(2)')
    assert str(caught.value) == "a.tif: torn"


@pytest.mark.parametrize(
    "code",
    [
        "x = bytearray(2 << 30)",  # more memory than it may have
        "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",  # a decoder that falls over
    ],
)
def test_a_scan_that_breaks_the_check_is_blamed(check: Check, code: str) -> None:
    with pytest.raises(ScanError, match="could not be checked within the limits"):
        check(code)


@pytest.mark.parametrize("code", ["1 / 0", "print('no JSON')", "print('[]')", "print('{}')", "import sys; sys.exit(9)"])
def test_a_broken_check_blames_nobody(check: Check, code: str) -> None:
    with pytest.raises(CheckFailed):
        check(code)


def test_it_can_write_no_file_and_knows_no_secret(
    check: Check, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATCT_REDIS_URL", "redis://:secret@host/0")
    facts = check(
        "import json, os, pathlib, sys\n"
        "target = pathlib.Path(sys.argv[1], 'written')\n"
        "try:\n    target.write_bytes(b'x' * 100)\nexcept OSError:\n    pass\n"
        "size = target.stat().st_size\n"
        "print(json.dumps({'facts': {'size': size, 'names': sorted(os.environ)}}))"
    )
    assert facts["size"] == 0
    assert not [name for name in facts["names"] if name.startswith("SPLATCT")]
