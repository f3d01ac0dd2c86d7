"""How long until there is something to be seen: seconds from the start of a run to each draft of its volume.

    python bench/firstlook.py SCAN [--threads N]

Reading the scan and the imports count; the run ends with the last draft, before the last stage.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from splatcore.grid import VolumeGrid
from splatcore.keeper import Keeper
from splatcore.machine import threads_allowed
from splatcore.options import Options
from splatcore.reconstruct import reconstruct
from splatcore.scan import read_scan
from splatcore.splats import Floats


class Watching(Keeper):
    """Makes every draft, as a worker does, and leaves it."""

    def show(self, draft: Callable[[], Floats], grid: VolumeGrid) -> bool:
        draft()
        return True


def main() -> None:
    began = time.monotonic() - time.process_time()  # imports included
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--threads", type=int, default=threads_allowed())
    args = parser.parse_args()
    scan = read_scan(args.scan)
    rows, cols = scan.frames.rows, scan.frames.cols
    print(f"{len(scan.frames)} views of {rows} x {cols}, {args.threads} threads")
    for event in reconstruct(scan, Options(threads=args.threads), Watching()):
        if event.draft is not None:
            shape = " x ".join(map(str, event.draft["shape"]))
            print(f"{shape} voxels after {time.monotonic() - began:.1f} s", flush=True)
            if event.level == 1:
                break


if __name__ == "__main__":
    main()
