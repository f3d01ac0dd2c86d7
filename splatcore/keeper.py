"""Keeps a run's state while it runs, and brings it what others wish: to stop, or to end with what it has.

A run calls `pause` between any two steps, with a function that tells its state; that costs a look at a clock. The
state is written when it is due. Writing is kept below a hundredth of the run by waiting a hundred times as long as the
last one took, where that is longer than `every_s`.

    keeper = Keeper(Path("run.checkpoint"))
    events = reconstruct(scan, options, keeper)   # goes on from the file, if it can
    keeper.wish = Wish.STOP                       # from a signal handler, another thread, or between two events
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatcore.errors import CheckpointError, SplatCTError

if TYPE_CHECKING:  # who only sets a wish need not wait for numpy
    from splatcore.grid import VolumeGrid
    from splatcore.splats import Floats

EVERY_S = 10.0
FILE = "run.checkpoint"
_SHARE = 0.01  # of the run that may go into writing
_EARLY = 0.1  # of the time between two states, after which the end of a stage is worth one

State = dict[str, Any]


class Wish(Enum):
    """What others want of a run."""

    GO_ON = "go on"
    STOP = "stop"  # write the state and raise Stopped
    CONCLUDE = "conclude"  # raise Concluding; the run then ends with the volume and the poses as they are


class Stopped(SplatCTError):
    """A run ended because it was asked to, its state kept if it has a file for it."""

    exit_code = 130


class Concluding(Exception):
    """Within a run alone: it is to end with what it has."""


class Keeper:
    """Of one run. Without a file nothing is kept, but wishes are heeded."""

    def __init__(
        self, file: Path | None = None, every_s: float = EVERY_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.file, self._every_s, self._clock = file, every_s, clock
        self.wish = Wish.GO_ON
        self.concluded = False  # the run was ended with what it had
        self.trouble = ""  # why the last state could not be written; empty when it could
        self.written = 0  # states
        self.seconds = 0.0  # spent on writing them
        self._about: dict[str, Any] = {}
        self._last, self._gap = clock(), every_s
        self._still = False  # no step has been made since the state that the run went on from

    def recall(self, about: Callable[[], dict[str, Any]], kinds: Iterable[type]) -> tuple[State | None, str]:
        """The state of an earlier run of the same, and a sentence about it; no state and why, where there was a file
        that does not help; no state and nothing where there was none. From here on states are kept as `about`'s."""
        if self.file is None:
            return None, ""
        from splatcore import checkpoint

        self._about = about()
        try:
            state = checkpoint.read(self.file, self._about, kinds)
        except FileNotFoundError:
            return None, ""
        except CheckpointError as error:
            return None, f"The checkpoint is not used, {error}; starting from the beginning"
        self._still = True
        return state, "Going on from the checkpoint"

    def pause(self, state: Callable[[], State], stage_ends: bool = False) -> None:
        """Write the state if it is due, at the end of a stage rather than soon after it.

        Raises Stopped or Concluding if that is wished."""
        stop = self.wish is Wish.STOP
        gap = self._gap * (_EARLY if stage_ends else 1)
        # What stands in the file already is not written anew: a newer file means that the run got further.
        due, self._still = not self._still and self._clock() - self._last >= gap, False
        if self.file is not None and (stop or due):
            self._write(self.file, state)
        if stop:
            kept = f"its state is in {self.file}" if self.file and not self.trouble else "its state is not kept"
            raise Stopped(f"the run was stopped as asked; {kept}")
        if self.wish is Wish.CONCLUDE:
            self.concluded = True
            raise Concluding

    def show(self, draft: Callable[[], Floats], grid: VolumeGrid) -> bool:
        """The volume as it stands, [z, y, x] 1/mm, for whoever would like to see it by now: True if it was taken.
        Nobody here; calling `draft` is what costs."""
        return False

    def forget(self) -> None:
        """The run has ended, and its result is kept: the state is of no more use."""
        if self.file is not None:
            self.file.unlink(missing_ok=True)

    def _write(self, file: Path, state: Callable[[], State]) -> None:
        from splatcore import checkpoint

        began = self._clock()
        try:
            checkpoint.write(file, self._about, state())
        except OSError as error:  # a full disk must not end a run that can do without
            self.trouble = f"The checkpoint cannot be written ({error.strerror or error}); going on without a newer one"
        else:
            self.trouble, self.written = "", self.written + 1
        ended = self._clock()
        self.seconds += ended - began
        self._last, self._gap = ended, max(self._every_s, (ended - began) / _SHARE)
