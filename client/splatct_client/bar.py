"""A progress bar for people at a terminal; a line every few seconds for everything else."""

from __future__ import annotations

import shutil
import sys
import time
from types import TracebackType
from typing import Self, TextIO

LINE_EVERY_S = 5.0
REDRAW_EVERY_S = 0.1


class Bar:
    """Writes to stderr, so that stdout stays free for results."""

    def __init__(self, label: str, stream: TextIO | None = None) -> None:
        self._label = label
        self._stream = stream or sys.stderr
        self._tty = self._stream.isatty()
        self._last = float("-inf")
        self._shown = ""
        self._pending: tuple[float, str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pending:
            self._draw(*self._pending)
        if self._tty and self._shown:
            self._stream.write("\n")
            self._stream.flush()

    def show(self, fraction: float, text: str = "") -> None:
        """Draw, unless the last drawing is too fresh; the last state is always drawn in the end."""
        self._pending = (fraction, text)
        now = time.monotonic()
        if now - self._last >= (REDRAW_EVERY_S if self._tty else LINE_EVERY_S):
            self._last = now
            self._draw(fraction, text)

    def _draw(self, fraction: float, text: str) -> None:
        self._pending = None
        fraction = min(max(fraction, 0.0), 1.0)
        percent = f"{fraction * 100:3.0f} %"
        if not self._tty:
            line = f"{self._label} {percent}  {text}".rstrip()
            if line != self._shown:
                self._stream.write(line + "\n")
                self._stream.flush()
            self._shown = line
            return
        columns = shutil.get_terminal_size().columns
        width = max(8, min(30, columns - len(self._label) - 40))
        full = round(width * fraction)
        line = f"{self._label} [{'#' * full}{'.' * (width - full)}] {percent}  {text}"[: columns - 1]
        self._stream.write("\r" + line.ljust(min(len(self._shown), columns - 1)))
        self._stream.flush()
        self._shown = line


def size_text(size: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"


def seconds_text(seconds: float) -> str:
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
