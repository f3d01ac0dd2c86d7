"""A run that was interrupted and gone on with has the bits of one that was not, wherever it was interrupted."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatcore.checkpoint import VERSION, identity
from splatcore.grid import VolumeGrid
from splatcore.keeper import Keeper, Stopped, Wish
from splatcore.options import Options
from splatcore.progress import Progress
from splatcore.reconstruct import _KINDS, drain, reconstruct, resolved
from splatcore.reconstruction import Reconstruction
from splatcore.results import write_results
from splatcore.scan import Scan
from splatcore.simulate import Simulation
from splatcore.splats import Floats

from .phantom import scan_of

WHOLE = Options(threads=1, splats=3000)
PREVIEW = Options(threads=1, quality="preview", splats=2000)
METHODS = {
    "static": Options(threads=1, quality="preview", splats=2000, calibrate="static"),
    "r2": Options(threads=1, method="r2", splats=2000, steps=1200),
    "paper": Options(threads=1, method="paper", splats=2000, steps=300),
}


class StopAt(Keeper):
    """Asks to stop at the n-th of all moments at which a run may be interrupted, and counts them."""

    def __init__(self, file: Path | None, moment: int, wish: Wish = Wish.STOP) -> None:
        super().__init__(file, every_s=1e9)
        self.moments, self._moment, self._then = 0, moment, wish

    def pause(self, state: Callable[[], dict[str, Any]], stage_ends: bool = False) -> None:
        self.moments += 1
        if self.moments == self._moment:
            self.wish = self._then
        super().pause(state, stage_ends)


def bits(result: Reconstruction) -> list[bytes]:
    """All of a result that does not depend on the clock."""
    arrays = [
        *result.splats.arrays(), result.volume, result.corrected.packed(), result.corrections.rotation,
        result.sigma_rotation_deg, result.sigma_translation_mm, result.residual_rms,
    ]  # fmt: skip
    texts = [repr(result.report), repr(result.static), repr(result.static_sigma)]
    return [np.ascontiguousarray(a).tobytes() for a in arrays] + [text.encode() for text in texts]


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    what = Simulation(views=24, det=56, sigma_rot=0.03, sigma_trans=1.0, noise="r2", seed=3)
    return scan_of(tmp_path_factory.mktemp("scan"), what, edge=28)


class Watched(StopAt):
    """A run without interruption: its result, its events, the drafts that it showed."""

    def __init__(self, scan: Scan) -> None:
        super().__init__(None, 0)
        self.shown: list[tuple[Floats, VolumeGrid]] = []
        self.told: list[Progress] = []
        self.result = drain(self._listening(reconstruct(scan, WHOLE, self)))

    def show(self, draft: Callable[[], Floats], grid: VolumeGrid) -> bool:
        self.shown.append((draft(), grid))
        return True

    def _listening(
        self, events: Generator[Progress, None, Reconstruction]
    ) -> Generator[Progress, None, Reconstruction]:
        while True:
            try:
                self.told.append(next(events))
            except StopIteration as end:
                return end.value
            yield self.told[-1]


@pytest.fixture(scope="module")
def watched(scan: Scan) -> Watched:
    return Watched(scan)


@pytest.fixture(scope="module")
def whole(watched: Watched) -> tuple[list[bytes], int]:
    """The bits of a run without interruption, and at how many moments it might have been interrupted."""
    return bits(watched.result), watched.moments


def after_stops(scan: Scan, options: Options, file: Path, moments: list[int]) -> Reconstruction:
    """The result of a run that was stopped so often, each time so many moments after it had begun again."""
    for moment in moments:
        with pytest.raises(Stopped):
            drain(reconstruct(scan, options, StopAt(file, moment)))
        assert file.exists()
    return drain(reconstruct(scan, options, Keeper(file)))


def test_interruptions_of_a_preview(scan: Scan, tmp_path: Path) -> None:
    """In each of its stages, also soon after going on."""
    options = PREVIEW
    counter = StopAt(None, 0)
    expected = bits(drain(reconstruct(scan, options, counter)))
    step = counter.moments // 4
    assert bits(after_stops(scan, options, tmp_path / "run.checkpoint", [step, 1, step, step, 7])) == expected


# Shares of a run: in the coarsest level, in the finest before and after its first sweep, while the weight of the
# variation is chosen (two halves, then branches of them), in the last stage.
@pytest.mark.slow
@pytest.mark.parametrize("share", [0.05, 0.2, 0.35, 0.47, 0.55, 0.7, 0.8, 0.9, 0.99])
def test_one_interruption(scan: Scan, whole: tuple[list[bytes], int], share: float, tmp_path: Path) -> None:
    moment = int(share * whole[1])
    assert bits(after_stops(scan, WHOLE, tmp_path / "run.checkpoint", [moment])) == whole[0]


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, 0.6])
def test_an_interruption_while_halves_of_less_resolution_are_compared(
    scan: Scan, share: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatcore.reconstruct.FINE_VOXELS", 0)
    counter = StopAt(None, 0)
    expected = bits(drain(reconstruct(scan, WHOLE, counter)))
    moment = int(share * counter.moments)
    assert bits(after_stops(scan, WHOLE, tmp_path / "run.checkpoint", [moment])) == expected


@pytest.mark.slow
def test_an_interruption_between_sweeps_of_a_fine_level(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its only level, where a yaw that turns out to be none is let go halfway, in the 25th epoch."""
    monkeypatch.setattr("splatcore.reconstruct.FINE_VOXELS", 0)
    what = Simulation(views=24, det=56, sigma_rot=0.01, sigma_trans=0.5, noise="r2", seed=3)
    scan, options = scan_of(tmp_path, what, 28), Options(quality="preview", splats=800, threads=1)
    expected = bits(drain(reconstruct(scan, options)))
    assert bits(after_stops(scan, options, tmp_path / "run.checkpoint", [610, 25])) == expected


