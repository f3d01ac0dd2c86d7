"""The status page in a real Chromium, against the real server."""

from __future__ import annotations

import re
import time

import pytest
from playwright.sync_api import Browser, Page, expect

from worker.contract import ErrorKind, State

from .chromium import NEEDED
from .stage import Stage, progress_events

pytestmark = NEEDED


def test_an_empty_list_tells_what_to_do(page: Page, stage: Stage) -> None:
    page.goto("/")
    expect(page.get_by_role("heading", name="No jobs yet")).to_be_visible()
    expect(page.locator("#command")).to_have_text(f"splatct submit SCAN_FOLDER --server {stage.url} -o RESULTS")


def test_the_list_follows_its_jobs(page: Page, stage: Stage) -> None:
    now = time.time()
    first = stage.job("first", created_at=now - 2)
    stage.job("second", created_at=now - 1)
    page.goto("/")
    rows = page.locator("#rows tr")
    expect(rows).to_have_count(2)
    expect(rows.nth(0)).to_contain_text("second")
    expect(rows.nth(0)).to_contain_text("number 2 in line")
    stage.start(first)
    stage.say(first, stage="level", fraction=0.37, message="Fitting")
    expect(rows.nth(1)).to_contain_text("running")
    expect(rows.nth(1)).to_contain_text("37 %, 42 s left · Fitting")
    expect(page.locator("#counts")).to_have_text("1 running · 1 waiting · 2 listed")


def test_older_jobs_come_when_asked_for(page: Page, stage: Stage) -> None:
    for number in range(60):
        stage.job(f"job {number}", State.CANCELLED, created_at=time.time() - number)
    page.goto("/")
    expect(page.locator("#rows tr")).to_have_count(50)
    page.get_by_role("button", name="Show older jobs").click()
    expect(page.locator("#rows tr")).to_have_count(60)
    expect(page.get_by_role("button", name="Show older jobs")).to_be_hidden()


def test_a_job_from_the_queue_to_its_results(page: Page, stage: Stage) -> None:
    job = stage.job("teapot")
    page.goto(f"/jobs/{job}")
    expect(page.locator("#state")).to_have_text("queued")
    expect(page).to_have_title("queued · teapot · SplatCT")

    stage.start(job)
    events = list(progress_events())
    for event in events[:30]:
        stage.say(job, **event)
    expect(page.locator("#message")).to_have_text(events[29]["message"])
    expect(page.locator("#stages .now")).to_have_text("Fit splats and poses")
    losses = sum("loss" in event for event in events[:30])
    picture = page.get_by_role("img", name=f"Residual: mean |residual| over step, {losses} points")
    expect(picture).to_be_visible()
    for event in events[30:]:
        stage.say(job, **event)
    losses = sum("loss" in event for event in events)
    expect(page.get_by_role("img", name=f"over step, {losses} points")).to_be_visible()
    expect(page.get_by_role("img", name="Pose motion, rotation: RMS change, ° over sweep, 3 points")).to_be_visible()

    stage.finish(job)
    expect(page.locator("#state")).to_have_text("succeeded")
    expect(page.locator("#verdict-text")).to_contain_text("centre of rotation was 2.3 pixels off")
    findings = page.locator("#findings > li")
    expect(findings).to_have_count(3)
    expect(findings.nth(0)).to_contain_text("problem")  # the worst comes first
    rotation = page.get_by_role("img", name="Rotation: about x, y, z, ° over view, 225 points")
    rotation.hover(position={"x": 58, "y": 80})
    readout = page.locator("figure", has=rotation).locator("output")
    expect(readout).to_have_text("view 0: x 0 ± 0.05, y 0 ± 0.06, z 0 ± 0.02")
    expect(page.locator("#static")).to_contain_text("not determined")
    expect(page.locator("#file-rows tr")).to_have_count(5)
    expect(page.locator("#progress-panel")).to_be_hidden()
    check_slices(page)


