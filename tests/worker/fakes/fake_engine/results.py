import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import tifffile


def write_results(reconstruction: dict[str, Any], folder: Path, overwrite: bool = False) -> None:
    z, y, x = np.mgrid[:5, :6, :7]
    tifffile.imwrite(folder / "volume.tif", (100 * z + 10 * y + x).astype("<f4"), bigtiff=True)
    (folder / "report.json").write_text(json.dumps({"findings": []}))
    (folder / "report.html").write_text("<h1>report</h1>")
    (folder / "poses.json").write_text(json.dumps({"format": "splatct-poses/1", "views": []}))
    (folder / "splats.npz").write_bytes(bytes(reconstruction.pop("bytes", 0)))
    files = [
        {"name": f.name, "size": f.stat().st_size, "sha256": hashlib.sha256(f.read_bytes()).hexdigest()}
        for f in sorted(folder.iterdir())
    ]
    (folder / "manifest.json").write_text(json.dumps({"files": files, **reconstruction}))
