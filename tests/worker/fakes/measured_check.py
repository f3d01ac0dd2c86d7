"""The check of a scan, which also says what it cost: as one more problem, or as one more fact."""

from __future__ import annotations

import json
import re
import resource
import sys
from pathlib import Path

from splatcore.check import answer

status, text = answer(Path(sys.argv[1]))
verdict = json.loads(text)
used = resource.getrusage(resource.RUSAGE_SELF)
peak = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())  # ru_maxrss is inherited from the server
assert peak is not None
cost = {"cpu_s": used.ru_utime + used.ru_stime, "peak_mb": int(peak[1]) * 1024 / 1e6}
if status:
    verdict["problems"].append({"where": "cost", "what": json.dumps(cost)})
else:
    verdict["facts"]["cost"] = cost
print(json.dumps(verdict))
sys.exit(status)
