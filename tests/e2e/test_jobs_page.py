"""The list of jobs, live, in a real Chromium against the real server."""

from __future__ import annotations

import contextlib
import time
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from server.keys import KeyRing, Scope
from worker.contract import State

from .chromium import NEEDED
from .stage import Stage

pytestmark = NEEDED


def test_news_come_by_one_stream(page: Page, stage: Stage) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(urlsplit(request.url).path))
    page.goto("/")
    expect(page.get_by_role("heading", name="No jobs yet")).to_be_visible()
    first = stage.job("first")
    expect(page.locator("#rows tr")).to_have_count(1)
    stage.start(first)
    stage.say(first, stage="level", fraction=0.37, message="Fitting")
    expect(page.locator("#rows tr")).to_contain_text("37 %, 42 s left · Fitting")
    stage.job("second")
    expect(page.locator("#rows tr").nth(0)).to_contain_text("second")
    stage.finish(first)
    expect(page.locator("#rows tr").nth(1)).to_contain_text("succeeded")
    assert stage.ledger.forget(first)
    expect(page.locator("#rows tr")).to_have_count(1)
    expect(page.locator("#counts")).to_have_text("0 running · 1 waiting · 1 listed")
    assert asked.count("/v1/events") == 1 and "/v1/jobs" not in asked


def test_rows_of_other_jobs_stay_as_they_are(page: Page, stage: Stage) -> None:
    """Focus and selection are in them."""
    stage.job("quiet", State.CANCELLED, created_at=time.time() - 60)
    busy = stage.job("busy")
    page.goto("/")
    link = page.get_by_role("link", name="quiet")
    link.focus()
    page.evaluate("document.querySelectorAll('#rows tr')[1].kept = true")
    stage.start(busy)
    expect(page.locator("#rows tr").nth(0)).to_contain_text("running")
    expect(link).to_be_focused()
    assert page.evaluate("document.querySelectorAll('#rows tr')[1].kept") is True


def test_what_newer_jobs_push_out_stays_where_older_ones_are_shown(page: Page, stage: Stage) -> None:
    now = time.time()
    old = [stage.job(f"job {number}", State.CANCELLED, created_at=now - 10 - number) for number in range(55)]
    page.goto("/")
    rows = page.locator("#rows tr")
    expect(rows).to_have_count(50)
    page.get_by_role("button", name="Show older jobs").click()
    expect(rows).to_have_count(55)
    stage.job("new")
    expect(rows).to_have_count(56)
    assert stage.ledger.forget(old[3])
    expect(rows).to_have_count(55)
    names = page.locator("#rows th a").all_inner_texts()
    assert names == ["new", *(f"job {number}" for number in range(55) if number != 3)]


HIDE = """state => { Object.defineProperty(document, 'hidden', {get: () => state, configurable: true});
document.dispatchEvent(new Event('visibilitychange')); }"""


def test_older_jobs_are_asked_for_again_where_some_may_be_missing(page: Page, stage: Stage) -> None:
    now = time.time()
    for number in range(60):
        stage.job(f"job {number}", State.CANCELLED, created_at=now - 100 - number)
    page.goto("/")
    rows = page.locator("#rows tr")
    expect(rows).to_have_count(50)
    page.get_by_role("button", name="Show older jobs").click()
    expect(rows).to_have_count(60)
    page.evaluate(HIDE, True)
    for number in range(55):  # more than the page hears of at once
        stage.job(f"new {number}", State.CANCELLED, created_at=now - number)
    page.evaluate(HIDE, False)
    expect(rows.first).to_contain_text("new 0")
    expect(rows).to_have_count(50)
    for count in (100, 115):
        page.get_by_role("button", name="Show older jobs").click()
        expect(rows).to_have_count(count)
    expect(page.get_by_role("button", name="Show older jobs")).to_be_hidden()


def test_older_jobs_are_looked_at_now_and_then(browser: Browser, stage: Stage) -> None:
    now = time.time()
    for number in range(50):
        stage.job(f"job {number}", State.CANCELLED, created_at=now - number)
    waits, gone = stage.job("waits", created_at=now - 100), stage.job("gone", State.CANCELLED, created_at=now - 101)
    page = browser.new_page(base_url=stage.url)  # its console complains that a job waits and no worker is there
    page.goto("/")
    page.get_by_role("button", name="Show older jobs").click()
    rows = page.locator("#rows tr")
    expect(rows).to_have_count(52)
    expect(rows.nth(50)).to_contain_text("queued")
    assert stage.ledger.ask_cancel(waits) and stage.ledger.forget(gone)
    expect(rows.nth(50)).to_contain_text("cancelled", timeout=15_000)
    expect(rows).to_have_count(51)
    page.close()


