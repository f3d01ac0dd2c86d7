"""Everything SplatCT raises on purpose.

SplatCTError
  ScanError             a scan folder cannot be used; lists every problem found
  OptionsError          an option is unknown, of the wrong type, or out of range
  ResultError           a result folder cannot be read or written
  ExportError           another toolkit cannot describe these frames
  CheckpointError       a run's state cannot be gone on from
  ReconstructionError   the engine cannot go on (diverged, no signal in the data)

Each message says what is wrong, what was given, what was expected and what to try.
Standard library only: the server imports this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass


class SplatCTError(Exception):
    """Base of all errors raised on purpose; its text is fit to show to a user."""


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with an input.

    `where` names the file, or the JSON pointer inside scan.json (``/geometry/dso_mm``).
    """

    where: str
    what: str
    hint: str = ""

    def __str__(self) -> str:
        return f"{self.where}: {self.what}" + (f" ({self.hint})" if self.hint else "")

    def to_json(self) -> dict[str, str]:
        return asdict(self)


class ScanError(SplatCTError):
    """A scan folder cannot be used. `problems` lists everything found, not just the first."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


class OptionsError(SplatCTError):
    """An option is unknown, of the wrong type, or out of range."""


class ResultError(SplatCTError):
    """A result folder cannot be read or written."""


class ExportError(SplatCTError):
    """Another toolkit cannot describe these frames."""


class CheckpointError(SplatCTError):
    """A checkpoint cannot be gone on from; its text says why, as the end of a sentence."""


class ReconstructionError(SplatCTError):
    """The engine cannot go on."""

    exit_code = 1  # of the command line: the work failed; the others are wrong input, 2
