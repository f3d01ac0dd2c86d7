"""What the API speaks of, as small immutable values. Unknown fields are ignored, so that a
newer server goes on working with this client.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from splatct_client.errors import UnexpectedAnswer

FINISHED_STATES = frozenset({"succeeded", "failed", "cancelled"})


class _FromJson:
    @classmethod
    def from_json(cls, data: object) -> Self:
        """The value from parsed JSON. Raises UnexpectedAnswer if a field is missing."""
        if not isinstance(data, Mapping):
            raise UnexpectedAnswer(f"expected a JSON object for {cls.__name__}, got {type(data).__name__}")
        known = {f.name for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
        try:
            return cls(**{str(name): value for name, value in data.items() if name in known})
        except TypeError as error:
            raise UnexpectedAnswer(f"the server's {cls.__name__} is incomplete: {error}") from None

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)  # type: ignore[call-overload]


@dataclass(frozen=True)
class FileSpec:
    """A file to be announced for upload."""

    name: str
    size: int
    sha256: str | None = None

    def to_json(self) -> dict[str, Any]:
        return {k: v for k, v in dataclasses.asdict(self).items() if v is not None}


@dataclass(frozen=True)
class UploadedFile(_FromJson):
    name: str
    size: int
    received: int = 0
    complete: bool = False
    sha256: str | None = None


@dataclass(frozen=True)
class Upload(_FromJson):
    id: str
    state: str
    name: str = ""
    files: tuple[UploadedFile, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "files", tuple(UploadedFile.from_json(f) for f in self.files))


@dataclass(frozen=True)
class Scan(_FromJson):
    """A committed scan. `facts` is what the server found out about it."""

    id: str
    name: str = ""
    bytes: int = 0
    facts: dict[str, Any] = field(default_factory=dict)
    pinned: bool = False
    created_at: str | None = None


@dataclass(frozen=True)
class JobError(_FromJson):
    kind: str
    message: str


@dataclass(frozen=True)
class Job(_FromJson):
    """One reconstruction. Times are RFC 3339 text, UTC."""

    id: str
    state: str
    name: str = ""
    scan_id: str = ""
    scan_name: str = ""
    stage: str | None = None
    message: str | None = None
    progress: float = 0.0
    eta_s: float | None = None
    queue_position: int | None = None
    attempt: int = 1
    priority: str = "normal"
    restart_of: str | None = None
    pinned: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    created_at: str | None = None
    started_at: str | None = None
    finished_at: str | None = None
    error: JobError | None = None

    def __post_init__(self) -> None:
        given: object = self.error
        if isinstance(given, Mapping):
            object.__setattr__(self, "error", JobError.from_json(given))

    @property
    def finished(self) -> bool:
        return self.state in FINISHED_STATES


@dataclass(frozen=True)
class ResultFile(_FromJson):
    name: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Webhook(_FromJson):
    """`secret` is what signatures are made with; None but in the answer that made it."""

    id: str
    url: str
    events: list[str] = field(default_factory=list)
    created_at: str | None = None
    secret: str | None = None


@dataclass(frozen=True)
class Delivery(_FromJson):
    """One message to a webhook, and how the telling went: `waiting`, `delivered` or `given up`."""

    id: str
    job_id: str
    event: str
    state: str
    attempts: int = 0
    status: int | None = None
    error: str | None = None
    created_at: str | None = None
    delivered_at: str | None = None
    next_at: str | None = None
