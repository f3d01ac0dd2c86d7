"""Settings: from the environment, handed on to children, and never an open door."""

from __future__ import annotations

from pathlib import Path

import pytest

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
def test_only_loopback_is_served(host: str) -> None:
    with pytest.raises(SettingsError, match="no authentication"):
        Settings(host=host).require_loopback()


@pytest.mark.parametrize(("host", "served"), [("0.0.0.0", True), ("::", True), ("192.168.1.5", False), ("", False)])
def test_a_container_published_on_loopback_may_listen_on_all_its_addresses(host: str, served: bool) -> None:
    settings = Settings(host=host, published_on_loopback=True)
    if served:
        settings.require_loopback()
    else:
        with pytest.raises(SettingsError, match="no authentication"):
            settings.require_loopback()


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost", "127.1.2.3"])
def test_loopback_names(host: str) -> None:
    Settings(host=host).require_loopback()
