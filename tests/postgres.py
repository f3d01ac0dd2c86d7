"""A PostgreSQL server of one's own, from the system's programs, for the tests that need one."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

USER = "nobody" if os.geteuid() == 0 else None  # PostgreSQL refuses to run as root


def program(name: str) -> str:
    """A PostgreSQL program; Debian keeps them off the PATH."""
    versions = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))
    found = shutil.which(name) or (str(versions[-1]) if versions else None)
    if found is None:
        pytest.skip(f"no {name} on this system")
    return found


@contextlib.contextmanager
def running_postgres() -> Iterator[str]:
    """Its URL, on a free loopback port, with an empty database."""
    initdb, pg_ctl = program("initdb"), program("pg_ctl")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    folder = Path(tempfile.mkdtemp(prefix="splatct-pg-"))
    if USER:
        shutil.chown(folder, USER)

    def run(*command: str) -> None:
        subprocess.run(command, user=USER, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd="/")

    data = str(folder / "data")
    run(initdb, "-D", data, "-U", "splatct", "-A", "trust", "-E", "UTF8", "--locale", "C", "-N")
    options = f"-p {port} -c listen_addresses=127.0.0.1 -c unix_socket_directories={folder}"
    run(pg_ctl, "-D", data, "-w", "-o", options, "-l", str(folder / "log"), "start")
    try:
        yield f"postgresql+psycopg://splatct@127.0.0.1:{port}/postgres"
    finally:
        run(pg_ctl, "-D", data, "-w", "-m", "immediate", "stop")
        shutil.rmtree(folder)


def emptied(url: str) -> str:
    """The same database with nothing in it."""
    engine = sa.create_engine(url)
    with engine.begin() as connection:
        connection.execute(sa.text("DROP SCHEMA public CASCADE"))
        connection.execute(sa.text("CREATE SCHEMA public"))
    engine.dispose()
    return url