@pytest.mark.slow
def test_interruptions_again_and_again(scan: Scan, whole: tuple[list[bytes], int], tmp_path: Path) -> None:
    """In every stage, also soon after going on."""
    step = whole[1] // 6
    assert bits(after_stops(scan, WHOLE, tmp_path / "run.checkpoint", [step, 1, step, step, 7, step, step])) == whole[0]


@pytest.mark.parametrize(
    "method", [pytest.param("static", marks=pytest.mark.slow), pytest.param("r2", marks=pytest.mark.slow), "paper"]
)
def test_other_ways_to_reconstruct(scan: Scan, method: str, tmp_path: Path) -> None:
    options, counter = METHODS[method], StopAt(None, 0)
    expected = bits(drain(reconstruct(scan, options, counter)))
    stops = [counter.moments // 2 + 3, counter.moments // 4]
    assert bits(after_stops(scan, options, tmp_path / "run.checkpoint", stops)) == expected


def first_message(events: Generator[Progress, None, Reconstruction]) -> str:
    event = next(events)
    events.close()
    return event.message


@pytest.fixture
def kept(scan: Scan, tmp_path: Path) -> Path:
    """The state of a preview that was stopped half way."""
    file = tmp_path / "run.checkpoint"
    with pytest.raises(Stopped, match=r"run\.checkpoint"):
        drain(reconstruct(scan, PREVIEW, StopAt(file, 900)))
    return file


def resumed(scan: Scan, file: Path, **changes: Any) -> str:
    return first_message(reconstruct(scan, replace(PREVIEW, **changes), Keeper(file)))


def test_going_on_is_said(scan: Scan, kept: Path) -> None:
    assert resumed(scan, kept).startswith("Going on from the checkpoint")


def test_a_newer_file_means_that_the_run_got_further(scan: Scan, kept: Path) -> None:
    """By that a service tells a job which dies at one place from one that is being killed."""
    before = kept.stat().st_ino
    keeper = Keeper(kept, every_s=0.0)
    states: list[int] = []

    class Dead(Exception):
        pass

    def die() -> dict[str, Any]:
        raise Dead

    assert keeper.recall(lambda: identity(scan, resolved(scan, PREVIEW)), _KINDS)[0] is not None
    keeper.pause(die)  # due, but nothing has been done since
    assert kept.stat().st_ino == before
    keeper.pause(lambda: {"step": states.append(1) or 1})
    assert states and kept.stat().st_ino != before


def test_other_options_start_afresh_and_say_which(scan: Scan, kept: Path) -> None:
    assert "seed was 0, now 7" in resumed(scan, kept, seed=7)


def test_another_scan_starts_afresh(scan: Scan, kept: Path) -> None:
    brighter = replace(scan, projections=scan.projections * np.float32(1.01))
    assert "another scan" in resumed(brighter, kept)
    moved = replace(scan, frames=replace(scan.frames, source=scan.frames.source + 0.01))
    assert "another scan" in resumed(moved, kept)


@pytest.mark.parametrize("where", [0.001, 0.3, 0.6, 0.9])
def test_one_wrong_byte_anywhere_is_seen(scan: Scan, kept: Path, where: float) -> None:
    data = bytearray(kept.read_bytes())
    data[int(where * len(data))] ^= 0x40
    kept.write_bytes(data)
    message = resumed(scan, kept)
    assert message.startswith("The checkpoint is not used") and "beginning" in message


@pytest.mark.parametrize("left", [0.0, 0.5, 0.999])
def test_a_cut_file_starts_afresh(scan: Scan, kept: Path, left: float) -> None:
    data = kept.read_bytes()
    kept.write_bytes(data[: int(left * len(data))])
    assert "damaged" in resumed(scan, kept)


def test_a_newer_format_starts_afresh(scan: Scan, kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("splatcore.checkpoint.VERSION", VERSION + 1)
        kept.unlink()
        with pytest.raises(Stopped):
            drain(reconstruct(scan, PREVIEW, StopAt(kept, 50)))
    assert f"version {VERSION + 1}, expected {VERSION}" in resumed(scan, kept)


def test_no_code_is_run_from_a_file(scan: Scan, kept: Path) -> None:
    kept.write_bytes(b"\x80\x04c__builtin__\neval\n")
    assert "damaged" in resumed(scan, kept)


def test_a_state_that_cannot_be_written_ends_no_run(scan: Scan, tmp_path: Path) -> None:
    keeper = Keeper(tmp_path / "gone" / "run.checkpoint", every_s=0.0)
    said = []
    events = reconstruct(scan, PREVIEW, keeper)
    try:
        while True:
            said.append(next(events))
    except StopIteration as end:
        assert end.value.volume.any()
    troubles = [event.message for event in said if event.stage == "checkpoint"]
    assert troubles and "cannot be written" in troubles[0] and "No such file" in troubles[0]


@pytest.mark.slow
def test_the_volume_is_shown_as_it_stands(scan: Scan, watched: Watched) -> None:
    drafts = [event for event in watched.told if event.draft]
    assert [event.level for event in drafts] == [2, 1]
    assert [event.draft["shape"] for event in drafts if event.draft] == [[14, 14, 14], [28, 28, 28]]
    assert [list(grid.shape) for _, grid in watched.shown] == [[14, 14, 14], [28, 28, 28]]
    result, (last, _) = watched.result, watched.shown[-1]
    mass = [float(volume.sum()) * np.prod(grid.voxel_mm) for volume, grid in watched.shown]
    np.testing.assert_allclose(mass, float(result.volume.sum()) * np.prod(result.grid.voxel_mm), rtol=0.03)
    change = np.abs(last - result.volume)  # by the last stage, which was still to come
    assert 0 < change.max() < 0.3 * result.volume.max() and change.mean() < 0.02 * result.volume.max()


def test_writing_costs_less_than_a_hundredth() -> None:
    now = [0.0]
    written = []

    def slow_state() -> dict[str, Any]:
        written.append(now[0])
        now[0] += 2.0  # seconds
        return {}

    keeper = Keeper(Path(os.devnull) / "nowhere", every_s=10.0, clock=lambda: now[0])
    while now[0] < 10_000:
        keeper.pause(slow_state)
        now[0] += 0.5
    assert written[0] == 10.0 and np.diff(written).min() > 200
    assert 2.0 * len(written) / now[0] < 0.0101


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.2, 0.6, 0.95])
def test_a_run_may_end_with_what_it_has(
    scan: Scan, whole: tuple[list[bytes], int], share: float, tmp_path: Path
) -> None:
    keeper = StopAt(None, int(share * whole[1]), Wish.CONCLUDE)
    result = drain(reconstruct(scan, WHOLE, keeper))
    assert keeper.moments == int(share * whole[1])
    assert result.volume.shape == scan.volume.shape and result.volume.any()
    assert result.report["findings"][0]["name"] == "partial result"
    assert 0 < result.report["partial"]["fraction"] < 0.9 and "ended on request" in result.report["verdict"]
    write_results(result, tmp_path / "out")
    views = json.loads((tmp_path / "out" / "poses.json").read_text())["views"]
    assert len(views) == len(scan.frames)
