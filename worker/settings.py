"""What a worker must know, from `SPLATCT_*` environment variables. Read on use, never at import."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Self

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from splatcore.errors import SplatCTError


class SettingsError(SplatCTError):
    """A setting cannot be used."""


class WorkerSettings(BaseSettings):
    """Where jobs live and how long they may take. The server's settings extend it."""

    model_config = SettingsConfigDict(env_prefix="SPLATCT_", extra="ignore")

    data: Path = Path("splatct-data")
    database_url: str = Field(default="", repr=False)  # empty: SQLite in the data folder
    redis_url: str = Field(default="redis://127.0.0.1:6379/0", repr=False)
    job_seconds: float = 24 * 3600.0  # longest a job may run
    cancel_grace_s: float = 60.0  # for the engine to make a result of what there is, before it is killed
    drain_grace_s: float = 8.0  # for the engine to keep its state when its worker is to go, before it is killed
    checkpoint_s: float = 10.0  # at least so long between two writings of the engine's state; 0: it keeps none
    engine_memory_mib: int = Field(default=0, ge=0)  # 0: all that this machine, or the cgroup, gives
    engine_file_mib: int = Field(default=1 << 20, ge=1)  # of the largest file the engine may write
    engine: str = "splatcore"  # for tests: the package the engine process takes its functions from

    @classmethod
    def read(cls, given: Mapping[str, object]) -> Self:
        """The environment's settings; what the command line gives, and is not None, comes first."""
        try:
            return cls(**{name: value for name, value in given.items() if value is not None})  # type: ignore[arg-type]
        except ValidationError as error:
            faults = []
            for fault in error.errors():
                name = str(fault["loc"][0])
                faults.append(f"{name} (SPLATCT_{name.upper()}): got {fault['input']!r}; {fault['msg']}")
            raise SettingsError("\n".join(faults)) from None

    @property
    def database(self) -> str:
        return self.database_url or f"sqlite:///{self.data.absolute() / 'splatct.db'}"

    def to_environment(self) -> dict[str, str]:
        """These settings as environment variables, for child processes."""
        return {
            f"SPLATCT_{name.upper()}": str(value.absolute() if isinstance(value, Path) else value)
            for name, value in self
            if value is not None and not isinstance(value, list)
        }
