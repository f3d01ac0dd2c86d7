"""What the engine may use, and how want of memory is told from a crash."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from splatcore import machine
from worker.oom import OomWatch
from worker.process import clean_environment


def limited(code: str, memory_mib: int = 0, file_mib: int = 64) -> subprocess.CompletedProcess[str]:
    script = f"from worker.limits import limit_self\nlimit_self({memory_mib}, {file_mib}, nice=3)\n{code}"
    command = [sys.executable, "-c", script]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60, env=clean_environment())


def test_memory_ends_in_a_memory_error_and_not_in_a_signal() -> None:
    assert limited("bytearray(1 << 30)", memory_mib=512).returncode == 0
    done = limited("bytearray(8 << 30)", memory_mib=512)
    assert done.returncode == 1 and "MemoryError" in done.stderr


def test_no_file_grows_beyond_its_limit(tmp_path: Path) -> None:
    write = f"open({str(tmp_path / 'f')!r}, 'wb').write(bytes(COUNT << 20))"
    assert limited(write.replace("COUNT", "3"), file_mib=4).returncode == 0
    done = limited(write.replace("COUNT", "5"), file_mib=4)
    assert done.returncode == 1 and "File too large" in done.stderr


def test_no_core_and_first_in_line_when_memory_runs_out() -> None:
    code = (
        "import resource; print(resource.getrlimit(resource.RLIMIT_CORE)[0], open('/proc/self/oom_score_adj').read())"
    )
    assert limited(code).stdout.split() == ["0", "500"]


def test_it_gives_way_to_others() -> None:
    assert int(limited("import os; print(os.nice(0))").stdout) == os.nice(0) + 3


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("memory.events", "low 0\noom 1\noom_kill 1\n", "low 0\noom 2\noom_kill 2\n"),
        ("memory/memory.oom_control", "under_oom 0\noom_kill 4\n", "under_oom 0\noom_kill 5\n"),
    ],
)
def test_the_cgroup_says_that_the_kernel_killed(tmp_path: Path, name: str, before: str, after: str) -> None:
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_text(before)
    watch = OomWatch(tmp_path, tmp_path / "vmstat")
    assert not watch.killed()
    file.write_text(after)
    assert watch.killed()


def test_so_does_the_machine(tmp_path: Path) -> None:
    vmstat = tmp_path / "vmstat"
    vmstat.write_text("nr_free_pages 5\noom_kill 7\n")
    watch = OomWatch(tmp_path, vmstat)
    vmstat.write_text("nr_free_pages 4\noom_kill 7\n")
    assert not watch.killed()
    vmstat.write_text("nr_free_pages 4\noom_kill 8\n")
    assert watch.killed()


def test_one_s_own_cgroup_is_found_and_its_quota_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, own = tmp_path / "cgroup", tmp_path / "cgroup" / "ct" / "worker"
    own.mkdir(parents=True)
    (tmp_path / "self").write_text("1:name=other:/x\n0::/ct/worker\n")
    assert machine.own_cgroup(root, tmp_path / "self") == own
    (tmp_path / "self").write_text("0::/not/seen/from/here\n")
    assert machine.own_cgroup(root, tmp_path / "self") == root
    monkeypatch.setattr(machine, "_CGROUP", root)
    monkeypatch.setattr(machine, "own_cgroup", lambda: own)
    monkeypatch.setattr(machine.os, "sched_getaffinity", lambda _: range(64))
    (own / "cpu.max").write_text("max 100000")
    (own.parent / "cpu.max").write_text("250000 100000")
    (root / "cpu.max").write_text("1600000 100000")
    assert machine.threads_allowed() == 3


def test_libraries_are_told_how_many_threads_they_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.process.threads_allowed", lambda: 3)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    told = clean_environment()
    assert (told["OMP_NUM_THREADS"], told["OPENBLAS_NUM_THREADS"]) == ("2", "3")
