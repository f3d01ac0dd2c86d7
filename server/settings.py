"""The server's settings, from `SPLATCT_*` environment variables. Read on use, never at import."""

from __future__ import annotations

import ipaddress
from typing import Literal

from pydantic import Field

from server.addresses import Network, networks
from worker.settings import SettingsError, WorkerSettings

__all__ = ["MIB", "Settings", "SettingsError"]

MIB = 1 << 20


class Settings(WorkerSettings):
    host: str = "127.0.0.1"
    port: int = Field(default=8080, ge=0, le=65535)
    # A promise by whoever runs us in a container: its port is published on the host's loopback address alone.
    published_on_loopback: bool = False
    allowed_hosts: str = ""  # names and addresses of this server, comma between; a Host header may give no other
    trusted_proxies: str = "127.0.0.1"  # whose X-Forwarded-For and X-Forwarded-Proto are believed, comma between
    check: str = "splatcore.check"  # for tests: the module that judges an uploaded scan
    check_memory_mib: int = 8192  # address space of that check; a hostile TIFF gets no further
    disk_floor_mib: int = 512  # kept free: no upload may take the last of the disk
    disk_reserve_mib: int = Field(default=8, ge=0)  # held by a file, so that a full disk still lets things be deleted
    import_from: str = ""  # folders of this machine that tenants may import scans from: TENANT=FOLDER, comma between
    tenant_gib: float = Field(default=0.0, ge=0)  # of uploads, scans and results that a tenant may keep; 0: no limit
    tenant_jobs: int = Field(default=0, ge=0)  # of one tenant that may wait and run together; 0: no limit
    tenant_uploads: int = Field(default=1000, ge=0)  # of one tenant that may be open together; 0: no limit
    key_sessions: int = Field(default=50, ge=0)  # of the page, signed in with one key; 0: no limit
    rate_per_s: float = Field(default=50.0, ge=0)  # requests of one key, on the long run; 0: no limit
    rate_burst: int = Field(default=200, ge=1)  # and at once
    failures_per_min: float = Field(default=10.0, ge=0)  # keys from one address that are none; 0: no limit
    webhook_allow: str = ""  # private networks that webhooks may lead to, such as 10.1.0.0/16, comma between
    webhook_retry_s: float = Field(default=5.0, gt=0)  # before the second attempt; later pauses grow with it
    session_hours: float = Field(default=12.0, gt=0)  # of the page; then it asks for the key again
    # How many days after their last use things are kept, unless they are pinned; 0: for ever.
    keep_results_days: float = Field(default=0.0, ge=0)  # jobs that succeeded, after their end
    keep_failed_days: float = Field(default=0.0, ge=0)  # jobs that failed or were cancelled, after their end
    keep_scans_days: float = Field(default=0.0, ge=0)  # scans without a job, after the last one was sent or deleted
    stale_upload_hours: float = 48.0  # open uploads, after the last byte; their clients are gone
    reconcile_s: float = 2.0
    log_format: Literal["json", "text"] = "json"

    @property
    def only_loopback_reaches_us(self) -> bool:
        """Whether nobody but this machine can connect. A container has no loopback of its host's to listen on:
        there, with `published_on_loopback`, all addresses of the container will do.
        """
        if self.host == "localhost":
            return True
        try:
            address = ipaddress.ip_address(self.host)
        except ValueError:
            return False
        return address.is_loopback or (self.published_on_loopback and address.is_unspecified)

    @property
    def may_be_open(self) -> bool:
        """Whether it will do without keys: not under a name, which others, or a proxy, could use."""
        return self.only_loopback_reaches_us and not self.allowed_hosts.strip(" ,")

    @property
    def webhook_networks(self) -> tuple[Network, ...]:
        try:
            return networks(self.webhook_allow)
        except ValueError as error:
            raise SettingsError(
                f"webhook_allow (SPLATCT_WEBHOOK_ALLOW): got {self.webhook_allow!r}, {error}; expected networks, as "
                "10.1.0.0/16,192.168.3.4, comma between"
            ) from None

    @property
    def host_names(self) -> frozenset[str]:
        """What a Host header may say, beside loopback names."""
        listed = {name.strip().strip("[]").lower() for name in self.allowed_hosts.split(",")}
        return frozenset(listed - {""} | ({self.host} if self._names_one_host else set()))

    @property
    def _names_one_host(self) -> bool:
        try:
            return not ipaddress.ip_address(self.host).is_unspecified
        except ValueError:
            return self.host != ""

    def require_database(self) -> None:
        """Refuse to make an empty data folder where one was expected to be."""
        file = self.data / "splatct.db"
        if not self.database_url and not file.exists():
            raise SettingsError(f"data: there is no database {file}; name the server's data folder with --data")

    def require_door(self, keys_exist: bool) -> None:
        """Refuse to be reached by others without keys, or under no name."""
        if self.only_loopback_reaches_us and (keys_exist or self.may_be_open):
            return
        if not keys_exist and self.only_loopback_reaches_us:
            raise SettingsError(
                f"allowed_hosts (SPLATCT_ALLOWED_HOSTS): got {self.allowed_hosts!r}, expected none: there are no keys "
                "and whoever comes by that name could do all. Make a key first, with `splatct keys add`."
            )
        if not keys_exist:
            raise SettingsError(
                f"host: got {self.host!r}, expected a loopback address such as 127.0.0.1, as there are no keys and "
                "whoever connects could do all. Make a key first, with `splatct keys add`, or use an SSH tunnel."
            )
        if not self.host_names:
            raise SettingsError(
                f"allowed_hosts (SPLATCT_ALLOWED_HOSTS): is empty while host is {self.host!r}, expected the names and "
                "addresses that clients use for this server, such as ct.example.org,10.0.0.5"
            )
