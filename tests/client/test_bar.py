from __future__ import annotations

import io

import pytest
from splatct_client.bar import Bar, seconds_text, size_text


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_file_gets_few_lines_but_always_the_last():
    stream = io.StringIO()
    with Bar("upload", stream) as bar:
        for step in range(101):
            bar.show(step / 100, f"{step} MB")
    assert stream.getvalue().splitlines() == ["upload   0 %  0 MB", "upload 100 %  100 MB"]


def test_a_terminal_gets_one_line_that_is_wiped(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    stream = Terminal()
    with Bar("upload", stream) as bar:
        bar.show(0.0, "a long file name")
        bar.show(1.0, "short")
    first, second = stream.getvalue().removesuffix("\n").split("\r")[1:]
    assert len(second) >= len(first) and "100 %" in second and "\n" not in first


@pytest.mark.parametrize(("size", "text"), [(0, "0 B"), (999, "999 B"), (1500, "1.5 kB"), (2.5e12, "2.5 TB")])
def test_sizes_read_well(size, text):
    assert size_text(size) == text


@pytest.mark.parametrize(("seconds", "text"), [(3.2, "3 s"), (75, "1 min 15 s"), (3725, "1 h 02 min")])
def test_durations_read_well(seconds, text):
    assert seconds_text(seconds) == text
