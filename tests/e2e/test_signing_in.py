"""The page where there are keys, in a real Chromium: it asks for one, keeps none, and can be left."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, expect

from server.keys import KeyRing, Scope

from .chromium import NEEDED
from .stage import Stage

pytestmark = NEEDED


@pytest.fixture
def key(stage: Stage) -> str:
    return KeyRing(stage.database).add("local", "somebody", [Scope.READ, Scope.SUBMIT], None)[1]


@pytest.fixture
def page(browser: Browser, stage: Stage, key: str) -> Iterator[Page]:
    context = browser.new_context(base_url=stage.url)
    page = context.new_page()
    failed: list[str] = []
    page.on("pageerror", lambda error: failed.append(str(error)))
    yield page
    context.close()
    assert failed == []


def sign_in(page: Page, key: str) -> None:
    page.get_by_label("Key").fill(key)
    page.get_by_role("button", name="Sign in").click()


def test_a_stranger_is_asked_for_a_key_and_comes_back_to_where_they_were(page: Page, stage: Stage, key: str) -> None:
    job_id = stage.job("mine")
    page.goto(f"/jobs/{job_id}")
    expect(page.get_by_role("heading", name="Sign in")).to_be_visible()
    sign_in(page, "splatct_aaaaaaaaaa_wrong")
    expect(page.get_by_role("alert")).to_have_text("This key is not known here, has expired or was revoked.")
    sign_in(page, key)
    expect(page.get_by_role("heading", name="mine")).to_be_visible()
    expect(page.locator("#who")).to_have_text("local")
    stored = page.evaluate("JSON.stringify([document.cookie, {...localStorage}, {...sessionStorage}])")
    assert stored == '["",{},{}]', "scripts can read neither key nor session"


def test_the_page_can_still_change_something(page: Page, stage: Stage, key: str) -> None:
    job_id = stage.job("to be cancelled")
    page.goto("/sign-in")
    sign_in(page, key)
    expect(page.get_by_role("heading", name="Jobs", exact=True)).to_be_visible()
    page.goto(f"/jobs/{job_id}")
    page.on("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="Cancel job").click()
    expect(page.locator("#state")).to_have_text("cancelled")


def test_signing_out(page: Page, stage: Stage, key: str) -> None:
    page.goto("/sign-in")
    sign_in(page, key)
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_role("heading", name="Sign in")).to_be_visible()
    page.goto("/")
    expect(page.get_by_role("heading", name="Sign in")).to_be_visible()


@pytest.mark.parametrize("elsewhere", ["https://elsewhere.example/", "//elsewhere.example/", "javascript:alert(1)"])
def test_signing_in_leads_nowhere_else(page: Page, stage: Stage, key: str, elsewhere: str) -> None:
    page.goto(f"/sign-in?next={elsewhere}")
    sign_in(page, key)
    expect(page.get_by_role("heading", name="Jobs", exact=True)).to_be_visible()
    assert page.url.startswith(stage.url)
