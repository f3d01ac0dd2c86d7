"""What others ask of the engine process while it runs: to keep its state and go, to end with what it has, to let the
volume be seen before it is done."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING

from splatcore.keeper import Keeper, State, Wish
from worker.jobfolder import JobFolder

if TYPE_CHECKING:  # the first event is to be said before numpy is there
    from splatcore.grid import VolumeGrid
    from splatcore.splats import Floats

_LOOK_S = 0.2  # between two looks for the file that cancels


class Requests(Keeper):
    """The keeper of a job's run: it hears of SIGTERM, and looks for the file that cancels."""

    def __init__(self, folder: JobFolder, every_s: float) -> None:
        super().__init__(folder.checkpoint if every_s else None, every_s)
        self._cancel, self._draft, self._looked = folder.cancel, folder.draft, 0.0
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

    def show(self, draft: Callable[[], Floats], grid: VolumeGrid) -> bool:
        """Kept as the job's draft, in place of an earlier one. A full disk leaves that where it is: the run goes on."""
        from splatcore.results import write_volume

        part = self._draft.with_suffix(".part")
        try:
            with part.open("wb") as file:
                write_volume(file, draft(), grid)
            part.replace(self._draft)
        except OSError as error:
            part.unlink(missing_ok=True)
            sys.stderr.write(f"The volume so far cannot be shown: {error.strerror or error}\n")
            return False
        return True
