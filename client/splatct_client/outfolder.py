"""The folder that receives a job's results: never mixed with what was there before, and resumable."""

from __future__ import annotations

from pathlib import Path

from splatct_client.bar import Bar, size_text
from splatct_client.client import Client
from splatct_client.download import place
from splatct_client.errors import InputError
from splatct_client.models import ResultFile

MARKER = ".splatct-job"  # holds the job's id while its results are coming in


def check_out_folder(folder: Path, *, overwrite: bool, job_id: str | None = None) -> None:
    """Raise InputError unless results may be written there. An unfinished fetch of the same job may go on."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file; -o expects a folder")
    if overwrite or not folder.is_dir() or not any(folder.iterdir()):
        return
    marker = folder / MARKER
    if job_id and marker.is_file() and marker.read_text().strip() == job_id:
        return
    raise InputError(f"{folder} is not empty; give another folder, or --overwrite to replace the files in it")


def fetch_results(
    client: Client, job_id: str, folder: Path, only: list[str] | None = None, kind: str = "results"
) -> list[Path]:
    """Download every result file (or those named in `only`), manifest.json last: where it is, all is."""
    files = [file for file in client.results(job_id, kind) if file.name != "manifest.json"]
    if only:
        missing = sorted(set(only) - {file.name for file in files})
        if missing:
            raise InputError(f"the job has no result file {missing[0]!r}; it has: {', '.join(f.name for f in files)}")
        files = [file for file in files if file.name in only]
    for file in files:
        place(folder, file.name)  # refuse a bad name before the first byte
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / MARKER).write_text(job_id)
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {error.strerror}") from error
    paths = _fetch_all(client, job_id, files, folder, kind)
    if not only:
        part = folder / "manifest.json.part"
        part.write_bytes(client.manifest(job_id, kind))
        paths.append(part.replace(folder / "manifest.json"))
    (folder / MARKER).unlink(missing_ok=True)
    return paths


def _fetch_all(client: Client, job_id: str, files: list[ResultFile], folder: Path, kind: str) -> list[Path]:
    total, done, paths = sum(file.size for file in files), 0, []
    with Bar("fetch ") as bar:
        for file in files:

            def show(received: int, name: str = file.name, before: int = done) -> None:
                at = before + received
                bar.show(at / max(total, 1), f"{size_text(at)} of {size_text(total)}  {name}")

            paths.append(client.download(job_id, file, folder, show, kind))
            done += file.size
    return paths
