"""A tenth of bench/load: real parts, and figures of the right shape. How fast they are is no test's business: whoever
else works on the machine decides that."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.load import __main__ as load
from bench.load.figures import Figure, quantile
from bench.load.memory import growth


@pytest.mark.parametrize(
    ("share", "expected"), [(0.5, 50), (0.95, 95), (0.99, 99), (1.0, 100)], ids=["median", "p95", "p99", "most"]
)
def test_a_quantile_is_a_value_that_was_measured(share: float, expected: int) -> None:
    assert quantile(list(range(100, 0, -1)), share) == expected


def test_a_target_is_met_missed_or_none() -> None:
    assert Figure("wait", 50.0, "ms", at_most=50).met is True
    assert Figure("wait", 50.1, "ms", at_most=50).met is False
    assert Figure("share", 59.9, "%", at_least=60).met is False
    assert Figure("share", 59.9, "%").met is None
    assert Figure("share", 59.9, "%", at_least=60).row() == "| share (%) | 59.9 | ≥ 60 | **missed** |"


def test_growth_is_told_from_a_warm_up_and_from_noise() -> None:
    jobs = np.arange(10.0, 1001, 10)
    noise = np.random.default_rng(0).normal(0, 1e5, len(jobs))
    slope, error = growth(jobs, 8e7 + np.minimum(jobs, 200) * 1e5 + 3e3 * jobs + noise)
    assert 30 < error < 100
    assert abs(slope - 3e3) < 3 * error


def measured(tmp_path: Path, name: str) -> dict[str, float]:
    assert load.main(["--quick", "--only", name, "--out", str(tmp_path)]) in (0, 1)
    found: dict[str, Any] = json.loads((tmp_path / "load.json").read_text())[name]
    page = (tmp_path / "load.md").read_text()
    assert all(f"| {figure['what']} (" in page for figure in found["figures"])
    assert "Load average before" in page and found["load_before"] >= 0 and found["others_cores"] >= 0
    return {figure["what"]: figure["value"] for figure in found["figures"]}


@pytest.mark.slow
def test_uploads_are_measured_beside_a_sink(tmp_path: Path) -> None:
    told = measured(tmp_path, "uploads")
    for senders in ("one sender", "4 senders"):
        for way in ("PUT", "PATCH"):
            assert told[f"{senders}: {way} of sink"] > 10
            assert told[f"{senders}: {way}"] > 1 and told[f"{senders}: sink + fsync"] > 1


@pytest.mark.slow
def test_status_calls_are_answered_during_uploads_and_a_reconstruction(tmp_path: Path) -> None:
    told = measured(tmp_path, "status")
    assert told.pop("uploads meanwhile") > 0
    assert len(told) == 12 and all(0 < ms < 30_000 for ms in told.values())


@pytest.mark.slow
def test_the_engine_is_there_before_anything_is_heard_of_it(tmp_path: Path) -> None:
    told = measured(tmp_path, "start")
    assert 0 < told["to the engine's process, median"] < told["to the first progress event, longest"] < 60


@pytest.mark.slow
def test_memory_does_not_grow_by_what_a_job_brings(tmp_path: Path) -> None:
    told = measured(tmp_path, "memory")
    assert told["server: after all"] < 400
    assert told["server: growth after that"] < 2e5 and told["workers, mean: growth after that"] < 2e5


@pytest.mark.slow
def test_hostile_scans_are_refused_in_little_memory(tmp_path: Path) -> None:
    told = measured(tmp_path, "hostile")
    assert next(mb for what, mb in told.items() if what.startswith("memory of the check")) < 300
    assert told["processor time of the check, most"] < 1


@pytest.mark.slow
def test_being_watched_costs_more_than_idling(tmp_path: Path) -> None:
    told = measured(tmp_path, "idle")
    assert told["nobody, no job: SQL writes"] < 5
    assert told["50 pages polling, a job at work: SQL reads"] > 10 + told["nobody, no job: SQL reads"]
    assert told["50 pages streaming, a job at work: SQL reads"] < told["50 pages polling, a job at work: SQL reads"]


def test_a_measurement_that_is_none_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        load.main(["--only", "uploads,latency"])
    assert "got latency; expected some of uploads,status,start,memory,hostile,idle" in capsys.readouterr().err
