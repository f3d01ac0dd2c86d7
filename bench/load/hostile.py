"""What it takes to refuse a scan that attacks: the scans of tests/http/hostile.py, sent to a real server."""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import httpx

from bench.load.figures import Figure, Measured, quantile
from bench.load.memory import FAKES
from bench.service import in_passing
from tests.http.hostile import REFUSED
from tests.http.stack import scan_files, send

MOST_S, MOST_MB = 1.0, 300.0
_ORDINARY = 5


def hostile(every: int, say: Callable[[str], None]) -> Measured:
    """Each `every`th of them."""
    names = list(REFUSED)[::every]
    took: dict[str, dict[str, float]] = {}
    with in_passing(0, {"check": "measured_check"}, [FAKES]) as service:
        with httpx.Client(base_url=service.url, trust_env=False, timeout=120) as http:
            ordinary = [_commit(http, scan_files(), 201)["seconds"] for _ in range(_ORDINARY)]
            for number, name in enumerate(names, start=1):
                took[name] = _commit(http, REFUSED[name][0](), 422)
                if number % 20 == 0:
                    say(f"hostile: {number} of {len(names)} scans")
    seconds = {name: cost["seconds"] for name, cost in took.items()}
    slowest = max(seconds, key=lambda name: seconds[name])
    largest = max(took, key=lambda name: took[name]["peak_mb"])
    figures = [
        Figure("an ordinary scan of 12 views, accepted, median", quantile(ordinary, 0.5), "s"),
        Figure("refusal, median", quantile(list(seconds.values()), 0.5), "s"),
        Figure(f"refusal, longest: {slowest}", seconds[slowest], "s", at_most=MOST_S),
        Figure("refusals that took longer than that", sum(s > MOST_S for s in seconds.values()), "scans", at_most=0),
        Figure("processor time of the check, most", max(cost["cpu_s"] for cost in took.values()), "s"),
        Figure(f"memory of the check, most: {largest}", took[largest]["peak_mb"], "MB", at_most=MOST_MB),
    ]
    how = f"The commit of {len(names)} hostile scans, once each, one after the other; their upload is not counted."
    return Measured("Refusing hostile scans", how, figures, took)


def _commit(http: httpx.Client, files: dict[str, bytes], expected: int) -> dict[str, float]:
    upload = send(http, files)
    began = time.perf_counter()
    answer = http.post(f"/v1/uploads/{upload}/commit")
    seconds = time.perf_counter() - began
    if answer.status_code != expected:
        raise RuntimeError(f"{expected} was expected, the answer is {answer.status_code}: {answer.text[:300]}")
    if expected == 201:
        cost = answer.json()["facts"]["cost"]
    else:
        last = answer.json()["errors"][-1]
        if last["where"] != "cost":
            raise RuntimeError(f"the check did not end by itself: {answer.text[:300]}")
        cost = json.loads(last["what"])
        http.delete(f"/v1/uploads/{upload}").raise_for_status()
    return {"seconds": seconds, **cost}
