"""Whether this container's worker has a heartbeat: exit 0 or 1. Run by the health check in compose.yml."""

import os
import socket
import sys
from datetime import UTC, datetime

from redis import Redis
from rq.utils import utcparse
from rq.worker import Worker

SILENCE_S = 40  # an idle worker shows itself every 15 s, a busy one every 5 s

redis = Redis.from_url(os.environ["SPLATCT_REDIS_URL"], socket_timeout=5)
for key in redis.scan_iter(f"{Worker.redis_worker_namespace_prefix}*", count=1000, _type="hash"):
    host, seen = redis.hmget(key, "hostname", "last_heartbeat")
    if host is None or seen is None or host.decode() != socket.gethostname():
        continue
    if (datetime.now(UTC) - utcparse(seen.decode())).total_seconds() < SILENCE_S:
        sys.exit(0)
sys.exit(1)
