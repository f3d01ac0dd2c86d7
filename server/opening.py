"""What must be in order before anything listens: the data folder, and a database of this program's version."""

from __future__ import annotations

from server.migrations import prepare
from server.settings import Settings, SettingsError
from worker.database import Database


def make_ready(settings: Settings) -> None:
    """Make or upgrade what is there. Raises SettingsError or SchemaError, which say why it cannot be used."""
    if settings.data.exists() and not settings.data.is_dir():
        raise SettingsError(f"data: {settings.data} is a file, expected a folder; choose another with --data")
    settings.data.mkdir(parents=True, exist_ok=True)
    database = Database(settings.database)
    try:
        prepare(database)
    finally:
        database.close()
