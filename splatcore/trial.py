"""A geometry on trial: a short reconstruction with fixed frames, from some of the views, to be judged by the others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatcore.descent import Descent, Rates
from splatcore.errors import ReconstructionError
from splatcore.geometry import Frames
from splatcore.planar import common_plane
from splatcore.pyramid import Level
from splatcore.start import first_splats

Indices = NDArray[np.int64]

_STEPS = 500
_SPLATS = 8_000
FEWEST_VIEWS = 16  # with fewer, views left out are missed more than they tell
_FEWEST_HELD_OUT, _SHARE = 4, 1 / 8


def held_out_views(views: int) -> Indices:
    """Indices of the views that take no part in a trial: an eighth, at least four, evenly spread; none of a scan of
    fewer than 16 views."""
    if views < FEWEST_VIEWS:
        return np.zeros(0, np.int64)
    count = max(_FEWEST_HELD_OUT, int(views * _SHARE))
    return np.asarray((np.arange(count) + 0.5) * views / count, np.int64)


def try_frames(
    here: Level,
    frames: Frames,
    kept: Indices,
    seed: int,
    threads: int,
    *,
    steps: int = _STEPS,
    of: int | None = None,
    splats: int = _SPLATS,
) -> Descent | None:
    """Splats after a short reconstruction from the kept views (indices) with these frames, and their renderer. None
    where the frames see nothing from these views. Trials with one seed draw the views in the same order.

    of: steps over which the rates fall, where the caller goes on after `steps`."""
    rng = np.random.default_rng(seed)
    try:
        start, unit = first_splats(here.images[kept], frames[kept], here.grid, splats, rng, threads)
    except ReconstructionError:
        return None
    top = float(here.images.max())
    descent = Descent(
        start, frames.rows, frames.cols, voxel_mm=here.voxel_mm, density_unit=unit,
        steps=of or steps, rates=Rates(), huber=1e-4 * top, dssim=0.0, data_range=top, threads=threads,
        plane=common_plane(frames),
    )  # fmt: skip
    packed, cone = frames.packed(), frames.beam == "cone"
    order: list[int] = []
    for _ in range(steps):
        order = order or list(rng.permutation(kept))
        view = order.pop()
        descent.step(packed[view], cone, here.images[view], here.mask)
    return descent
