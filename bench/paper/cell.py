"""One cell in a process of its own, so that its peak memory and its failure are its own:
`python -m bench.paper.cell JOB.pickle`, which `run` writes and starts."""

from __future__ import annotations

import json
import pickle
import sys
from pathlib import Path

from bench.paper.runners import run


def main(path: Path) -> None:
    job = pickle.loads(path.read_bytes())  # written a moment ago by our own parent
    scores = run(job)
    (job.out / "scores.json").write_text(json.dumps(scores, default=float), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
