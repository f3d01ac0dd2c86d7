import json
from pathlib import Path
from typing import Any

from splatcore.errors import Problem, ScanError


def read_scan(folder: Path) -> dict[str, Any]:
    name = json.loads((folder / "scan.json").read_text())["name"]
    plan: dict[str, Any] = json.loads(name.removeprefix("fake ")) if name.startswith("fake ") else {}
    if plan.get("end") == "wordy":
        raise ScanError([Problem(str(folder / "projections.tif"), f"is torn: \0 \ud800 {__file__}")])
    if plan.get("end") == "bad_input":
        raise ScanError([Problem("projections.tif", "page 3 is torn")])
    return plan
