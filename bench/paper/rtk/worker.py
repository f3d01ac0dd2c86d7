"""One job in RTK's Python: `python -m bench.paper.rtk.worker FOLDER`.

FOLDER holds job.json (task, threads, ...) and arrays.npz; the answer is answer.json and *.npy beside them. Imports of
this module: numpy and RTK alone, and what needs neither.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from bench.paper.rtk import bridge
from bench.peak import peak_mib


def main(folder: Path) -> None:
    job: dict[str, Any] = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    with np.load(folder / "arrays.npz", allow_pickle=False) as arrays:
        given = dict(arrays)
    bridge.set_threads(job["threads"])
    rays = bridge.Views(*(given[name] for name in ("source", "detector_center", "u", "v")), job["rows"], job["cols"])
    grid = bridge.Grid(tuple(job["shape"]), tuple(job["voxel_mm"]), tuple(job["center_mm"]))
    answer: dict[str, Any] = {}
    if job["task"] == "project":
        np.save(folder / "images.npy", bridge.project(given["volume"], grid, rays))
    elif job["task"] == "geometry":
        bridge.write_geometry(rays, str(folder / "geometry.xml"))
    else:
        bridge.warm_up()  # loading RTK's templates takes longer than a small reconstruction
        found = bridge.reconstruct(job["method"], given["images"], rays, grid, job["snapshots"], **job["knobs"])
        answer["snapshots"] = []
        for iterations, seconds, volume in found:
            np.save(folder / f"volume{iterations}.npy", volume)
            answer["snapshots"].append({"iterations": iterations, "seconds": seconds})
    answer["peak_mib"] = peak_mib()
    answer["version"] = bridge.version()
    (folder / "answer.json").write_text(json.dumps(answer), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
