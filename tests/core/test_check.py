"""`python -m splatcore.check`, `splatct check` and `splatct doctor`."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatcore import machine
from splatcore.errors import OptionsError
from splatcore.estimate import estimate, warnings
from splatcore.options import Options
from splatcore.verbs import check, doctor

from .scanfolder import plain_images, write_scan


def run(verb: Any, *words: str) -> int:
    parser = argparse.ArgumentParser()
    verb.configure(parser)
    return int(verb.run(parser.parse_args(words)))


def module(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "splatcore.check", *words], capture_output=True, text=True, timeout=60, check=False
    )


def test_good_scan_as_a_process(tmp_path: Path) -> None:
    done = module(str(write_scan(tmp_path)))
    assert (done.returncode, done.stderr) == (0, "")
    facts = json.loads(done.stdout)["facts"]
    assert (facts["views"], facts["volume_shape"], facts["kind"]) == (9, [6, 7, 8], "line_integrals")


def test_bad_scan_as_a_process(tmp_path: Path) -> None:
    folder = write_scan(tmp_path, changes={"/geometry/dso_mm": -1, "/geometry/beam": "x"})
    (folder / "projections.tif").write_bytes((folder / "projections.tif").read_bytes()[:999])
    done = module(str(folder))
    assert (done.returncode, done.stderr) == (2, "")
    problems = json.loads(done.stdout)["problems"]
    assert {problem["where"] for problem in problems} >= {"/geometry/dso_mm", "/geometry/beam"}
    assert all(set(problem) == {"where", "what", "hint"} for problem in problems)


def test_a_cut_file_says_nothing_on_stderr(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    (folder / "projections.tif").write_bytes((folder / "projections.tif").read_bytes()[:999])
    done = module(str(folder))
    assert (done.returncode, done.stderr) == (2, "")


def test_no_folder_given() -> None:
    assert module().returncode == 64


def test_checking_loads_neither_torch_nor_scipy(tmp_path: Path) -> None:
    code = (
        "import sys; from splatcore.scan import check_scan; check_scan(sys.argv[1]); "
        "print([name for name in ('torch', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(write_scan(tmp_path))], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "[]"


def test_verbs_import_lightly() -> None:
    code = "import sys, splatcore.verbs.check, splatcore.verbs.doctor; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "False"


def test_verb_speaks_to_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(check, str(write_scan(tmp_path, 30 * plain_images()))) == 0
    text = capsys.readouterr().out
    assert "9 of 12 rows x 16 columns, float32" in text and "values > 20" in text


def test_verb_lists_problems_on_stderr(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(check, str(write_scan(tmp_path, changes={"/geometry/beem": 1}))) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "/geometry/beem: unknown key" in captured.err


def test_verb_json_and_headers_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = plain_images()
    images[0, 0, 0] = np.nan
    folder = str(write_scan(tmp_path, images))
    assert run(check, folder, "--json") == 2
    assert json.loads(capsys.readouterr().out)["problems"][0]["where"] == "projections.tif, page 1 of 9"
    assert run(check, folder, "--json", "--headers-only") == 0
    assert json.loads(capsys.readouterr().out)["facts"]["line_integral"] is None


def test_doctor(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "memory_bytes", lambda: (8 * 10**9, 16 * 10**9))
    monkeypatch.setattr(doctor, "_native_core", lambda: doctor.Finding("native core", "present", True))
    monkeypatch.setattr(doctor, "_NEEDED", ("numpy", "tifffile"))
    monkeypatch.setattr(doctor, "_LEAST_DISK_GB", 0.0)
    assert run(doctor, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["ok"] and {"python", "numpy", "threads", "memory"} <= {entry["name"] for entry in found["findings"]}
    monkeypatch.setattr(doctor, "_NEEDED", ("numpy", "surely-not-installed"))
    assert run(doctor) == 1
    text = capsys.readouterr().out
    assert "MISSING  surely-not-installed" in text and "pip install surely-not-installed" in text


def test_limits_of_a_container_count(tmp_path: Path) -> None:
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    (tmp_path / "memory.max").write_text("1000000\n")
    (tmp_path / "memory.current").write_text("400000\n")
    assert machine.threads_allowed(tmp_path) == 1
    assert machine.memory_bytes(tmp_path) == (600_000, 1_000_000)
    (tmp_path / "cpu.max").write_text("max 100000\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.threads_allowed(tmp_path) >= 1
    assert machine.memory_bytes(tmp_path)[1] > 1_000_000


def test_options_change_the_estimate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = str(write_scan(tmp_path / "scan"))
    costs = []
    for options in (["quality=preview"], ["quality=fine", "splats=4000000"]):
        assert run(check, scan, "--options", *options, "--json") == 0
        costs.append(json.loads(capsys.readouterr().out)["estimate"])
    assert costs[0]["memory_bytes"] < costs[1]["memory_bytes"] and costs[0]["seconds"] < costs[1]["seconds"]
    assert costs[0]["disk_bytes"] < costs[1]["disk_bytes"]
    assert run(check, scan, "--options", "quality=preview") == 0
    assert "with options" in capsys.readouterr().out


@pytest.mark.parametrize(("pair", "says"), [("quality=best", "best"), ("speed=9", "unknown option"), ("x", "NAME=")])
def test_an_option_that_cannot_be_used_is_told_at_once(tmp_path: Path, pair: str, says: str) -> None:
    with pytest.raises(OptionsError, match=says):
        run(check, str(tmp_path / "no scan here"), "--options", pair)


def test_what_does_not_fit_is_said() -> None:
    found = estimate(75, 256, 256, (128, 128, 128), Options())
    assert warnings(found, memory_free=0, disk_free=0) == []
    assert warnings(found, memory_free=2**40, disk_free=2**40, longest_s=1e6) == []
    said = warnings(found, memory_free=100_000_000, disk_free=1_000_000, longest_s=10.0)
    assert len(said) == 3 and "memory" in said[0] and "disk" in said[1] and "partial result" in said[2]
