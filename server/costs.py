"""What a job would cost on this server, without running it."""

from __future__ import annotations

import shutil

from server.schema import EstimateOut
from server.service import Service
from server.settings import MIB
from server.store import Scan
from splatcore.estimate import estimate, warnings
from splatcore.machine import memory_bytes
from splatcore.options import Options


def of(service: Service, scan: Scan, options: Options) -> EstimateOut:
    """From the facts that were found when the scan was committed."""
    facts, settings = scan.facts, service.settings
    found = estimate(facts["views"], facts["rows"], facts["cols"], facts["volume_shape"], options)
    memory = settings.engine_memory_mib * MIB or memory_bytes()[0]
    disk = max(0, shutil.disk_usage(settings.data).free - settings.disk_floor_mib * MIB)
    said = warnings(found, memory_free=memory, disk_free=disk, longest_s=settings.job_seconds)
    return EstimateOut(
        memory_bytes=found.memory_bytes,
        seconds=found.seconds,
        disk_bytes=found.disk_bytes,
        memory_free_bytes=memory,
        disk_free_bytes=disk,
        options=options.to_dict(),
        warnings=[*facts.get("warnings", []), *said],
    )
