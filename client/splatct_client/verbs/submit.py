"""`splatct submit SCAN`: upload a scan, queue its reconstruction, and if asked wait for the results."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatct_client.bar import Bar, seconds_text, size_text
from splatct_client.errors import ClientError, InputError, JobFailed, Problem, ServerProblem
from splatct_client.scanfolder import ScanFolder, read_scan_folder
from splatct_client.verbs import add_server_option, connect, print_json

if TYPE_CHECKING:
    from splatct_client.client import Client
    from splatct_client.models import Job

HELP = "upload a scan folder to a server and queue its reconstruction"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scan", metavar="SCAN", type=Path, help="a scan folder: scan.json and the files it names")
    add_server_option(parser)
    parser.add_argument("--name", help="the job's name (default: the scan's)")
    parser.add_argument("--calibrate", metavar="MODE", help="full, static or none; short for --option calibrate=MODE")
    parser.add_argument(
        "--option", metavar="NAME=VALUE", action="append", default=[], help="an option of the engine; may be repeated"
    )
    parser.add_argument("--priority", choices=("low", "normal", "high"), help="among your own jobs; default normal")
    parser.add_argument("--wait", action="store_true", help="stay until the job has finished")
    parser.add_argument("-o", "--out", metavar="OUT", type=Path, help="wait, then fetch the results into this folder")
    parser.add_argument("--overwrite", action="store_true", help="let OUT have files in it")


def run(args: argparse.Namespace) -> int:
    from splatct_client.outfolder import check_out_folder, fetch_results

    options = parse_options(args.option, args.calibrate)
    scan = read_scan_folder(args.scan)
    if args.out:
        check_out_folder(args.out, overwrite=args.overwrite)
    with connect(args) as client:
        check_options(options, client.options())  # before a long upload, not after it
        scan_id = send(client, scan)
        job = client.submit(scan_id, options, args.name, args.priority)
        _tell(args, f"job {job.id} is {job.state}; its page: {client.base_url}/jobs/{job.id}")
        fetched: list[Path] = []
        if args.wait or args.out:
            job = watch(client, job.id)
            if job.state != "succeeded":
                raise JobFailed(end_text(job))
            _tell(args, end_text(job))
        if args.out:
            fetched = fetch_results(client, job.id, args.out)
            _tell(args, f"results are in {args.out}")
        elif not args.json:
            print(f"fetch the results with `splatct fetch {job.id} -o OUT`")
    if args.json:
        print_json({"job": job.to_json(), "files": [str(path) for path in fetched]})
    return 0


def parse_options(pairs: list[str], calibrate: str | None) -> dict[str, Any]:
    """`name=value` pairs as JSON would have them: numbers, true, null; anything else is text."""
    options: dict[str, Any] = {} if calibrate is None else {"calibrate": calibrate}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name:
            raise InputError(f"--option: got {pair!r}, expected NAME=VALUE")
        try:
            options[name] = json.loads(text)
        except ValueError:
            options[name] = text
    return options


def check_options(options: dict[str, Any], known: list[dict[str, Any]]) -> None:
    """Compare with what the server says it knows. It judges again, more strictly, at submission."""
    described = {str(option.get("name")): option for option in known}
    problems = []
    for name, value in options.items():
        option = described.get(name)
        if option is None:
            problems.append(Problem(name, "unknown option", f"known: {', '.join(described)}"))
            continue
        choices, low, high = (option.get(key) for key in ("choices", "low", "high"))
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if choices and value not in choices:
            problems.append(Problem(name, f"got {value!r}", f"expected one of {', '.join(map(str, choices))}"))
        elif value is not None and low is not None and high is not None and not (number and low <= value <= high):
            problems.append(Problem(name, f"got {value!r}", f"expected {low} to {high}"))
    if problems:
        raise InputError("the options cannot be used:", problems)


def send(client: Client, scan: ScanFolder) -> str:
    """Upload and commit; returns the scan's id."""
    upload = client.create_upload(scan.name, scan.specs)
    try:
        there = {file.name for file in upload.files if file.complete}
        if there:
            print(f"the server has {len(there)} of {len(scan.sources)} files already", file=sys.stderr)
        _send_files(client, upload.id, scan, there)
        print("the server checks the files", file=sys.stderr)
        return client.commit(upload.id).id
    except (ServerProblem, KeyboardInterrupt):
        with contextlib.suppress(ClientError):
            client.abandon(upload.id)  # or it would hold its share of the server's disk until it expires
        raise


def _send_files(client: Client, upload_id: str, scan: ScanFolder, there: set[str]) -> None:
    missing = {name: source for name, source in scan.sources.items() if name not in there}
    done, total = 0, sum(map(_size, missing.values()))
    with Bar("upload") as bar:
        for name, source in missing.items():

            def show(sent: int, name: str = name, before: int = done) -> None:
                at = before + sent
                bar.show(at / max(total, 1), f"{size_text(at)} of {size_text(total)}  {name}")

            done += client.put_file(upload_id, name, source, show).size


def _size(source: Path | bytes) -> int:
    return len(source) if isinstance(source, bytes) else source.stat().st_size


def watch(client: Client, job_id: str) -> Job:
    """Wait for the end with a live bar. Leaving the bar leaves the job alone."""
    try:
        with Bar("job   ") as bar:
            return client.wait(job_id, lambda job: bar.show(job.progress, progress_text(job)))
    except KeyboardInterrupt:
        print(f"the job goes on; see `splatct jobs {job_id}`, stop it with `splatct cancel {job_id}`", file=sys.stderr)
        raise


def progress_text(job: Job) -> str:
    if job.state == "queued":
        return "queued" if job.queue_position is None else f"queued, number {job.queue_position} in line"
    left = f", {seconds_text(job.eta_s)} left" if job.eta_s is not None and not job.finished else ""
    return f"{job.message or job.stage or job.state}{left}"


def end_text(job: Job) -> str:
    text = f"job {job.id} {job.state}"
    return f"{text}: {job.error.message}" if job.error else text


def _tell(args: argparse.Namespace, text: str) -> None:
    print(text, file=sys.stderr if args.json else sys.stdout, flush=True)
