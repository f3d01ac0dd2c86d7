"""Settings: from the environment, handed on to children, and never an open door."""

from __future__ import annotations

from pathlib import Path

import pytest

from server.opening import make_ready
from server.settings import Settings, SettingsError


def test_environment_there_and_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLATCT_PORT", "9000")
    monkeypatch.setenv("SPLATCT_REDIS_URL", "redis://:secret@example/1")
    settings = Settings(data=tmp_path)
    assert (settings.port, settings.data) == (9000, tmp_path)
    assert "secret" not in repr(settings)
    for name, value in settings.to_environment().items():
        monkeypatch.setenv(name, value)
    assert Settings() == settings


def test_what_the_command_line_gives_comes_first_and_every_fault_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLATCT_PORT", "abc")
    assert Settings.read({"port": 9000, "data": None}).port == 9000
    monkeypatch.setenv("SPLATCT_JOB_SECONDS", "long")
    with pytest.raises(SettingsError, match=r"(?s)SPLATCT_JOB_SECONDS\): got 'long'.*SPLATCT_PORT\): got 'abc'"):
        Settings.read({})
    with pytest.raises(SettingsError, match=r"port .*got 99999"):
        Settings.read({"port": 99999})


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "example.org", ""])
def test_without_keys_only_loopback_is_served(host: str) -> None:
    with pytest.raises(SettingsError, match=rf"host: got '{host}'.*there are no keys.*splatct keys add"):
        Settings(host=host, allowed_hosts="ct.example.org").require_door(keys_exist=False)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", ""])
def test_beyond_loopback_a_server_needs_a_name(host: str) -> None:
    with pytest.raises(SettingsError, match=r"allowed_hosts .*is empty"):
        Settings(host=host).require_door(keys_exist=True)
    named = Settings(host=host, allowed_hosts=" CT.example.org,, [fd00::5] ")
    named.require_door(keys_exist=True)
    assert named.host_names == {"ct.example.org", "fd00::5"}


def test_a_server_that_goes_by_a_name_needs_keys_even_on_loopback() -> None:
    """Else a proxy before it, or a page that rebinds the name, would let everybody in."""
    settings = Settings(allowed_hosts="ct.example.org")
    assert not settings.may_be_open and Settings().may_be_open
    settings.require_door(keys_exist=True)
    with pytest.raises(SettingsError, match=r"allowed_hosts .*got 'ct.example.org'.*there are no keys"):
        settings.require_door(keys_exist=False)


def test_a_network_that_is_none_is_refused_before_anything_listens() -> None:
    assert len(Settings(webhook_allow=" 10.1.0.0/16, fd00::/8,").webhook_networks) == 2
    with pytest.raises(SettingsError, match=r"SPLATCT_WEBHOOK_ALLOW\): got '10.1.0.1/16'"):
        make_ready(Settings(webhook_allow="10.1.0.1/16"))


def test_an_address_that_is_listened_on_is_a_name() -> None:
    settings = Settings(host="192.168.1.5")
    settings.require_door(keys_exist=True)
    assert settings.host_names == {"192.168.1.5"}


@pytest.mark.parametrize(("host", "served"), [("0.0.0.0", True), ("::", True), ("192.168.1.5", False), ("", False)])
def test_a_container_published_on_loopback_may_listen_on_all_its_addresses(host: str, served: bool) -> None:
    settings = Settings(host=host, published_on_loopback=True)
    assert settings.only_loopback_reaches_us is served


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost", "127.1.2.3"])
def test_loopback_needs_no_keys(host: str) -> None:
    Settings(host=host).require_door(keys_exist=False)
