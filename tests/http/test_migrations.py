"""The schema's versions: every way to the newest one ends at the same tables, and none loses a row."""

from __future__ import annotations

import contextlib
import shutil
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

import server.app  # noqa: F401  all tables
from server.migrations import SchemaError, prepare, runner, v0001_first
from server.migrations.steps import STEPS
from worker.database import Database, metadata

from ..postgres import emptied, running_postgres

NEWEST = len(STEPS)
MANY = 5000  # jobs, some 10 MB


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    with running_postgres() as url:
        yield url


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.system)])
def empty(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[[], Database]]:
    """Opens a database with nothing in it, of either kind."""
    opened: list[Database] = []

    def make() -> Database:
        if request.param == "postgresql":
            url = emptied(request.getfixturevalue("postgres"))
        else:
            url = f"sqlite:///{tmp_path / f'{len(opened)}.db'}"
        opened.append(Database(url))
        return opened[-1]

    yield make
    for database in opened:
        database.close()


def first(database: Database) -> Database:
    """As SplatCT 0.1 left it: its tables with a row in each, and no word about a version."""
    with database.writing() as write:
        v0001_first.upgrade(write)
        for statement in (
            "INSERT INTO jobs (id, name, scan_id, scan_name, options, state, stage, message, progress, attempt, "
            "crashes, created_at) VALUES ('j', 'old', 's', 'scan', '{\"a\": 1}', 'queued', '', '', 0, 1, 0, 5)",
            "INSERT INTO uploads VALUES ('s', 'scan', TRUE, 1, 2)",
            "INSERT INTO upload_files VALUES ('s', 'scan.json', 0, 10, NULL, 'abc')",
            "INSERT INTO upload_parts VALUES ('s', 'scan.json', 7)",
            "INSERT INTO scans VALUES ('s', 'scan', 10, '{}', 3)",
            "INSERT INTO submissions VALUES ('key', 'k', 'digest', 'j', 4)",
        ):
            write.execute(sa.text(statement.replace(":", r"\:")))
    return database


def shape(database: Database) -> dict[str, Any]:
    """Every table as the database itself describes it."""
    tables = sa.inspect(database.engine)
    return {
        name: {
            "columns": {
                column["name"]: (str(column["type"]), column["nullable"], column["default"])
                for column in tables.get_columns(name)
            },
            "key": tables.get_pk_constraint(name)["constrained_columns"],
            "references": sorted(
                (f["constrained_columns"], f["referred_table"], f["options"]) for f in tables.get_foreign_keys(name)
            ),
            "unique": sorted(u["column_names"] for u in tables.get_unique_constraints(name)),
            "indexes": sorted((i["name"], i["column_names"], bool(i["unique"])) for i in tables.get_indexes(name)),
        }
        for name in tables.get_table_names()
    }


def everything(database: Database) -> dict[str, list[dict[str, Any]]]:
    with database.reading() as read:
        names = sa.inspect(read).get_table_names()
        return {name: [dict(r._mapping) for r in read.execute(sa.text(f"SELECT * FROM {name}"))] for name in names}


def test_a_fresh_database_is_what_the_code_expects(empty: Callable[[], Database]) -> None:
    declared = empty()
    metadata.create_all(declared.engine)
    expected = shape(declared)
    fresh = empty()
    prepare(fresh)
    made = shape(fresh)
    assert made.pop("schema_versions")["key"] == ["version"]
    assert made == expected


def test_an_upgraded_database_is_what_a_fresh_one_is_and_keeps_its_rows(empty: Callable[[], Database]) -> None:
    fresh = empty()
    prepare(fresh)
    expected = shape(fresh)
    old = first(empty())
    before = everything(old)
    prepare(old)
    assert shape(old) == expected
    after = everything(old)
    assert [row["version"] for row in after["schema_versions"]] == list(range(1, len(STEPS) + 1))
    for table, rows in before.items():
        for kept, row in zip(rows, after[table], strict=True):
            assert {name: row[name] for name in kept} == kept


def test_preparing_again_changes_nothing(empty: Callable[[], Database]) -> None:
    database = first(empty())
    prepare(database)
    before = everything(database)
    prepare(database)
    assert everything(database) == before


def test_a_newer_schema_is_refused(empty: Callable[[], Database]) -> None:
    database = empty()
    prepare(database)
    newer = len(STEPS) + 1
    with database.writing() as write:
        write.execute(sa.text(f"INSERT INTO schema_versions VALUES ({newer}, 0)"))
    with pytest.raises(SchemaError, match=rf"has version {newer}, this program knows versions up to {newer - 1}\. .*"):
        prepare(database)


