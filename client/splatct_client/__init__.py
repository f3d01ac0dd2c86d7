"""SplatCT's client: submit scans to a server, watch the jobs, fetch the results.

    from splatct_client import Client

    with Client("http://127.0.0.1:8080") as client:
        for job in client.jobs(state="running"):
            print(job.name, job.progress)

Needs httpx and nothing else: no torch, no compiler. Importing the package does not yet
import httpx, so that `splatct --help` stays quick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splatct_client.errors import (
    ClientError,
    InputError,
    IntegrityError,
    JobFailed,
    KeyNeeded,
    ServerProblem,
    ServerUnreachable,
    UnexpectedAnswer,
)
from splatct_client.models import FileSpec, Job, JobError, ResultFile, Scan, Upload, UploadedFile

if TYPE_CHECKING:
    from splatct_client.client import Client

__version__ = "0.1.0"

__all__ = [
    "Client",
    "ClientError",
    "FileSpec",
    "InputError",
    "IntegrityError",
    "Job",
    "JobError",
    "JobFailed",
    "KeyNeeded",
    "ResultFile",
    "Scan",
    "ServerProblem",
    "ServerUnreachable",
    "UnexpectedAnswer",
    "Upload",
    "UploadedFile",
]


def __getattr__(name: str) -> Any:
    if name == "Client":
        from splatct_client.client import Client

        return Client
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
