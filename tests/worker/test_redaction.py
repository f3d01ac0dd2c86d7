"""What users are told of an engine's words: nothing of where things lie, and nothing that a database chokes on."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from worker.contract import State
from worker.journal import read_events
from worker.ledger import Job, Ledger
from worker.redaction import _AT_ONCE, Redaction
from worker.settings import WorkerSettings
from worker.supervise import supervise


@pytest.fixture
def redacted(tmp_path: Path) -> Redaction:
    return Redaction(tmp_path / "data", tmp_path / "data" / "jobs" / "j")


def test_files_are_named_by_their_place(redacted: Redaction, tmp_path: Path) -> None:
    data = tmp_path / "data"
    assert redacted(f"{data}/jobs/j/scan/a.tif: is torn") == "scan/a.tif: is torn"
    assert redacted(f"no {data}/scans/s/a.tif") == "no …/scans/s/a.tif"
    assert redacted(f'File "{sys.prefix}/lib/x.py", line 3') == 'File "…/lib/x.py", line 3'
    assert redacted(f"{Path(__file__).parents[2]}/splatcore/scan.py") == "…/splatcore/scan.py"
    pointer = "scan.json/geometry/detector: 1/mm, 3/4"
    assert redacted(pointer) == pointer


@pytest.mark.parametrize("bad", ["\0", "\ud800", "\udfff"], ids=["nul", "high", "low"])
def test_text_can_be_stored_and_sent(redacted: Redaction, bad: str) -> None:
    text = redacted(f"a{bad}b")
    assert "\0" not in text and text.encode().decode() == text and text.startswith("a") and text.endswith("b")


def test_a_log_is_read_block_by_block_and_whole(redacted: Redaction, tmp_path: Path) -> None:
    """A path across the end of a block is found, and no character is cut."""
    log, place = tmp_path / "log.txt", f"{tmp_path}/data/jobs/j/scan"
    lines = [f"{'é' * (n % 91)} {place}/{n}.tif" for n in range(3000)]
    log.write_text("\n".join(lines))
    assert log.stat().st_size > 4 * _AT_ONCE
    assert "".join(redacted.log(log)) == "\n".join(lines).replace(f"{place}/", "scan/")


def test_the_end_of_a_log_is_whole_lines(redacted: Redaction, tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    assert list(redacted.log(log)) == []
    log.write_text("one\ntwo\nthree\n")
    assert "".join(redacted.log(log, 6)) == "three\n"
    assert "".join(redacted.log(log, 9)) == "three\n"
    assert "".join(redacted.log(log, 10)) == "two\nthree\n"
    assert "".join(redacted.log(log, 100)) == "one\ntwo\nthree\n"


@pytest.mark.usefixtures("keep_sigterm")
def test_an_engine_s_words_are_redacted(
    settings: WorkerSettings, ledger: Ledger, new_job: Callable[..., Job], tmp_path: Path
) -> None:
    job = new_job(end="wordy")
    supervise(settings, ledger, job.id, job.attempt)
    found = ledger.get(job.id)
    assert found is not None and found.state is State.FAILED
    message = found.error_message or ""
    assert "scan/projections.tif: is torn" in message and str(tmp_path) not in message
    assert "\0" not in message and str(Path(__file__).parents[2]) not in message
    assert str(tmp_path) not in str(read_events(settings.data / "jobs" / job.id / "events.jsonl", 0, 100))
