"""The page's session over HTTP: a cookie in place of a key, and what it takes to change something with it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from http.cookies import SimpleCookie
from pathlib import Path
from uuid import uuid4

import httpx
import pytest
import sqlalchemy as sa

from server.app import create_app
from server.sessions import sessions
from server.settings import Settings
from worker.database import Database

from .stack import Stack, commit, scan_files


@pytest.fixture
def browser(keyed: Stack) -> Iterator[httpx.Client]:
    """Signed in with a key of the tenant `first`."""
    with keyed.client() as http:
        http.post("/v1/session", json={"key": keyed.new_key("first", "read", "submit", "delete")[1]}).raise_for_status()
        yield http


def csrf(http: httpx.Client) -> dict[str, str]:
    return {"X-CSRF-Token": http.get("/v1/session").json()["csrf"]}


def test_the_cookie_is_for_this_server_s_pages_alone(keyed: Stack) -> None:
    with keyed.client() as http:
        answer = http.post("/v1/session", json={"key": keyed.new_key("first", "read")[1]})
        assert answer.status_code == 201 and answer.json()["tenant"] == "first"
        (cookie,) = SimpleCookie(answer.headers["set-cookie"]).values()
        assert cookie["httponly"] is True and cookie["samesite"].lower() == "strict" and cookie["path"] == "/"
        assert cookie["domain"] == "" and cookie["secure"] == "" and int(cookie["max-age"]) == 12 * 3600
        over_tls = http.post(
            "/v1/session", json={"key": keyed.new_key("first", "read")[1]}, headers={"X-Forwarded-Proto": "https"}
        )
        ((name, cookie),) = SimpleCookie(over_tls.headers["set-cookie"]).items()
        assert name.startswith("__Host-") and cookie["secure"] is True and cookie["domain"] == ""
        tls, plain = {"X-Forwarded-Proto": "https"}, f"splatct_session={cookie.value}"
        with keyed.client() as other:
            assert other.get("/v1/jobs", headers={**tls, "Cookie": f"{name}={cookie.value}"}).status_code == 200
            assert other.get("/v1/jobs", headers={**tls, "Cookie": plain}).status_code == 401, "set by somebody else"
        assert over_tls.headers["strict-transport-security"].startswith("max-age=")


def test_only_a_digest_of_the_session_is_kept(keyed: Stack, browser: httpx.Client) -> None:
    token = browser.cookies["splatct_session"]
    kept = b"".join(path.read_bytes() for path in keyed.data.glob("splatct.db*"))
    assert token.encode() not in kept
    assert token not in browser.get("/v1/session").text


def test_reading_takes_the_cookie_and_changing_something_the_token_too(keyed: Stack, browser: httpx.Client) -> None:
    scan_id = commit(keyed.http, scan_files())
    assert browser.get(f"/v1/scans/{scan_id}").status_code == 200
    for headers in ({}, {"X-CSRF-Token": ""}, {"X-CSRF-Token": "0" * 64}, {"X-CSRF-Token": "ü"}):
        sent = {name: value.encode() for name, value in headers.items()}
        answer = browser.delete(f"/v1/scans/{scan_id}", headers=sent)  # type: ignore[arg-type]
        assert answer.status_code == 403 and answer.json()["type"] == "urn:splatct:problem:csrf"
    with keyed.client() as other:  # the token of another session
        other.post("/v1/session", json={"key": keyed.new_key("first", "read")[1]})
        assert browser.delete(f"/v1/scans/{scan_id}", headers=csrf(other)).status_code == 403
    assert browser.delete(f"/v1/scans/{scan_id}", headers=csrf(browser)).status_code == 204


def test_another_site_is_refused_even_with_all_it_needs(browser: httpx.Client) -> None:
    headers = csrf(browser) | {"Sec-Fetch-Site": "cross-site"}
    answer = browser.post(f"/v1/jobs/{uuid4()}/cancel", headers=headers)
    assert answer.status_code == 403 and answer.json()["type"] == "urn:splatct:problem:cross-site"


def test_a_session_has_its_key_s_scopes_and_tenant(keyed: Stack, browser: httpx.Client) -> None:
    mine = browser.get("/v1/session").json()
    assert (mine["tenant"], mine["scopes"]) == ("first", ["delete", "read", "submit"])
    assert browser.get("/metrics").status_code == 403
    with keyed.client(keyed.new_key("second", "admin")[1]) as second:
        foreign = commit(second, scan_files())
    assert browser.get(f"/v1/scans/{foreign}").status_code == 404


def test_a_session_ends_with_its_key(keyed: Stack) -> None:
    key, text = keyed.new_key("first", "read")
    with keyed.client() as http:
        http.post("/v1/session", json={"key": text})
        assert http.get("/v1/jobs").status_code == 200
        keyed.revoke(key.id)
        assert http.get("/v1/jobs").status_code == 401


def test_a_session_ends_when_its_time_is_over(keyed: Stack, browser: httpx.Client) -> None:
    _, text = keyed.new_key("first", "read", expires_at=time.time() + 1)
    with keyed.client() as http:
        assert int(SimpleCookie(http.post("/v1/session", json={"key": text}).headers["set-cookie"])
                   ["splatct_session"]["max-age"]) > 1  # fmt: skip
        keyed.until(lambda: http.get("/v1/jobs").status_code == 401, 5, "the key, and with it the session, expires")
    database = Database(f"sqlite:///{keyed.data / 'splatct.db'}")
    with database.writing() as write:
        write.execute(sa.update(sessions).values(expires_at=time.time() - 1))
    database.close()
    assert browser.get("/v1/jobs").status_code == 401


def test_signing_out_ends_it_for_good(browser: httpx.Client) -> None:
    token = browser.cookies["splatct_session"]
    assert browser.delete("/v1/session").status_code == 403, "another site must not sign people out"
    assert browser.delete("/v1/session", headers=csrf(browser)).status_code == 204
    browser.cookies.set("splatct_session", token)
    assert browser.get("/v1/jobs").status_code == 401


def test_a_session_survives_a_restart_of_the_server(stack: Stack) -> None:
    _, text = stack.new_key("local", "read")
    stack.http.post("/v1/session", json={"key": text}).raise_for_status()
    stack.server.terminate()
    stack.server.wait()
    stack.start_server()
    assert stack.http.get("/v1/jobs").status_code == 200


def test_a_wrong_key_begins_nothing(keyed: Stack) -> None:
    with keyed.client() as http:
        for key in ("splatct_aaaaaaaaaa_wrong", "no-key-at-all"):
            answer = http.post("/v1/session", json={"key": key})
            assert answer.status_code == 401 and "set-cookie" not in answer.headers and key not in answer.text


def test_without_keys_there_is_nothing_to_sign_in_to(shared: Stack) -> None:
    assert shared.http.post("/v1/session", json={"key": "x"}).status_code == 409
    mine = shared.http.get("/v1/session").json()
    assert (mine["tenant"], mine["key_id"], mine["csrf"]) == ("local", None, None)


HEADERS = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


def test_every_answer_tells_browsers_what_they_may_do(keyed: Stack) -> None:
    with keyed.client() as nobody:
        answers = [
            nobody.get("/"),
            nobody.get("/sign-in"),
            nobody.get("/static/api.js"),
            nobody.get("/v1/jobs"),
            nobody.get("/v1/no/such"),
            nobody.get("/healthz", headers={"Host": "elsewhere.example"}),
            nobody.post("/v1/session", content=b"{"),
            nobody.post("/v1/session", content=b"x" * (2 << 20)),
            keyed.http.get("/v1/jobs"),
            keyed.http.get("/v1/no/such"),
            keyed.http.get(f"/v1/jobs/{uuid4()}"),
        ]
    assert [a.status_code for a in answers] == [200, 200, 200, 401, 401, 421, 422, 413, 200, 404, 404]
    for answer in answers:
        assert {name: answer.headers.get(name) for name in HEADERS} == HEADERS, answer.request.url
        policy = answer.headers["content-security-policy"]
        assert "frame-ancestors 'none'" in policy and "base-uri 'none'" in policy
        assert "unsafe-inline" not in policy.split("style-src")[0], "scripts come from files of ours"


def test_a_failure_of_the_server_tells_them_too(tmp_path: Path) -> None:
    """An app whose lifespan has not begun: every route fails."""

    async def get() -> httpx.Response:
        transport = httpx.ASGITransport(create_app(Settings(data=tmp_path)), raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            return await client.get("/v1/scans")

    answer = asyncio.run(get())
    assert answer.status_code == 500 and {name: answer.headers.get(name) for name in HEADERS} == HEADERS


def test_what_is_a_tenant_s_is_not_kept_by_caches(keyed: Stack) -> None:
    for path in ("/v1/jobs", "/v1/scans", "/v1/session", f"/v1/jobs/{uuid4()}"):
        assert keyed.http.get(path).headers["cache-control"] == "no-store", path
