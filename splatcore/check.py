"""`python -m splatcore.check FOLDER`: check a scan and print one JSON object, for other programs.

Exit 0 and {"facts": {...}}, or exit 2 and {"problems": [{"where", "what", "hint"}, ...]}. The server runs this
in a process of its own with limited resources, since the files come from strangers.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from splatcore.errors import Problem, ScanError


def answer(folder: Path, pixels: bool = True) -> tuple[int, str]:
    """(exit status, JSON text) of a check."""
    from splatcore.scan import check_scan

    try:
        facts = check_scan(folder, pixels)
    except ScanError as error:
        return 2, json.dumps({"problems": [problem.to_json() for problem in error.problems]}, allow_nan=False)
    except MemoryError:
        problem = Problem("", "needs more memory than this check may use", "bin the projections or split the scan")
        return 2, json.dumps({"problems": [problem.to_json()]})
    return 0, json.dumps({"facts": facts.to_json()}, allow_nan=False)


def main() -> int:
    if len(sys.argv) != 2:
        sys.stderr.write("usage: python -m splatcore.check FOLDER\n")
        return 64
    status, text = answer(Path(sys.argv[1]))
    sys.stdout.write(text + "\n")
    return status


if __name__ == "__main__":
    sys.exit(main())
