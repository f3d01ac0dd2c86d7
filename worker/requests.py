"""What others ask of the engine process while it runs: to keep its state and go, or to end with what it has."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from types import FrameType

from splatcore.keeper import Keeper, State, Wish
from worker.jobfolder import JobFolder

_LOOK_S = 0.2  # between two looks for the file that cancels


class Requests(Keeper):
    """The keeper of a job's run: it hears of SIGTERM, and looks for the file that cancels."""

    def __init__(self, folder: JobFolder, every_s: float) -> None:
        super().__init__(folder.checkpoint if every_s else None, every_s)
        self._cancel, self._looked = folder.cancel, 0.0
        signal.signal(signal.SIGTERM, self._stop)

    def _stop(self, _signal: int, _frame: FrameType | None) -> None:
        self.wish = Wish.STOP

    def look(self) -> Wish:
        """What is wished by now."""
        now = time.monotonic()
        if now - self._looked >= _LOOK_S and self.wish is Wish.GO_ON:
            self._looked = now
            if self._cancel.exists():
                self.wish = Wish.CONCLUDE
        return self.wish

    def pause(self, state: Callable[[], State], stage_ends: bool = False) -> None:
        self.look()
        super().pause(state, stage_ends)
