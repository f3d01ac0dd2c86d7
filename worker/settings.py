"""What a worker must know, from `SPLATCT_*` environment variables. Read on use, never at import."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, ValidationError, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from splatcore.errors import SplatCTError

TestEnd = Literal["", "bad_input", "cannot_reconstruct", "out_of_memory", "disk_full", "bug", "crash", "hang"]


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
    engine_nice: int = Field(default=5, ge=0, le=19)  # the engine gives way to the server, and to all others
    engine: str = "splatcore"  # for tests: the package the engine process takes its functions from

    # Test mode (docs/test-mode.md). Nothing below works without the first.
    test_mode: bool = False
    test_step_s: float = Field(default=0.0, ge=0)  # every step of the engine takes so much longer
    test_end: TestEnd = ""  # how the engine ends, in place of well
    test_at_step: int = Field(default=100, ge=1)  # when
    test_attempts: int = Field(default=0, ge=0)  # the first so many attempts of a job alone; 0: all
    test_drop_uploads: float = Field(default=0.0, ge=0, le=1)  # the share of uploaded files or pieces that are cut

    @property
    def test_plan(self) -> dict[str, Any] | None:
        """For the engine; None outside test mode."""
        if not self.test_mode:
            return None
        plan = {"step_s": self.test_step_s, "end": self.test_end}
        return {**plan, "at_step": self.test_at_step, "attempts": self.test_attempts}

    @model_validator(mode="after")
    def _misbehave_in_test_mode_alone(self) -> Self:
        for name, field in type(self).model_fields.items():
            asked = name.startswith("test_") and getattr(self, name) != field.default
            if asked and not self.test_mode:
                raise ValueError(
                    f"{name} (SPLATCT_{name.upper()}): got {getattr(self, name)!r} outside test mode, where nothing "
                    "may misbehave on purpose; set SPLATCT_TEST_MODE=1 on a server that serves tests alone"
                )
        return self

    @classmethod
    def read(cls, given: Mapping[str, object]) -> Self:
        """The environment's settings; what the command line gives, and is not None, comes first."""
        try:
            return cls(**{name: value for name, value in given.items() if value is not None})  # type: ignore[arg-type]
        except ValidationError as error:
            faults = []
            for fault in error.errors():
                if not fault["loc"]:  # of several settings together; the text names them
                    faults.append(fault["msg"].removeprefix("Value error, "))
                    continue
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
