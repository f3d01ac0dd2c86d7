"""What a reconstruction will cost, before it is run: memory, time, disk. Rough, and meant to err upwards.

Fitted to 75 views of 256^2 and 512^2 on grids of 128^3 and 256^3, two cores of a processor with AVX-512.
Standard library only: the server imports this module.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from splatcore.options import Options

_FEWEST_SPLATS, _MOST_SPLATS = 2_000, 2_000_000
_COMPARED = {"r2": 50_000, "paper": 50_000}  # splats of the methods that start with a fixed number
_PARAMETERS = 37  # float32 of a splat under optimisation: itself, raw parameters, Adam's moments
_STATES = 12  # descents at once, at most, in memory and in a checkpoint
_OF_NORMAL = {"preview": 0.3, "normal": 1.0, "fine": 1.5}  # time
_OF_FULL = {"full": 1.0, "static": 0.9, "none": 0.6}
_STEP_S = 0.034  # of the compared methods, with 50,000 splats and 512^2 pixels


@dataclass(frozen=True)
class Estimate:
    memory_bytes: int
    seconds: float  # on two cores
    disk_bytes: int  # results, and the state while it runs

    def to_json(self) -> dict[str, float]:
        return asdict(self)


def default_splats(voxels: int) -> int:
    """Gaussians at full resolution: in proportion to its edge, below 128 less."""
    edge = voxels ** (1 / 3) / 128
    return min(max(round(30_000 * min(edge**1.5, edge)), _FEWEST_SPLATS), _MOST_SPLATS)


def estimate(views: int, rows: int, cols: int, shape: Sequence[int], options: Options) -> Estimate:
    """Of a scan of so many views and pixels and a volume of `shape` voxels."""
    pixels, voxels = views * rows * cols, math.prod(shape)
    splats = options.splats or _COMPARED.get(options.method) or default_splats(voxels)
    state = 4 * _PARAMETERS * _STATES * splats
    memory = 400e6 + 4 * (3 * pixels + 4 * voxels) + max(0, state - 50e6)
    if options.method == "splatct":
        seconds = 95 * (pixels / (75 * 256**2)) ** 0.85 * max(1.0, voxels / max(pixels, 1)) ** 0.5
        seconds *= _OF_NORMAL[options.quality] * _OF_FULL[options.calibrate]
        seconds *= max(1.0, splats / default_splats(voxels)) ** 0.7
    else:
        seconds = (options.steps or 30_000) * _STEP_S * (rows * cols / 512**2) ** 0.5 * (splats / 50_000) ** 0.7
    disk = 4 * voxels + 44 * splats + state + 4000 * views + 2_000_000
    return Estimate(int(memory), round(max(5.0, seconds), 1), int(disk))


def warnings(found: Estimate, *, memory_free: int, disk_free: int, longest_s: float | None = None) -> list[str]:
    """What of an estimate does not fit; 0: unknown how much is free."""
    said = []
    if memory_free and found.memory_bytes > memory_free:
        said.append(
            f"it needs about {found.memory_bytes / 1e9:.1f} GB of memory, {memory_free / 1e9:.1f} GB are free: try "
            "quality preview, fewer splats or a smaller volume"
        )
    if disk_free and found.disk_bytes > disk_free:
        said.append(f"it writes about {found.disk_bytes / 1e9:.1f} GB, {disk_free / 1e9:.1f} GB of disk are free")
    if longest_s is not None and found.seconds > longest_s:
        said.append(
            f"it takes about {found.seconds / 3600:.1f} h, a job may run for {longest_s / 3600:.1f} h: it would be "
            "stopped then, with a partial result"
        )
    return said
