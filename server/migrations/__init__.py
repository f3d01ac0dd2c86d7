"""The database's schema, version by version: `prepare` brings any older one up to date.

A version is a module `vNNNN_what.py` with `upgrade(write)`, listed in `steps.py`. It changes what the version
before it left, on SQLite and PostgreSQL alike, by statements of its own: it imports no table from elsewhere,
because those go on changing and what was released must not. A fresh database takes the same steps.
"""

from server.migrations.runner import SchemaError, prepare

__all__ = ["SchemaError", "prepare"]