def test_the_volume_so_far_is_shown_and_sharpens(page: Page, stage: Stage) -> None:
    job = stage.job("teapot")
    stage.start(job)
    page.goto(f"/jobs/{job}")
    expect(page.locator("#state")).to_have_text("running")
    expect(page.locator("#slices")).to_be_hidden()
    stage.show_draft(job, 8)
    expect(page.get_by_role("heading", name="Volume so far, 8 × 8 × 8 voxels")).to_be_visible()
    axial = page.get_by_role("img", name="Axial slice at z 4 of 7")
    expect(axial).to_be_visible()
    assert axial.evaluate("image => image.naturalWidth") == 8
    page.get_by_role("slider", name="Axial slice, z").press("End")
    expect(page.get_by_role("img", name="Axial slice at z 7 of 7")).to_be_visible()
    stage.show_draft(job, 16)  # the slider stays where it was, as a share of the volume
    expect(page.get_by_role("img", name="Axial slice at z 15 of 15")).to_be_visible()
    page.reload()  # who comes later sees it, too
    expect(page.get_by_role("heading", name="Volume so far, 16 × 16 × 16 voxels")).to_be_visible()
    stage.finish(job)
    expect(page.get_by_role("heading", name="Volume", exact=True)).to_be_visible()
    expect(page.get_by_role("img", name="Axial slice at z 20 of 39")).to_be_visible()


def test_a_draft_goes_with_a_job_that_leaves_nothing(page: Page, stage: Stage) -> None:
    job = stage.job("teapot")
    stage.start(job)
    stage.show_draft(job, 8)
    page.goto(f"/jobs/{job}")
    expect(page.get_by_role("heading", name="Volume so far, 8 × 8 × 8 voxels")).to_be_visible()
    # All three have come: a slice still asked for when the job fails is refused, which the browser itself complains of.
    expect(page.get_by_role("img", name=re.compile(r"slice at [xyz] 4 of 7"))).to_have_count(3)
    assert stage.ledger.fail(job, 1, ErrorKind.CRASHED, "It died")
    expect(page.locator("#state")).to_have_text("failed")
    expect(page.locator("#slices")).to_be_hidden()


def check_slices(page: Page) -> None:
    axial = page.get_by_role("img", name="Axial slice at z 20 of 39")
    expect(axial).to_be_visible()
    assert axial.evaluate("image => [image.naturalWidth, image.naturalHeight]") == [64, 56]
    expect(page.get_by_role("img", name="Coronal slice at y 28 of 55")).to_be_visible()
    expect(page.get_by_role("img", name="Sagittal slice at x 32 of 63")).to_be_visible()
    before = axial.get_attribute("src")
    page.get_by_role("slider", name="Axial slice, z").press("ArrowRight")
    moved = page.get_by_role("img", name="Axial slice at z 21 of 39")
    expect(moved).to_be_visible()
    assert "/z/21.png" in (moved.get_attribute("src") or "") and before != moved.get_attribute("src")

    # The volume holds noise about 0 and matter of 0.02 and 0.05; the automatic window must find it.
    low, high = (page.locator(f"#{id}").evaluate("input => input.valueAsNumber") for id in ("low", "high"))
    assert -0.01 < low < 0.001 and 0.04 < high < 0.06
    page.get_by_role("slider", name="White").press("Home")
    low, high = (page.locator(f"#{id}").evaluate("input => input.valueAsNumber") for id in ("low", "high"))
    assert low < high < 0.0
    page.get_by_role("button", name="Automatic").click()
    expect(page.locator("#high-text")).to_contain_text("0.05")


def test_a_failed_job_says_why_and_stays_text(page: Page, stage: Stage) -> None:
    hostile = "<img src=x onerror=alert(1)>"
    job = stage.job(hostile, State.FAILED, error_kind="cannot_reconstruct", error_message=f"no signal {hostile}")
    page.goto(f"/jobs/{job}")
    expect(page.locator("#failure-text")).to_have_text(f"no signal {hostile}")
    expect(page.get_by_role("heading", level=1)).to_have_text(hostile)
    page.goto("/")
    expect(page.locator("#rows tr")).to_contain_text(hostile)
    assert page.locator("#main img").count() == 0