def test_of_many_at_once_one_upgrades(empty: Callable[[], Database], monkeypatch: pytest.MonkeyPatch) -> None:
    taken = []

    def step(write: sa.Connection) -> None:
        taken.append(threading.get_ident())
        write.execute(sa.text("CREATE TABLE late (id INTEGER)"))

    monkeypatch.setattr(runner, "STEPS", (*STEPS, step))
    url = first(empty()).engine.url.render_as_string(hide_password=False)
    together = threading.Barrier(6)

    def one(_: int) -> None:
        database = Database(url)
        together.wait()
        prepare(database)
        database.close()

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(one, range(6)))
    assert len(taken) == 1


def test_a_step_that_fails_leaves_the_old_version_whole(
    empty: Callable[[], Database], monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(write: sa.Connection) -> None:
        write.execute(sa.text("CREATE TABLE half (id INTEGER)"))
        write.execute(sa.text("DELETE FROM scans"))
        raise RuntimeError("in the middle")

    monkeypatch.setattr(runner, "STEPS", (*STEPS, half))
    database = first(empty())
    before, tables = everything(database), shape(database)
    with pytest.raises(RuntimeError, match="in the middle"):
        prepare(database)
    assert (everything(database), shape(database)) == (before, tables)
    monkeypatch.setattr(runner, "STEPS", STEPS)
    prepare(database)
    assert everything(database)["scans"]


def test_a_sqlite_file_is_copied_before_it_is_upgraded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def drop(write: sa.Connection) -> None:
        write.execute(sa.text("DELETE FROM jobs"))

    file = tmp_path / "splatct.db"
    database = first(Database(f"sqlite:///{file}"))
    monkeypatch.setattr(runner, "STEPS", (*STEPS, drop))
    prepare(database)
    prepare(database)
    database.close()
    (copy,) = tmp_path.glob("*.bak")
    assert copy.name.startswith("splatct.db.v1-") and copy.stat().st_mode & 0o077 == 0
    with contextlib.closing(sqlite3.connect(copy)) as kept, contextlib.closing(sqlite3.connect(file)) as now:
        assert kept.execute("SELECT id FROM jobs").fetchall() == [("j",)]
        assert now.execute("SELECT id FROM jobs").fetchall() == []
    assert not list(tmp_path.glob("*.part"))


def test_a_server_refuses_a_newer_database_in_a_sentence(tmp_path: Path) -> None:
    database = Database(f"sqlite:///{tmp_path / 'splatct.db'}")
    prepare(database)
    with database.writing() as write:
        write.execute(sa.text("INSERT INTO schema_versions VALUES (1000, 0)"))
    database.close()
    for verb in ("server", "up"):
        command = [sys.executable, "-m", "splatct_client", verb, "--data", str(tmp_path), "--port", "0"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 2 and "has version 1000" in done.stderr and "Traceback" not in done.stderr


# Killed in the middle, and started side by side


_DIES = """
import os, sys, time
from server.migrations import prepare, runner
from server.migrations.steps import STEPS
from worker.database import Database
import sqlalchemy as sa

def half(write):
    write.execute(sa.text("CREATE TABLE half (id INTEGER)"))
    write.execute(sa.text("DELETE FROM scans"))
    print("half", flush=True)
    time.sleep(60)

runner.STEPS = (*STEPS, half)
prepare(Database(sys.argv[1]))
"""


def test_an_upgrade_that_is_killed_half_way_leaves_the_old_version_and_is_done_again(
    empty: Callable[[], Database],
) -> None:
    database = first(empty())
    before, tables = everything(database), shape(database)
    url = database.engine.url.render_as_string(hide_password=False)
    with subprocess.Popen([sys.executable, "-c", _DIES, url], stdout=subprocess.PIPE, text=True) as upgrade:
        assert upgrade.stdout is not None and upgrade.stdout.readline() == "half\n"
        upgrade.kill()
    assert (everything(database), shape(database)) == (before, tables)
    prepare(database)
    after = everything(database)
    assert "half" not in after and [row["version"] for row in after["schema_versions"]] == list(range(1, NEWEST + 1))
    assert [row["id"] for row in after["scans"]] == ["s"]


@pytest.mark.slow
def test_a_server_killed_at_any_moment_of_an_upgrade_upgrades_when_it_is_started_again(tmp_path: Path) -> None:
    """By the real server on a file of some size, so that copying and changing it take their time."""
    original = tmp_path / "original.db"
    grown(f"sqlite:///{original}")
    reached = set()
    for turn in range(6):
        folder = tmp_path / str(turn)
        folder.mkdir()
        shutil.copyfile(original, folder / "splatct.db")
        with subprocess.Popen(_server(folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
            stages = {"copying": "*.part", "changing": "*.bak"}  # killed a moment after such a file is there
            stage = list(stages)[turn % 2]
            deadline = time.monotonic() + 60
            while not list(folder.glob(stages[stage])) and time.monotonic() < deadline:
                time.sleep(0.001)
            time.sleep(turn // 2 * 0.01)
            server.kill()
        with contextlib.closing(sqlite3.connect(folder / "splatct.db")) as found:
            names = {row[0] for row in found.execute("SELECT name FROM sqlite_master")}
            reached.add((stage, "schema_versions" in names))
        database = Database(f"sqlite:///{folder / 'splatct.db'}")
        prepare(database)
        after = everything(database)
        database.close()
        assert len(after["jobs"]) == MANY and [row["version"] for row in after["schema_versions"]][-1] == NEWEST
        assert not list(folder.glob("*.part")), "what a killed copy left takes no room"
        for copy in folder.glob("*.bak"):
            with contextlib.closing(sqlite3.connect(copy)) as kept:
                assert kept.execute("SELECT count(*) FROM jobs").fetchone() == (MANY,), "every copy is whole"
    assert ("copying", False) in reached, reached


@pytest.mark.slow
def test_servers_that_start_together_on_an_old_schema_all_serve(tmp_path: Path) -> None:
    grown(f"sqlite:///{tmp_path / 'splatct.db'}")
    ports = [_free_port() for _ in range(3)]
    servers = [
        subprocess.Popen(_server(tmp_path, port), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for port in ports
    ]
    try:
        for port in ports:
            deadline = time.monotonic() + 60
            while not _healthy(port):
                assert time.monotonic() < deadline and all(server.poll() is None for server in servers)
                time.sleep(0.1)
    finally:
        for server in servers:
            server.kill()
            server.wait()
    database = Database(f"sqlite:///{tmp_path / 'splatct.db'}")
    after = everything(database)
    database.close()
    assert [row["version"] for row in after["schema_versions"]] == list(range(1, NEWEST + 1))
    assert len(after["jobs"]) == MANY and len(list(tmp_path.glob("*.bak"))) == 1


def grown(url: str) -> None:
    """Version 1 with many jobs."""
    database = first(Database(url))
    row = everything(database)["jobs"][0]
    table = sa.Table("jobs", sa.MetaData(), autoload_with=database.engine)
    with database.writing() as write:
        write.execute(table.insert(), [row | {"id": f"j{n}", "message": "x" * 2000} for n in range(MANY - 1)])
    database.close()


def _server(data: Path, port: int = 0) -> list[str]:
    return [sys.executable, "-m", "splatct_client", "server", "--data", str(data), "--port", str(port or _free_port())]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _healthy(port: int) -> bool:
    with contextlib.suppress(httpx.TransportError):
        return httpx.get(f"http://127.0.0.1:{port}/healthz", trust_env=False).status_code == 200
    return False


# Every version with rows in every table


@pytest.mark.parametrize("version", range(1, NEWEST), ids=str)
def test_rows_of_every_table_of_every_version_are_kept(empty: Callable[[], Database], version: int) -> None:
    database = empty()
    with database.writing() as write:
        for step in STEPS[:version]:
            step(write)
        if version > 1:
            runner._versions.create(write)
            rows = [{"version": number, "applied_at": float(number)} for number in range(1, version + 1)]
            write.execute(runner._versions.insert(), rows)
        there = sa.MetaData()
        there.reflect(bind=write)
        for table in there.sorted_tables:  # what is referred to comes first
            if table.name != runner._versions.name:
                write.execute(table.insert().values({column.name: _some(column) for column in table.columns}))
    before = everything(database)
    assert all(before.values()), "no table is empty"
    prepare(database)
    after = everything(database)
    for name, rows in before.items():
        kept = after[name][: len(rows)] if name == runner._versions.name else after[name]
        assert [{column: row[column] for column in rows[0]} for row in kept] == rows, name
    fresh = empty()
    prepare(fresh)
    upgraded = shape(fresh)
    assert set(after) == set(upgraded)


def _some(column: sa.Column[Any]) -> Any:
    """A value of its type; all texts alike, so that what refers finds what it refers to."""
    if column.name == "state":
        return "queued"
    kind = column.type
    if isinstance(kind, sa.JSON):
        return {}
    if isinstance(kind, sa.Boolean):
        return True
    return {int: 7, float: 5.0}.get(kind.python_type, "x")
