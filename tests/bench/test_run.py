"""Cells are computed once, resumed, and reported when they fail."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from bench.paper import cells as cells_module
from bench.paper.__main__ import main
from bench.paper.cells import METHODS, Cell, method
from bench.paper.run import Bench
from bench.paper.scans import ScanSpec


def test_a_finished_cell_is_not_computed_again(bench: Bench, tiny: ScanSpec) -> None:
    cell = Cell(tiny, METHODS["FDK"])
    told: list[str] = []
    (first,) = bench.run([cell, cell], told.append)
    assert first.scores is not None and not first.cached and len(told) == 1
    assert first.scores["peak_mib"] > 10 and first.scores["seconds"] > 0
    assert 10 < first.scores["psnr"] < 60 and first.scores["rot_deg"] == pytest.approx(3, abs=1.5)
    kept = bench.work / "cells" / f"{cell.key}.json"
    kept.write_text(json.dumps({**first.scores, "psnr": 1.25}))  # what is there is believed
    (again,) = bench.run([cell])
    assert again.cached and again.scores is not None and again.scores["psnr"] == 1.25
    kept.unlink()
    (anew,) = bench.run([cell])
    assert not anew.cached and anew.scores is not None and anew.scores["psnr"] == first.scores["psnr"]


def test_a_cell_that_fails_says_why_and_is_tried_again(bench: Bench, tiny: ScanSpec) -> None:
    impossible = Cell(tiny, method("bad", "an unknown option", "splats", calibrate="sometimes"))
    for _ in range(2):
        (outcome,) = bench.run([impossible])
        assert outcome.scores is None and not outcome.cached
        assert "calibrate: got 'sometimes'" in outcome.reason
    assert outcome.document()["status"] == "failed"


def test_a_cell_that_takes_too_long_is_ended(bench: Bench, tiny: ScanSpec) -> None:
    (outcome,) = replace(bench, limit_s=0.05).run([Cell(tiny, METHODS["ours"])])
    assert outcome.scores is None and "longer than 0.05 s" in outcome.reason


def test_missing_data_and_missing_rtk_are_reasons(bench: Bench, tiny: ScanSpec) -> None:
    absent = replace(bench, rtk=replace(bench.rtk, python="/nonexistent/python"))
    (no_rtk,) = absent.run([Cell(tiny, METHODS["RTK OSEM, true"])])
    assert re.search(r"no itk-rtk.*--rtk-python", no_rtk.reason)
    (no_data,) = bench.run([Cell(replace(tiny, scene="bonsai"), METHODS["FDK"])])
    assert "bonsai" in no_data.reason and "--data" in no_data.reason


def test_what_needs_our_frames_fails_with_them(bench: Bench, tiny: ScanSpec) -> None:
    scan = replace(tiny, scene="bonsai")
    (outcome,) = bench.run([Cell(scan, METHODS["RTK FDK, ours"])])
    assert outcome.reason.startswith("needs ours, which failed: bonsai")


def test_keys_follow_the_engine_except_where_rtk_works_alone(monkeypatch: pytest.MonkeyPatch, tiny: ScanSpec) -> None:
    labels = ("ours", "FDK", "RTK FDK, ours", "RTK FDK, true")
    before = [Cell(tiny, METHODS[label]).key for label in labels]
    monkeypatch.setattr(cells_module, "engine_digest", lambda: "another")
    after = [Cell(tiny, METHODS[label]).key for label in labels]
    assert [a == b for a, b in zip(before, after, strict=True)] == [False, False, False, True]
    steps = [Cell(tiny, METHODS[label], steps=9).key for label in ("paper", "ours")]
    assert steps[0] != Cell(tiny, METHODS["paper"]).key and steps[1] == Cell(tiny, METHODS["ours"]).key


def test_unknown_names_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for flag in ("--only", "--scenes", "--methods"):
        with pytest.raises(SystemExit) as end:
            main([flag, "nonsense"])
        assert end.value.code == 2 and f"{flag}: got 'nonsense'" in capsys.readouterr().err


def test_rtk_asked_for_and_missing_ends_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--projector", "rtk", "--rtk-python", "/nonexistent/python"]) == 2
    assert "has no itk-rtk" in capsys.readouterr().err


@pytest.mark.slow
def test_a_whole_bench_on_a_tiny_scene(bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From the command line to both files, what fails included; and again from the cache."""
    command = ["--quick", "--only", "headline,right", "--scenes", "teapot", "--edge", "24", "--views", "12",
               "--steps", "60", "--data", str(bench.data), "--work", str(bench.work), "--out", str(tmp_path / "out"),
               "--threads", "1",
               "--methods", "nominal;ours;ceiling;paper;RTK OSEM, true"]  # fmt: skip
    assert main(command) == 0
    results = json.loads((tmp_path / "out/results.json").read_text())
    failed = [cell["cell"] for cell in results["cells"] if cell["status"] == "failed"]
    assert all("RTK" in name for name in failed), failed
    done = {(c["kind"], c["frames"], c["options"].get("calibrate")): c["scores"] for c in results["cells"]
            if c["status"] == "done" and c["scan"]["sigma_rot"] == 0.03}  # fmt: skip
    assert done["splats", "nominal", "full"]["psnr_aligned"] > done["splats", "nominal", "none"]["psnr_aligned"]
    assert 0 <= done["baseline", "nominal", None]["needles"] <= 1
    text = (tmp_path / "out/results.md").read_text()
    for heading in ("## 0.03 rad / 1 voxel", "## Poses that were right", "| nominal |"):
        assert heading in text
    assert "splatct simulate --volume teapot_24.npz" in text
    capsys.readouterr()
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.endswith("[cached]") for line in lines) == len(results["cells"]) - len(failed)
