"""`splatct demo` makes its folder anew, and so must not be pointed at somebody's data."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from server.verbs import demo
from splatcore.errors import ScanError


def test_a_folder_with_other_data_is_left_alone(tmp_path: Path) -> None:
    precious = tmp_path / "results" / "thesis.tif"
    precious.parent.mkdir()
    precious.write_bytes(b"years")
    scan = Path(demo.__file__).resolve().parents[2] / "examples" / "head"
    with pytest.raises(ScanError, match="not an earlier demo"):
        demo.run(argparse.Namespace(scan=scan, out=tmp_path, keep=False))
    assert precious.read_bytes() == b"years"
