"""`splatct demo`: the whole path on this machine with a real scan. Starts the service, submits the example over
HTTP, waits, fetches the results and compares them with the truth."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import IO

HELP = "show it: start everything, reconstruct a badly calibrated example over HTTP, print the scores"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scan", type=Path, default=Path("examples/head"), help="a scan with its truth")
    parser.add_argument("-o", "--out", type=Path, default=Path("demo-out"), help="folder for everything, made anew")
    parser.add_argument("--keep", action="store_true", help="leave the service running until Ctrl-C")


def run(args: argparse.Namespace) -> int:
    from splatcore.errors import Problem, ScanError
    from splatcore.scan import read_header

    if read_header(args.scan).simulation is None:  # before anything is started
        raise ScanError([Problem(str(args.scan), "carries no truth", "the demo needs a simulated scan")])
    data, results = args.out / "service", args.out / "results"
    log_file = args.out / "service.log"
    if args.out.exists() and not log_file.exists() and any(args.out.iterdir()):
        hint = "choose another folder with -o; the demo makes its folder anew and deletes only its own"
        raise ScanError([Problem(str(args.out), "holds something that is not an earlier demo's", hint)])
    for folder in (data, results):
        if folder.exists():
            shutil.rmtree(folder)
    data.mkdir(parents=True)
    with log_file.open("w", encoding="utf-8") as log:
        service = subprocess.Popen(_splatct("up", "--data", str(data)), stdout=subprocess.PIPE, stderr=log, text=True)
        try:
            return _show(service, args, results)
        finally:
            service.terminate()
            service.wait(timeout=30)


def _show(service: subprocess.Popen[str], args: argparse.Namespace, results: Path) -> int:
    from splatcore.evaluate import evaluate, table

    assert service.stdout is not None
    url = _url(service.stdout)
    if url is None:
        print(f"the service did not start; its log is {args.out / 'service.log'}", file=sys.stderr)
        return 1
    print(f"The service runs at {url} (open it in a browser to watch).", flush=True)
    began = time.monotonic()
    code = subprocess.call(_splatct("submit", str(args.scan), "--server", url, "--wait", "-o", str(results)))
    if code != 0:
        return code
    print(f"\n{table(evaluate(results, args.scan))}")
    print(f"{'over HTTP, seconds':<20} {time.monotonic() - began:>29.1f}\n")
    print(f"Results: {results}/  (volume.tif, poses.json, report.html, splats.npz, manifest.json)")
    if args.keep:
        print("The service goes on; Ctrl-C stops it.", flush=True)
        service.wait()
    return 0


def _url(out: IO[str]) -> str | None:
    """The address that `splatct up` prints when the service answers; None if it ends first."""
    for line in out:
        if "http://" in line:
            return line[line.index("http://") :].split()[0]
    return None


def _splatct(*arguments: str) -> list[str]:
    return [sys.executable, "-P", "-m", "splatct_client", *arguments]
