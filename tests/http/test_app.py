"""The application object, without its lifespan and without a socket."""

from __future__ import annotations

import asyncio
from pathlib import Path

import httpx

import server.app
from server.app import create_app
from server.settings import Settings


def ask(data: Path, path: str) -> httpx.Response:
    """GET of an app whose lifespan has not begun: every route that needs the store fails."""

    async def get() -> httpx.Response:
        transport = httpx.ASGITransport(create_app(Settings(data=data)), raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            return await client.get(path)

    return asyncio.run(get())


def test_a_bug_is_a_problem_without_a_traceback(tmp_path: Path) -> None:
    answer = ask(tmp_path, "/v1/scans")
    assert answer.status_code == 500
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["type"] == "urn:splatct:problem:internal-server-error" and "State" not in answer.text


def test_building_an_app_touches_nothing(tmp_path: Path) -> None:
    create_app(Settings(data=tmp_path / "data", redis_url="redis://nowhere.invalid:1/0"))
    assert list(tmp_path.iterdir()) == []


def test_browsers_ask_again_for_the_page_s_files(tmp_path: Path) -> None:
    script = next((Path(server.app.__file__).parent / "static").glob("*.js")).name
    answer = ask(tmp_path, f"/static/{script}")
    assert answer.status_code == 200 and answer.headers["cache-control"] == "no-cache"