def test_a_job_that_comes_while_older_ones_are_asked_for_hides_none(page: Page, stage: Stage) -> None:
    now = time.time()
    for number in range(55):
        stage.job(f"job {number}", State.CANCELLED, created_at=now - 10 - number)
    page.goto("/")
    page.get_by_role("button", name="Show older jobs").click()
    rows = page.locator("#rows tr")
    expect(rows).to_have_count(55)
    held: list[Route] = []
    page.route("**/v1/jobs?limit=5&before=*", lambda route: held.append(route))
    with page.expect_request("**/v1/jobs?limit=5&before=*", timeout=15_000):
        pass
    stage.job("new")
    expect(rows).to_have_count(56)
    with page.expect_response("**/v1/jobs?limit=5&before=*"):
        held[0].continue_()
    page.wait_for_timeout(200)  # for the page to take it in
    assert page.locator("#rows th a").all_inner_texts() == ["new", *(f"job {number}" for number in range(55))]


def test_asking_too_often_is_not_the_end(browser: Browser, stage: Stage) -> None:
    page = browser.new_page(base_url=stage.url)  # its console may complain
    refusal = '{"title": "Too many requests", "detail": "Too many requests."}'
    for path in ("**/v1/events", "**/v1/jobs?*"):
        page.route(path, lambda route: route.fulfill(status=429, content_type="application/json", body=refusal))
    page.goto("/")
    expect(page.locator("#connection")).to_have_text("Too many requests; trying again")
    page.unroute("**/v1/jobs?*")
    expect(page.get_by_role("heading", name="No jobs yet")).to_be_visible(timeout=10_000)
    expect(page.locator("#connection")).to_be_empty()
    page.close()


def test_after_a_restart_of_the_server_it_goes_on(browser: Browser, stage: Stage) -> None:
    stage.job("before")
    page = browser.new_page(base_url=stage.url)  # its console may complain
    page.goto("/")
    expect(page.locator("#rows tr")).to_have_count(1)
    stage.stop()
    expect(page.locator("#connection")).to_contain_text("does not answer")
    stage.job("meanwhile")
    stage.start_again()
    expect(page.locator("#rows tr")).to_have_count(2, timeout=15_000)
    expect(page.locator("#connection")).to_be_empty()
    page.close()


@pytest.mark.parametrize("trouble", ["no EventSource", "refused"])
def test_without_a_stream_it_is_polled(browser: Browser, stage: Stage, trouble: str) -> None:
    page = browser.new_page(base_url=stage.url)
    if trouble == "refused":
        page.route("**/v1/events", lambda route: route.fulfill(status=503, body="{}"))
    else:
        page.add_init_script("delete window.EventSource")
    page.goto("/")
    expect(page.get_by_role("heading", name="No jobs yet")).to_be_visible()
    stage.job("late")
    expect(page.locator("#rows tr")).to_have_count(1, timeout=10_000)
    page.close()


def test_a_hidden_page_holds_no_connection(page: Page, stage: Stage) -> None:
    opened: list[str] = []
    page.on("request", lambda request: opened.append(urlsplit(request.url).path))
    page.goto("/")
    expect(page.get_by_role("heading", name="No jobs yet")).to_be_visible()
    page.evaluate(HIDE, True)
    stage.job("unseen")
    page.wait_for_timeout(1500)
    expect(page.locator("#rows tr")).to_have_count(0)
    page.evaluate(HIDE, False)
    expect(page.locator("#rows tr")).to_have_count(1)
    assert opened.count("/v1/events") == 2


def test_a_tenant_s_list_holds_nobody_else_s_jobs(browser: Browser, stage: Stage) -> None:
    """Two people sign in, of two tenants: each sees their own, at the beginning and as they come."""
    pages: dict[str, Page] = {}
    with contextlib.ExitStack() as contexts:
        for tenant in ("lab-1", "lab-2"):
            stage.job(f"early of {tenant}", tenant=tenant)
        for tenant in ("lab-1", "lab-2"):
            key = KeyRing(stage.database).add(tenant, "somebody", [Scope.READ], None)[1]
            context = browser.new_context(base_url=stage.url)
            contexts.callback(context.close)
            page = pages[tenant] = context.new_page()
            page.goto("/")
            page.get_by_label("Key").fill(key)
            page.get_by_role("button", name="Sign in").click()
            expect(page.locator("#rows tr")).to_have_count(1)
        for tenant in ("lab-1", "lab-2"):
            stage.start(stage.job(f"late of {tenant}", tenant=tenant))
        for tenant, page in pages.items():
            expect(page.locator("#rows tr").nth(0)).to_contain_text("running")
            names = page.locator("#rows th a").all_inner_texts()
            assert names == [f"late of {tenant}", f"early of {tenant}"]
            expect(page.locator("#rows tr").nth(1)).to_contain_text("number 1 in line")
