"""The page of one job, live and with its controls, in a real Chromium against the real server."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from playwright.sync_api import Browser, Page, Request, expect

from worker.contract import State
from worker.jobfolder import JobFolder

from ..http.stack import commit, scan_files
from .chromium import NEEDED
from .stage import Stage, progress_events

pytestmark = NEEDED


@pytest.fixture
def real(stage: Stage) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=stage.url, trust_env=False, timeout=30) as http:
        yield http


def asked(page: Page) -> list[Request]:
    """Every request of the page from here on."""
    requests: list[Request] = []
    page.on("request", lambda request: requests.append(request))
    return requests


def losses(page: Page, count: int) -> None:
    """That many points are drawn."""
    expect(page.get_by_role("img", name=re.compile(rf"over step, {count} points"))).to_be_visible(timeout=15_000)


def test_news_come_by_one_stream(page: Page, stage: Stage) -> None:
    job = stage.job("teapot")
    requests = asked(page)
    page.goto(f"/jobs/{job}")
    expect(page.locator("#message")).to_have_text("Waiting, number 1 in line")
    stage.start(job)
    events = list(progress_events())
    for event in events[:30]:
        stage.say(job, **event)
    losses(page, sum("loss" in event for event in events[:30]))
    expect(page.locator("#eta")).to_have_text("about 42 s left")
    stage.ledger.ask_cancel(job)
    expect(page.locator("#state")).to_have_text("cancelling")
    stage.ledger.end_cancel(job, 1)
    expect(page.locator("#state")).to_have_text("cancelled")
    page.wait_for_timeout(2500)
    paths = [urlsplit(request.url).path for request in requests]
    assert paths.count(f"/v1/jobs/{job}/events/stream") == 1, "and it is not opened again after the end"
    assert paths.count(f"/v1/jobs/{job}") == 1, "nothing is polled beside it"


def test_after_a_cut_it_goes_on_from_the_last_event(browser: Browser, stage: Stage) -> None:
    """Its console may complain: the server is away for a while."""
    page = browser.new_page(base_url=stage.url)
    job = stage.job("teapot")
    stage.start(job)
    events = list(progress_events())
    for event in events[:20]:
        stage.say(job, **event)
    page.goto(f"/jobs/{job}")
    losses(page, sum("loss" in event for event in events[:20]))
    stage.say(job, **events[20])  # one that comes by the stream, so that the browser knows its id
    losses(page, sum("loss" in event for event in events[:21]))
    requests = asked(page)
    stage.stop()
    expect(page.locator("#connection")).to_have_text("The server does not answer; trying again")
    for event in events[21:40]:
        stage.say(job, **event)
    stage.start_again()
    losses(page, sum("loss" in event for event in events[:40]))
    expect(page.locator("#connection")).to_have_text("")
    streams = [request for request in requests if "/events/stream" in request.url]
    assert streams and all(request.all_headers()["last-event-id"] == "21" for request in streams)
    assert not any(urlsplit(request.url).path.endswith("/events") for request in requests), "no replay by hand"
    page.close()


@pytest.mark.parametrize("trouble", ["no EventSource", "refused"])
def test_without_a_stream_it_is_polled(browser: Browser, stage: Stage, trouble: str) -> None:
    page = browser.new_page(base_url=stage.url)
    if trouble == "refused":
        page.route("**/events/stream*", lambda route: route.fulfill(status=503, body="{}"))
    else:
        page.add_init_script("delete window.EventSource")
    job = stage.job("teapot")
    page.goto(f"/jobs/{job}")
    expect(page.locator("#state")).to_have_text("queued")
    stage.start(job)
    events = list(progress_events())
    for event in events:
        stage.say(job, **event)
    losses(page, sum("loss" in event for event in events))
    stage.finish(job)
    expect(page.locator("#verdict-text")).to_contain_text("centre of rotation", timeout=15_000)
    page.close()


def test_a_hidden_page_holds_no_connection(page: Page, stage: Stage) -> None:
    job = stage.job("teapot")
    stage.start(job)
    with page.expect_response("**/events/stream*"):
        page.goto(f"/jobs/{job}")
    expect(page.locator("#state")).to_have_text("running")
    requests = asked(page)
    hide = "hidden => { Object.defineProperty(document, 'hidden', { value: hidden, configurable: true }); "
    hide += "document.dispatchEvent(new Event('visibilitychange')); }"
    page.evaluate(hide, True)
    stage.say(job, stage="level", fraction=0.5, message="Fitting", step=1, loss=0.1)
    page.wait_for_timeout(1500)
    assert not requests and page.locator("#message").text_content() == "Starting"
    page.evaluate(hide, False)
    expect(page.locator("#message")).to_have_text("Fitting")
    losses(page, 1)


def test_priority_and_pin(page: Page, stage: Stage) -> None:
    first, job = stage.job("first"), stage.job("second")
    page.goto(f"/jobs/{job}")
    expect(page.locator("#message")).to_have_text("Waiting, number 2 in line")
    page.get_by_label("Priority").first.select_option("high")
    expect(page.locator("#message")).to_have_text("Waiting, number 1 in line")
    row = stage.ledger.get(job)
    assert row is not None and row.priority == 1
    pin = page.get_by_role("button", name="Pin", exact=True)
    pin.press("Enter")
    pinned = page.get_by_role("button", name="Pinned", pressed=True)
    expect(pinned).to_be_visible()
    row = stage.ledger.get(job)
    assert row is not None and row.pinned
    pinned.click()
    expect(page.get_by_role("button", name="Pin", exact=True, pressed=False)).to_be_visible()
    page.goto(f"/jobs/{first}")
    expect(page.locator("#message")).to_have_text("Waiting, number 2 in line")


def test_a_job_is_deleted(page: Page, stage: Stage) -> None:
    job = stage.job("old", State.CANCELLED)
    page.goto(f"/jobs/{job}")
    page.once("dialog", lambda dialog: dialog.dismiss())
    page.get_by_role("button", name="Delete job").click()
    assert stage.ledger.get(job) is not None, "who thinks better of it keeps it"
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="Delete job").click()
    page.wait_for_url("**/")
    expect(page.get_by_role("heading", name="No jobs yet")).to_be_visible()
    assert stage.ledger.get(job) is None


def test_it_is_run_again_with_other_options(page: Page, stage: Stage, real: httpx.Client) -> None:
    scan_id = commit(real, scan_files())
    body: dict[str, Any] = {"scan_id": scan_id, "options": {"seed": 5}, "name": "Prüfling"}
    job = real.post("/v1/jobs", json=body).json()["id"]
    real.post(f"/v1/jobs/{job}/cancel")
    page.goto(f"/jobs/{job}")
    page.locator("#again-form summary").click()
    form = page.locator("#again-form")
    expect(form.get_by_label("seed")).to_have_value("5")
    form.get_by_label("calibrate").select_option("none")
    form.get_by_label("exposure").select_option("false")
    form.get_by_label("splats").fill("5000")
    form.get_by_label("Name").fill("Prüfling, ruhig")
    form.get_by_label("Priority").select_option("low")
    form.get_by_role("button", name="Run again").click()
    page.wait_for_url(lambda url: job not in url)
    expect(page.get_by_role("heading", level=1)).to_have_text("Prüfling, ruhig")
    made = real.get(f"/v1/jobs/{urlsplit(page.url).path.rpartition('/')[2]}").json()
    wanted = {"calibrate": "none", "exposure": False, "splats": 5000, "seed": 5}
    assert {name: made["options"][name] for name in wanted} == wanted
    assert (made["restart_of"], made["priority"]) == (job, "low")
    expect(page.get_by_role("link", name="an earlier job")).to_have_attribute("href", f"/jobs/{job}")


def test_the_log_is_there_to_read(page: Page, stage: Stage) -> None:
    job = stage.job("teapot")
    stage.start(job)
    log = JobFolder(stage.data, job).log
    log.write_text("".join(f"line {n} <b>bold</b>\n" for n in range(5000)))
    page.goto(f"/jobs/{job}")
    page.get_by_text("Engine's log", exact=True).click()
    pane = page.get_by_role("region", name="The end of the engine's log")
    expect(pane).to_contain_text("line 4999 <b>bold</b>")
    assert "line 10 " not in (pane.text_content() or "") and pane.locator("b").count() == 0
    log.write_text("another attempt\n")
    page.get_by_role("button", name="Read again").click()
    expect(pane).to_have_text("another attempt")


CONTRAST = """() => {
  const parse = (text) => (text.match(/[\\d.]+/g) ?? []).map(Number);
  const light = (c) => { const s = c / 255; return s <= 0.04045 ? s / 12.92 : ((s + 0.055) / 1.055) ** 2.4; };
  const luminance = ([r, g, b]) => 0.2126 * light(r) + 0.7152 * light(g) + 0.0722 * light(b);
  const ground = (node) => {
    for (let at = node; at; at = at.parentElement) {
      const colour = parse(getComputedStyle(at).backgroundColor);
      if (colour.length === 3 || colour[3] > 0.99) return colour;
    }
    return [255, 255, 255];
  };
  const poor = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode.parentElement;
    const bare = walker.currentNode.textContent.trim();
    if (!bare || !node.checkVisibility() || node.closest("svg, :disabled, option")) continue;
    const [one, other] = [luminance(parse(getComputedStyle(node).color)), luminance(ground(node))];
    const ratio = (Math.max(one, other) + 0.05) / (Math.min(one, other) + 0.05);
    if (ratio < 4.5) poor.push(`${bare.slice(0, 40)}: ${ratio.toFixed(2)}`);
  }
  return poor;
}"""

UNNAMED = """() => [...document.querySelectorAll("button, input, select, a, summary, [tabindex='0']")]
  .filter((node) => node.checkVisibility())
  .filter((node) => !(node.labels?.length || node.getAttribute("aria-label") || node.textContent.trim()))
  .map((node) => node.outerHTML)"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("end", ["waiting", "done", "failed"])
