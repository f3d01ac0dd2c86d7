"""What must be in order before anything listens: the data folder, a database of this program's version, the door."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from server.importing import roots
from server.keys import KeyRing
from server.migrations import prepare
from server.settings import Settings, SettingsError
from worker.database import Database


@contextlib.contextmanager
def opened(settings: Settings) -> Iterator[Database]:
    """The database, made or upgraded first. Raises SettingsError or SchemaError, which say why it cannot be used."""
    if settings.data.exists() and not settings.data.is_dir():
        raise SettingsError(f"data: {settings.data} is a file, expected a folder; choose another with --data")
    settings.data.mkdir(parents=True, exist_ok=True)
    database = Database(settings.database)
    try:
        prepare(database)
        yield database
    finally:
        database.close()


def make_ready(settings: Settings) -> None:
    """Raises, too, if others could reach a server that has no keys."""
    settings.webhook_networks  # noqa: B018  raises for what is no network
    roots(settings.import_from, settings.data)
    with opened(settings) as database:
        settings.require_door(KeyRing(database).exist())
