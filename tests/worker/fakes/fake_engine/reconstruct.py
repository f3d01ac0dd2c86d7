import os
import signal
import sys
import time
from collections.abc import Generator
from typing import Any

from splatcore.errors import ReconstructionError
from splatcore.options import Options
from splatcore.progress import Progress


def reconstruct(plan: dict[str, Any], options: Options) -> Generator[Progress, None, dict[str, Any]]:
    print("a stray print must not disturb the events")
    print(f"environment: {' '.join(sorted(os.environ))}", file=sys.stderr, flush=True)
    yield Progress("read", 0.0, "Reading")
    steps = plan.get("steps", 3)
    if plan.get("deaf"):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(3600)
    for step in range(steps):
        time.sleep(plan.get("pause", 0.0))
        yield Progress("level", (step + 1) / (steps + 1), f"Step {step + 1} of {steps}", step=step, loss=1 / (step + 1))
    end = plan.get("end")
    if end == "memory":
        raise MemoryError
    if end == "diverged":
        raise ReconstructionError("the loss grows; the geometry may be mirrored")
    if end == "bug":
        raise ZeroDivisionError("secret detail")
    if end == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if end == "full":
        raise OSError(28, "No space left on device")
    return {"options": options.to_dict(), "seed": options.seed}