def test_all_of_it_can_be_read_and_has_a_name(page: Page, stage: Stage, scheme: Any, end: str) -> None:
    """Text stands out by 4.5 to 1 (WCAG 2.2 AA), in both colour schemes; what takes keys says what it is."""
    job = stage.job("teapot") if end != "failed" else stage.job("x", State.FAILED, error_message="no signal")
    if end == "done":
        stage.start(job)
        stage.finish(job)
    page.emulate_media(color_scheme=scheme)
    page.goto(f"/jobs/{job}")
    expect(page.locator("#details")).to_be_visible()
    if end != "waiting":
        expect(page.get_by_role("button", name="Run again")).to_be_visible()
        page.locator("#again-form summary").click()
    page.get_by_text("Engine's log", exact=True).click()
    assert page.evaluate(CONTRAST) == []
    assert page.evaluate(UNNAMED) == []
    page.goto("/")
    expect(page.locator("#rows tr")).to_have_count(1)
    assert page.evaluate(CONTRAST) == [] and page.evaluate(UNNAMED) == []


def test_a_reader_s_key_sees_no_controls(browser: Browser, stage: Stage) -> None:
    from server.keys import KeyRing, Scope

    job = stage.job("teapot", State.CANCELLED, tenant="lab")
    _, key = KeyRing(stage.database).add("lab", "", [Scope.READ], None)
    with contextlib.closing(browser.new_page(base_url=stage.url)) as page:
        page.goto("/sign-in")
        page.get_by_label("Key").fill(key)
        page.get_by_role("button", name="Sign in").click()
        page.wait_for_url("**/")
        page.goto(f"/jobs/{job}")
        expect(page.locator("#details")).to_be_visible()
        expect(page.locator("#who")).to_have_text("lab")
        for control in ("#cancel", "#delete", "#pin", "#place", "#again"):
            expect(page.locator(control)).to_be_hidden()
