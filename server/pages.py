"""The status page: three HTML shells. Their scripts, in static/, read everything from the API.

The app mounts static/ at /static.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Request
from fastapi import Path as InPath
from fastapi.responses import HTMLResponse
from fastapi.templating import Jinja2Templates

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_templates = Jinja2Templates(Path(__file__).parent / "templates")
_HEADERS = {
    # Only our own files, no inline script or style: a hostile scan name stays text even if escaping fails.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}


@router.get("/")
def jobs_page(request: Request) -> HTMLResponse:
    return _templates.TemplateResponse(request, "jobs.html", headers=_HEADERS)


@router.get("/sign-in")
def sign_in_page(request: Request) -> HTMLResponse:
    return _templates.TemplateResponse(request, "signin.html", headers=_HEADERS)


@router.get("/jobs/{job_id}")
def job_page(request: Request, job_id: Annotated[str, InPath(max_length=64)]) -> HTMLResponse:
    """Served for any id: the script asks the API whether there is such a job, and says so if not."""
    return _templates.TemplateResponse(request, "job.html", {"job_id": job_id}, headers=_HEADERS)
