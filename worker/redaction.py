"""What users are told of an engine's words: all but where things lie on this machine, in text that any database takes.

A message, an event or a log names files by their place in the job's folder, the data folder or this program.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

_HERE = Path(__file__).resolve().parents[1]
_AT_ONCE = 1 << 16  # bytes of a log


class Redaction:
    """For one job, whose folder lies in the data folder."""

    def __init__(self, data: Path, job: Path) -> None:
        ours = [data, _HERE, Path(sys.prefix), Path(sys.base_prefix), Path.home()]
        places = {f"{place}/": "…/" for given in ours for place in (given, given.resolve()) if len(place.parts) > 1}
        places |= {f"{place}/": "" for place in (job, job.resolve())}
        self._places = sorted(places.items(), key=lambda place: -len(place[0]))

    def __call__(self, text: str) -> str:
        for place, shown in self._places:
            text = text.replace(place, shown)
        # PostgreSQL keeps no NUL, and neither it nor SQLite half of a surrogate pair.
        return text.replace("\0", "\N{REPLACEMENT CHARACTER}").encode(errors="replace").decode()

    def log(self, file: Path, last: int | None = None) -> Iterator[str]:
        """The log, or its whole lines among the `last` bytes, block by block. Nothing where there is no log."""
        try:
            stream = file.open("rb")
        except FileNotFoundError:
            return
        with stream:
            if last is not None and stream.seek(0, 2) > last:
                stream.seek(-last - 1, 2)
                stream.readline()
            else:
                stream.seek(0)
            kept = b""
            while block := stream.read(_AT_ONCE):
                # A path may be cut by the end of a block, and so may a character: the rest of the line waits for more.
                text, newline, rest = (kept + block).rpartition(b"\n")
                if not newline and len(rest) > 16 * _AT_ONCE:
                    text, rest = rest, b""
                yield self((text + newline).decode(errors="replace"))
                kept = rest
            yield self(kept.decode(errors="replace"))
