"""A tenth of bench/faults: real parts, really killed, and nothing lost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.faults import __main__ as faults


@pytest.mark.slow
def test_nothing_is_lost_published_twice_or_stuck(tmp_path: Path) -> None:
    assert faults.main(["--quick", "--seed", "3", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "faults.json").read_text())
    assert (found["lost"], found["published_twice"], found["stuck"]) == ([], [], [])
    assert sum(found["faults"].values()) == 16 and found["jobs"] >= 6 and found["resumed"] > 0
    assert found["recovery_s"] and found["recovery_median_s"] <= 10
    assert "**lost** | 0" in (tmp_path / "faults.md").read_text()
