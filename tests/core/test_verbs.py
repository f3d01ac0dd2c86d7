"""The engine's verbs as a user types them, on a small scan."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatcore.errors import ScanError
from splatcore.posefile import frames_for
from splatcore.scan import read_scan

from .phantom import phantom


def splatct(*arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "splatct_client", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stderr
    return done


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("verbs")
    np.savez(folder / "cube.npz", volume=phantom(32))
    splatct("simulate", "--volume", folder / "cube.npz", "--out", folder / "scan", "--views", 24, "--det", 64,
            "--sigma-rot", 0.03, "--sigma-trans", 1, "--noise", "r2", "--seed", 0)  # fmt: skip
    splatct("reconstruct", folder / "scan", "-o", folder / "out", "--threads", 1, "--quality", "preview")
    return folder


def test_results_are_written_and_scored(work):
    names = {path.name for path in (work / "out").iterdir()}
    assert names == {"volume.tif", "poses.json", "report.json", "report.html", "splats.npz", "manifest.json"}
    scores = json.loads(splatct("evaluate", work / "out", "--truth", work / "scan", "--json").stdout)
    assert scores["rot_deg_aligned"] < scores["nominal"]["rot_deg"] / 3
    assert "aligned" in splatct("evaluate", work / "out", "--truth", work / "scan").stdout


def test_a_full_folder_is_refused_before_the_work(work):
    done = splatct("reconstruct", work / "scan", "-o", work / "out", code=2)
    assert "not empty" in done.stderr and "--overwrite" in done.stderr and "Traceback" not in done.stderr


def test_poses_of_an_earlier_run_are_a_start(work):
    splatct("reconstruct", work / "scan", "-o", work / "again", "--poses", work / "out" / "poses.json", "--calibrate",
            "none", "--threads", 1, "--quality", "preview")  # fmt: skip
    scores = json.loads(splatct("evaluate", work / "again", "--truth", work / "scan", "--json").stdout)
    first = json.loads(splatct("evaluate", work / "out", "--truth", work / "scan", "--json").stdout)
    assert scores["rot_deg_aligned"] == pytest.approx(first["rot_deg_aligned"], rel=1e-6)
    assert scores["psnr_aligned"] > first["psnr_aligned"] - 1


def test_poses_of_another_scan_are_refused(work, tmp_path):
    given = read_scan(work / "scan").frames
    with pytest.raises(ScanError, match="24"):
        frames_for(given[:5], work / "out" / "poses.json")


def test_simulate_does_not_overwrite_silently(work):
    done = splatct("simulate", "--volume", work / "cube.npz", "--out", work / "scan", code=2)
    assert "not empty" in done.stderr


@pytest.mark.parametrize(
    ("option", "value"),
    [("views", 0), ("views", -3), ("det", 0), ("i0", 0), ("i0", "nan"), ("i0", 1e30), ("arc-deg", "nan"),
     ("sigma-rot", -1), ("seed", -1), ("det", 10**6), ("threads", -1)],
)  # fmt: skip
def test_what_cannot_be_simulated_is_named(work, tmp_path, option, value):
    done = splatct("simulate", "--volume", work / "cube.npz", "-o", tmp_path / "scan", f"--{option}", value, code=2)
    assert f"{option.replace('-', '_')}: got" in done.stderr and "expected" in done.stderr
    assert not (tmp_path / "scan").exists()


def test_simulate_refuses_a_file_for_its_folder(work):
    done = splatct("simulate", "--volume", work / "cube.npz", "-o", work / "cube.npz", code=2)
    assert "expected a folder" in done.stderr


def test_wrong_volume_is_named(work, tmp_path):
    (tmp_path / "junk.npz").write_bytes(b"nothing")
    done = splatct("simulate", "--volume", tmp_path / "junk.npz", "--out", tmp_path / "scan", code=2)
    assert "junk.npz" in done.stderr and "Traceback" not in done.stderr


def test_ctrl_c_and_the_same_command_goes_on(work, tmp_path):
    command = [sys.executable, "-m", "splatct_client", "reconstruct", str(work / "scan"), "-o", str(tmp_path / "out"),
               "--threads", "1", "--quality", "preview"]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as running:
        assert running.stderr is not None
        for line in running.stderr:
            if "binning 2, step" in line:
                running.send_signal(signal.SIGINT)
                break
        said = running.stderr.read()
    assert running.returncode == 130 and "go on" in said and "Traceback" not in said
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["run.checkpoint"]
    done = splatct(*command[3:])
    assert "Going on from the checkpoint" in done.stderr and "binning 4" not in done.stderr
    for name in ("volume.tif", "splats.npz"):
        assert (tmp_path / "out" / name).read_bytes() == (work / "out" / name).read_bytes(), name
    assert not (tmp_path / "out" / "run.checkpoint").exists()


def test_what_is_not_of_an_interrupted_run_is_not_overwritten(work, tmp_path):
    (tmp_path / "run.checkpoint").write_bytes(b"")
    (tmp_path / "thesis.tex").write_text("years of work")
    assert "not empty" in splatct("reconstruct", work / "scan", "-o", tmp_path, code=2).stderr
