"""Routes that hand out what a job made."""

from __future__ import annotations

import json
from pathlib import Path as Folder
from typing import Annotated, Any, Literal
from uuid import UUID

from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import FileResponse

from server import names, slices
from server.problems import ApiProblem, invalid, not_found
from server.service import Served, Service
from worker.contract import ACTIVE, State

router = APIRouter(prefix="/v1/jobs/{job_id}", tags=["results"])

_FOREVER = {"Cache-Control": "private, max-age=86400, immutable"}
_REVALIDATE = {"Cache-Control": "private, no-cache"}


FileName = Annotated[str, Path(max_length=255)]


@router.get("/results")
def get_manifest(job_id: UUID, service: Served) -> Any:
    return _json(_finished(service, job_id), "manifest.json")


@router.get("/report")
def get_report(job_id: UUID, service: Served) -> Any:
    """Of the results, or of what a job that was ended early left."""
    return _json(_whole_or_partial(service, job_id), "report.json")


@router.get("/results/{file}", response_class=FileResponse)
def get_result(job_id: UUID, file: FileName, service: Served) -> Response:
    return _file(_finished(service, job_id), file)


@router.get("/partial")
def get_partial_manifest(job_id: UUID, service: Served) -> Any:
    """What a job that was cancelled, or out of time, had by then: the manifest, like that of results."""
    return _json(_partial(service, job_id), "manifest.json")


@router.get("/partial/{file}", response_class=FileResponse)
def get_partial_result(job_id: UUID, file: FileName, service: Served) -> Response:
    return _file(_partial(service, job_id), file)


@router.get("/slices/{axis}/{index}.png", response_class=Response, responses={200: {"content": {"image/png": {}}}})
def get_slice(
    job_id: UUID,
    axis: Literal["x", "y", "z"],
    index: Annotated[int, Path(ge=0)],
    service: Served,
    low: Annotated[float | None, Query(allow_inf_nan=False)] = None,
    high: Annotated[float | None, Query(allow_inf_nan=False)] = None,
) -> Response:
    """One slice as an 8-bit PNG; z up for x and y, y up for z. `low` and `high` are in 1/mm. While the job runs: of the
    volume as it stood at the end of the last level, in that level's voxels."""
    if low is not None and high is not None and not low < high:
        raise invalid("low must be less than high.")
    draft = _draft(service, job_id)
    try:
        if draft is None:
            folder = _whole_or_partial(service, job_id)
            png = slices.render(folder / "volume.tif", axis, index, low, high, folder.parent / "window.json")
        else:
            png = slices.render(draft, axis, index, low, high)
    except IndexError:
        raise not_found("slice") from None
    except FileNotFoundError:
        raise not_found("volume") from None
    return Response(png, media_type="image/png", headers=_FOREVER if draft is None else _REVALIDATE)


def _finished(service: Service, job_id: UUID) -> Folder:
    """Where the results of a job are, or a 404 or 409."""
    job = service.job(job_id)
    if job.state is not State.SUCCEEDED:
        hint = "; what it left is under partial" if job.partial else ""
        raise ApiProblem(409, "no-results", f"The job has no results: it is {job.state}{hint}.")
    return service.folder(job.id).results


def _partial(service: Service, job_id: UUID) -> Folder:
    """Where the partial result of a job is, or a 404 or 409."""
    job = service.job(job_id)
    if not job.partial:
        raise ApiProblem(409, "no-results", f"The job has no partial result: it is {job.state}.")
    return service.folder(job.id).partial


def _whole_or_partial(service: Service, job_id: UUID) -> Folder:
    return _partial(service, job_id) if service.job(job_id).partial else _finished(service, job_id)


def _draft(service: Service, job_id: UUID) -> Folder | None:
    """Where the volume so far of a job under way is, if there is one."""
    job = service.job(job_id)
    draft = service.folder(job.id).draft
    return draft if job.state in ACTIVE and draft.is_file() else None


def _file(folder: Folder, file: str) -> Response:
    path = folder / file
    if names.fault(file) is not None or path.is_symlink() or not path.is_file():
        raise not_found("result file")
    if file.endswith(".html"):  # shown in the browser: made by the engine, but with the user's words in it
        sandbox = {"Content-Security-Policy": "sandbox allow-scripts; default-src 'none'; img-src data:; "
                   "style-src 'unsafe-inline'; script-src 'unsafe-inline'"}  # fmt: skip
        return FileResponse(path, headers={**_REVALIDATE, **sandbox})
    return FileResponse(path, filename=file, headers=_REVALIDATE)


def _json(folder: Folder, name: str) -> Any:
    try:
        return json.loads((folder / name).read_bytes())
    except FileNotFoundError:
        raise not_found("result file") from None
