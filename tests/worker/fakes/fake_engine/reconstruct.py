import itertools
import os
import signal
import sys
import time
from collections.abc import Generator
from typing import Any

import numpy as np

from splatcore.checkpoint import FORMAT, VERSION
from splatcore.errors import ReconstructionError
from splatcore.grid import VolumeGrid
from splatcore.keeper import Concluding, Keeper
from splatcore.options import Options
from splatcore.progress import Progress

DRAFT = VolumeGrid((2, 3, 4), (1.0, 1.0, 1.0))


def reconstruct(plan: dict[str, Any], options: Options, keeper: Keeper) -> Generator[Progress, None, dict[str, Any]]:
    print("a stray print must not disturb the events")
    print(f"environment: {' '.join(sorted(os.environ))}", file=sys.stderr, flush=True)
    about = {"format": FORMAT, "version": VERSION, "software": "fake", "scan": plan, "options": {}}
    state, word = keeper.recall(lambda: about, ())
    first = 0 if state is None else state["step"]
    yield Progress("start", 0.0, word or "At work")
    steps = plan.get("steps", 3)
    if plan.get("deaf"):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(3600)
    if plan.get("allocate_mib"):
        bytearray(plan["allocate_mib"] << 20)
    if plan.get("native"):
        sum(itertools.repeat(1, 1 << 60))  # in C, and with the interpreter's lock
    try:
        for step in range(first, steps):
            keeper.pause(lambda step=step: {"step": step, "ballast": "x" * plan.get("state_bytes", 0)})
            time.sleep(plan.get("pause", 0.0))
            fraction = (step + 1) / (steps + 1)
            yield Progress("level", fraction, f"Step {step + 1} of {steps}", step=step, loss=1 / (step + 1))
            if plan.get("draft_at") == step and keeper.show(lambda: np.full((2, 3, 4), 0.1, np.float32), DRAFT):
                yield Progress("level", fraction, "To be seen", draft={"shape": [2, 3, 4], "voxel_mm": [1, 1, 1]})
            if plan.get("dies_at") == step and state is None:
                os.kill(os.getpid(), signal.SIGSEGV)
    except Concluding:
        return {"options": options.to_dict(), "seed": options.seed, "partial": True}
    end = plan.get("end")
    if end == "memory":
        raise MemoryError
    if end == "diverged":
        raise ReconstructionError("the loss grows; the geometry may be mirrored")
    if end == "bug":
        raise ZeroDivisionError("secret detail")
    if end == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if end == "segfault":
        os.kill(os.getpid(), signal.SIGSEGV)
    if end == "full":
        raise OSError(28, "No space left on device")
    return {"options": options.to_dict(), "seed": options.seed, "bytes": plan.get("result_bytes", 0)}