def test_a_hostile_report_stays_text(page: Page, stage: Stage) -> None:
    hostile = "<script>document.title='owned'</script><b>x</b>"
    job = stage.job("teapot")
    stage.start(job)
    finding = {"name": hostile, "severity": hostile, "text": hostile, "evidence": {hostile: hostile}}
    stage.finish(job, {"verdict": [hostile], "findings": [finding]})
    page.goto(f"/jobs/{job}")
    expect(page.locator("#verdict-text")).to_have_text(hostile)
    expect(page.get_by_role("img", name="Axial slice")).to_be_visible()
    assert page.locator("#verdict script, #verdict b").count() == 0
    assert page.title() == "succeeded · teapot · SplatCT"


def test_what_a_cancelled_job_had_is_shown(page: Page, stage: Stage) -> None:
    job_id = stage.job("cut short")
    stage.start(job_id)
    stage.end_early(job_id)
    page.goto(f"/jobs/{job_id}")
    expect(page.locator("#state")).to_have_text("cancelled")
    expect(page.locator("#files-heading")).to_have_text("Files of the partial result")
    expect(page.locator("#fetch-command")).to_have_text(f"splatct fetch {job_id} --partial -o RESULTS")
    expect(page.locator("#verdict-text")).to_contain_text("The scan is usable")
    expect(page.locator("#views img").first).to_be_visible()
    link = page.get_by_role("link", name="poses.json")
    assert page.request.get(str(link.get_attribute("href"))).ok


def test_a_job_is_cancelled_from_the_page(page: Page, stage: Stage) -> None:
    job = stage.job("teapot")
    page.goto(f"/jobs/{job}")
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="Cancel job").click()
    expect(page.locator("#state")).to_have_text("cancelled")
    row = stage.ledger.get(job)
    assert row is not None and row.state is State.CANCELLED


def test_waiting_for_nobody_is_explained(browser: Browser, stage: Stage) -> None:
    stage.job("teapot", created_at=time.time() - 60)
    page = browser.new_page(base_url=stage.url)  # its console may complain: the server is not ready
    page.goto("/")
    expect(page.locator("#notice")).to_contain_text("wait for Redis")
    page.close()


def test_a_job_that_is_not_there(browser: Browser, stage: Stage) -> None:
    for job in ("6a1f6f0e-0000-4000-8000-000000000001", "nonsense"):
        page = browser.new_page(base_url=stage.url)
        page.goto(f"/jobs/{job}")
        expect(page.get_by_role("heading", level=1)).to_have_text("No such job")
        page.close()


def test_a_new_attempt_starts_its_curve_afresh(page: Page, stage: Stage) -> None:
    job = stage.job("teapot")
    stage.start(job)
    for attempt, count in ((1, 30), (2, 5)):
        for step in range(count):
            event = {"stage": "level", "message": "Fitting", "fraction": 0.1, "step": step, "loss": 0.1 / (step + 1)}
            stage.say(job, **event, attempt=attempt)
    page.goto(f"/jobs/{job}")
    expect(page.get_by_role("img", name="over step, 5 points")).to_be_visible()


@pytest.mark.parametrize("path", ["/", "/jobs/JOB"])
def test_nothing_sticks_out_of_a_narrow_window(page: Page, stage: Stage, path: str) -> None:
    job = stage.job("a_name_without_a_single_space_in_it_as_scanners_make_up_20261104_113355")
    stage.start(job)
    stage.say(job, stage="level", fraction=0.5, message="Fitting", step=1, loss=0.1)
    stage.finish(job)
    page.set_viewport_size({"width": 360, "height": 700})
    page.goto(path.replace("JOB", job))
    expect(page.get_by_text("succeeded").first).to_be_visible()
    if "JOB" in path:
        expect(page.get_by_role("img", name="Sagittal slice")).to_be_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= 360


def test_everything_is_reached_by_keyboard(page: Page, stage: Stage) -> None:
    stage.job("teapot", State.CANCELLED)
    page.goto("/")
    expect(page.locator("#rows tr")).to_have_count(1)
    reached = []
    for _ in range(6):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.textContent.trim()"))
    assert reached == ["Skip to the content", "SplatCT", "Jobs", "API", "teapot", "Copy"]
