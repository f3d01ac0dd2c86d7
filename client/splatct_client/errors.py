"""Everything the client raises on purpose.

SplatCTError          the name by which the command line knows an error meant for people
  ClientError
    InputError        what was given cannot be used: a wrong folder, a missing file
    ServerUnreachable nobody answers at the address
    KeyNeeded         the server lets nobody in without a key
    ServerProblem     the server answered with problem+json; `problems` lists all of it
    UnexpectedAnswer  the answer is not what version 1 of the API promises
    IntegrityError    bytes differ from their sha256
    JobFailed         the job ended as failed or cancelled

The engine has a SplatCTError of its own; the two know nothing of each other, and the
command line goes by the name and by `exit_code`. Standard library only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass


class SplatCTError(Exception):
    """Base of the errors raised on purpose; the text is fit to show to a user."""

    exit_code = 2


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong, where it is, and what to try."""

    where: str
    what: str
    hint: str = ""

    def __str__(self) -> str:
        return f"{self.where}: {self.what}" + (f" ({self.hint})" if self.hint else "")

    def to_json(self) -> dict[str, str]:
        return asdict(self)


class ClientError(SplatCTError):
    """Base of what this package raises."""


class InputError(ClientError):
    """What the user gave cannot be used. Lists everything found, not just the first."""

    def __init__(self, summary: str, problems: Sequence[Problem] = ()) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join([summary, *(f"  {problem}" for problem in self.problems)]))


class ServerUnreachable(ClientError):
    """Nobody answers at the server's address, or not in time."""

    exit_code = 3

    def __init__(self, base_url: str, cause: Exception) -> None:
        super().__init__(
            f"no SplatCT server answers at {base_url} ({str(cause) or type(cause).__name__}). "
            "Start one with `splatct up`, or name another with --server URL or SPLATCT_SERVER."
        )


class KeyNeeded(ClientError):
    """The server asks for a key, and none was given."""

    def __init__(self, base_url: str) -> None:
        super().__init__(
            f"the server at {base_url} asks for a key: name the file that holds it with --key-file FILE, or set "
            "SPLATCT_KEY. Who runs the server makes one with `splatct keys add`."
        )


class ServerProblem(ClientError):
    """The server refused or failed: an RFC 9457 problem."""

    def __init__(
        self, status: int, title: str, detail: str = "", kind: str = "about:blank", problems: Sequence[Problem] = ()
    ) -> None:
        self.status = status
        self.kind = kind
        self.problems = tuple(problems)
        self.exit_code = 2 if status < 500 else 1
        summary = f"{title}: {detail}" if detail and detail != title else title
        super().__init__("\n".join([f"{summary} (HTTP {status})", *(f"  {problem}" for problem in self.problems)]))


class UnexpectedAnswer(ClientError):
    """The answer is not what version 1 of the API promises."""

    exit_code = 1


class IntegrityError(ClientError):
    """Bytes arrived that differ from the announced size or sha256."""

    exit_code = 1


class JobFailed(ClientError):
    """The job ended as failed or cancelled."""

    exit_code = 1
