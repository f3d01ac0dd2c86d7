"""A tenth of bench/faults: real parts, really killed or cut, and nothing lost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.faults import __main__ as faults
from bench.faults.plainrq import SETUPS, WORK_S


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


@pytest.mark.slow
def test_plain_rq_meets_the_same_faults_and_loses_jobs(tmp_path: Path) -> None:
    """If it lost none, the faults would be none, or the comparison would look away."""
    assert faults.main(["--quick", "--only", "rq", "--seed", "3", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "faults.json").read_text())["rq"]
    assert list(found) == [setup.name for setup in SETUPS]
    for setup in found.values():
        assert sum(setup["faults"].values()) == 14, "all but those of the server, which RQ has none of"
        assert setup["struck"] == {"worker": 5, "engine": 5}
        assert setup["lost"] or setup["stuck"], "FLUSHALL takes what waits in a queue"
        assert max(setup["work_s"]) >= WORK_S
    defaults, retried = found["RQ, its defaults"], found["RQ, Retry(max=5), Redis with appendonly"]
    # How soon is left to chance here: a retried job waits behind all others, or is lost before its turn.
    assert not defaults["engine_recovery_s"] and retried["attempts"] > retried["jobs"], "a killed work-horse is retried"
    assert "retries none" in defaults["settings"] and defaults["settings"].endswith("appendonly no")
    assert retried["settings"].endswith("appendonly yes")
    assert "| **lost** |" in (tmp_path / "faults.md").read_text()


@pytest.mark.slow
@pytest.mark.system
def test_a_full_disk_makes_others_wait_and_no_more(tmp_path: Path) -> None:
    assert faults.main(["--quick", "--only", "disk", "--seed", "3", "--out", str(tmp_path)]) == 0
    page = (tmp_path / "faults.md").read_text()
    if "not run" in page:
        pytest.skip(page)
    found = json.loads((tmp_path / "faults.json").read_text())["disk"]
    assert found["wrong"] == [] and found["done"] == {"upload": 2, "checkpoint": 2, "publish": 2, "delete": 6}
