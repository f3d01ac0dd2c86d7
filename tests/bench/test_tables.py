"""The arithmetic of the tables, and that nothing is dropped from them in silence."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from bench.coverage import COMPONENTS
from bench.paper import plan, tables
from bench.paper.cells import METHODS, Cell
from bench.paper.run import Outcome
from bench.paper.scans import ScanSpec

HEAD = ScanSpec("head")
CHEST = ScanSpec("chest")


def outcome(scan: ScanSpec, label: str, psnr: float | None, **more: float) -> Outcome:
    """A cell with one PSNR, raw and aligned alike; None: it failed."""
    cell = Cell(scan, METHODS[label])
    if psnr is None:
        return Outcome(cell, None, "out | of memory")
    return Outcome(cell, {"psnr": psnr, "psnr_aligned": psnr, **more})


def cells_of(text: str, first: str) -> list[str]:
    """The row of a Markdown table that starts with `first`."""
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {first} |")]
    return [part.strip() for part in line.strip("|").split("|")]


def test_the_share_of_the_gain_is_one_for_true_frames_and_none_for_nominal_ones() -> None:
    assert tables.share_of_gain(20, 30, 30) == 1
    assert tables.share_of_gain(20, 20, 30) == 0
    assert tables.share_of_gain(20, 18, 30) == pytest.approx(-0.2)
    assert math.isnan(tables.share_of_gain(30, 30, 30)), "true frames that bring nothing leave nothing to share"
    assert math.isnan(tables.share_of_gain(20, math.nan, 30))


def test_stated_uncertainties_are_averaged_over_components_and_scans() -> None:
    def covered(share: float) -> dict[str, dict[str, float]]:
        return {"within_1": dict.fromkeys(COMPONENTS, share) | {"rz": 0.0}, "within_2": dict.fromkeys(COMPONENTS, 1.0)}

    scores = {"psnr": 38.0, "psnr_aligned": 38.0}
    found = tables.Found(
        [
            Outcome(Cell(HEAD, METHODS["ours"]), {**scores, "coverage": covered(0.6)}),
            Outcome(Cell(CHEST, METHODS["ours"]), {**scores, "coverage": covered(0.9)}),
            Outcome(Cell(HEAD, METHODS["ceiling"]), {**scores, "coverage": None}),
        ]
    )
    text = tables.uncertainties(found)
    assert cells_of(text, "head (own)")[1:8] == ["0.60", "0.60", "0.00", "0.60", "0.60", "0.60", "0.50"]
    assert cells_of(text, "mean")[1:8] == ["0.75", "0.75", "0.00", "0.75", "0.75", "0.75", "0.62"]
    assert cells_of(text, "mean")[8:] == ["1.00"] * 7
    assert tables.uncertainties(tables.Found([outcome(HEAD, "ours", 38)])) == "None stated."


def test_means_are_of_what_is_there() -> None:
    assert tables.mean([1, math.nan, 3]) == 2
    assert math.isnan(tables.mean([math.nan]))


def test_headline_puts_ours_below_the_ceiling_and_the_mean_at_the_end() -> None:
    found = tables.Found(
        [
            outcome(HEAD, "ours", 38, rot_deg_aligned=0.03),
            outcome(HEAD, "ceiling", 38.5),
            outcome(CHEST, "ours", 34, rot_deg_aligned=0.05),
            outcome(CHEST, "ceiling", 34.1),
        ]
    )
    text = tables.headline(found)
    head, chest, mean = (cells_of(text, name) for name in ("head (own)", "chest (own)", "mean"))
    below, rotation = 6, 7
    assert (head[below], chest[below], mean[below]) == ("0.50", "0.10", "0.30")
    assert mean[rotation] == "0.040"
    assert head[-1] == "30.91 → 34.84"
    assert head[1] == "—", "a method that was not run is a dash"


def test_a_failed_cell_is_a_dash_in_the_table_and_a_row_among_the_failures() -> None:
    found = tables.Found([outcome(HEAD, "ours", 38), outcome(HEAD, "ceiling", None)])
    row = cells_of(tables.headline(found), "head (own)")
    assert (row[4], row[5], row[6]) == ("38.00", "—", "—")
    assert "head 128^3 0.03/1 75 views (own): ceiling | out \\| of memory |" in tables.failures(found)
    assert tables.failures(tables.Found([outcome(HEAD, "ours", 38)])) == "None."


def test_noise_levels_come_in_the_papers_order_beside_its_head() -> None:
    scans = [replace(HEAD, sigma_rot=rot, sigma_trans=trans) for rot, trans in reversed(plan.NOISES)]
    text = tables.noise(tables.Found(outcome(scan, "ours", 37) for scan in scans))
    levels = [line.split("|")[1].strip() for line in text.splitlines()[2:-2]]
    assert levels == ["0 / 0", "0.01 / 0.5", "0.02 / 1", "0.03 / 1", "0.05 / 2.5", "0.1 / 5"]
    assert cells_of(text, "0.1 / 5")[-1] == "26.41 → 28.17"
    assert cells_of(text, "0.03 / 1")[-1] == "—"


def test_the_loss_of_free_poses_is_of_raw_psnr() -> None:
    good = replace(HEAD, sigma_rot=0.0, sigma_trans=0.0)
    ours = Outcome(Cell(good, METHODS["ours"]), {"psnr": 38.98, "psnr_aligned": 39.5, "verdict": "good"})
    row = cells_of(tables.right(tables.Found([outcome(good, "nominal", 39), ours])), "head (own)")
    assert (row[3], row[-1]) == ("0.020", "good")


def test_rtk_shares_are_of_aligned_volumes() -> None:
    psnrs = {"nominal": 20, "ours": 29, "true": 30}
    parts = [outcome(HEAD, f"RTK FDK, {frames}", psnr) for frames, psnr in psnrs.items()]
    assert cells_of(tables.rtk(tables.Found(parts)), "FDK")[-1] == "90.0 %"


@pytest.mark.parametrize("preset", list(plan.PRESETS))
def test_every_preset_has_cells_and_tables_that_stand_without_scores(preset: str) -> None:
    extent = plan.Extent(("head", "teapot"), 128, ("own", "rtk"), seed=0, steps=None)
    cells = plan.PRESETS[preset](extent)
    assert cells and len({cell.key for cell in cells}) == len(cells)
    for title, make in tables.TABLES[preset]:
        text = make(tables.Found(Outcome(cell, None, "not run") for cell in cells))
        widths = {line.count("|") for line in text.split("\n\n")[0].splitlines()}
        assert title and len(widths) == 1
