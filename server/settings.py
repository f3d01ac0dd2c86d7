"""The server's settings, from `SPLATCT_*` environment variables. Read on use, never at import."""

from __future__ import annotations

import ipaddress
from typing import Literal

from pydantic import Field

from worker.settings import SettingsError, WorkerSettings

__all__ = ["MIB", "Settings", "SettingsError"]

MIB = 1 << 20


class Settings(WorkerSettings):
    host: str = "127.0.0.1"
    port: int = Field(default=8080, ge=0, le=65535)
    # A promise by whoever runs us in a container: its port is published on the host's loopback address alone.
    published_on_loopback: bool = False
    check: str = "splatcore.check"  # for tests: the module that judges an uploaded scan
    check_memory_mib: int = 8192  # address space of that check; a hostile TIFF gets no further
    disk_floor_mib: int = 512  # kept free: no upload may take the last of the disk
    stale_upload_hours: float = 48.0
    reconcile_s: float = 2.0
    log_format: Literal["json", "text"] = "json"

    def require_loopback(self) -> None:
        """Refuse an address others could reach: there are no keys yet, so whoever connects may do all.

        A container has no loopback of its host's to listen on. There, with `published_on_loopback`, all
        addresses of the container will do; requests must still name a loopback host (see guard.py).
        """
        if self.host == "localhost":
            return
        try:
            address = ipaddress.ip_address(self.host)
            safe = address.is_loopback or (self.published_on_loopback and address.is_unspecified)
        except ValueError:
            safe = False
        if not safe:
            raise SettingsError(
                f"host: got {self.host!r}, expected a loopback address such as 127.0.0.1. The API has no "
                "authentication yet; to reach it from elsewhere use an SSH tunnel or an authenticating proxy."
            )
