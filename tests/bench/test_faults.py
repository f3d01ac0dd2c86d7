"""A tenth of bench/faults: real parts, really killed or cut, and nothing lost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.faults import __main__ as faults


@pytest.mark.slow
def test_nothing_is_lost_published_twice_or_stuck(tmp_path: Path) -> None:
    assert faults.main(["--quick", "--only", "jobs", "--seed", "3", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "faults.json").read_text())
    assert (found["lost"], found["published_twice"], found["stuck"]) == ([], [], [])
    assert sum(found["faults"].values()) == 16 and found["jobs"] >= 6 and found["resumed"] > 0
    assert found["recovery_s"] and found["recovery_median_s"] <= 10
    assert "**lost** | 0" in (tmp_path / "faults.md").read_text()


@pytest.mark.slow
def test_what_is_cut_is_committed_whole_and_hardly_sent_again(tmp_path: Path) -> None:
    assert faults.main(["--only", "uploads", "--uploads", "40", "--seed", "3", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "faults.json").read_text())["uploads"]
    assert (found["corrupt"], found["refused"], found["uploads"]) == ([], [], 40)
    assert set(found["faults"]) == {"client", "server", "overlap", "repeat", "reorder"}
    assert 0 < found["most_chunks_sent_again"] < 1
    assert "**corrupt commits** | 0" in (tmp_path / "faults.md").read_text()
