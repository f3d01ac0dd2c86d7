"""What a job would cost on this server, without running it."""

from __future__ import annotations

import shutil

from server.schema import EstimateOut
from server.service import Service
from server.settings import MIB
from server.store import Scan
from splatcore.estimate import Estimate, estimate, warnings
from splatcore.machine import memory_bytes
from splatcore.options import Options


def found(scan: Scan, options: Options) -> Estimate:
    """From the facts that were found when the scan was committed."""
    facts = scan.facts
    return estimate(facts["views"], facts["rows"], facts["cols"], facts["volume_shape"], options)


def of(service: Service, scan: Scan, options: Options) -> EstimateOut:
    cost, settings = found(scan, options), service.settings
    memory = settings.engine_memory_mib * MIB or memory_bytes()[0]
    disk = max(0, shutil.disk_usage(settings.data).free - settings.disk_floor_mib * MIB)
    said = warnings(cost, memory_free=memory, disk_free=disk, longest_s=settings.job_seconds)
    with service.store.database.reading() as read:
        left = service.quotas.bytes_left(read, service.tenant)
    if left is not None and cost.disk_bytes > left:
        said.append(f"it may write {cost.disk_bytes} bytes, the quota has {left} left: it would be refused")
    return EstimateOut(
        memory_bytes=cost.memory_bytes,
        seconds=cost.seconds,
        disk_bytes=cost.disk_bytes,
        memory_free_bytes=memory,
        disk_free_bytes=disk,
        options=options.to_dict(),
        warnings=[*scan.facts.get("warnings", []), *said],
    )
