"""What a running reconstruction says of itself: one event type for command line and worker.

Standard library only: the server imports this module.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Progress:
    """One event. `fraction` is the share of the expected work done, 0 to 1, never falling.

    stage: "read", "start", "level", "poses", "refine", "checkpoint" (it could not be written), "diagnose", "write" or
    "done".
    message: one plain sentence.  loss: mean absolute residual in line-integral units.
    moved_deg, moved_mm: RMS change of the poses in the last sweep (stage "poses").
    draft: the volume as it stands can be seen; its `shape` and `voxel_mm`, [z, y, x].
    """

    stage: str
    fraction: float
    message: str
    seconds: float = 0.0
    level: int | None = None  # detector binning of the present level: 8, 4, 2, 1
    step: int | None = None
    loss: float | None = None
    splats: int | None = None
    moved_deg: float | None = None
    moved_mm: float | None = None
    draft: dict[str, Any] | None = None

    def to_json(self) -> dict[str, Any]:
        return {k: v for k, v in dataclasses.asdict(self).items() if v is not None}
