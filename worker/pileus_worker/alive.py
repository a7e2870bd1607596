"""`python -m pileus_worker.alive`: whether a worker of this host lives, for a container's health.

A worker lives that has renewed its presence in Redis within a lease; a process alone may be hung.
"""

import os
import socket
import sys

from redis.exceptions import RedisError

from pileus_service.queue import Queue, connect


def main() -> None:
    host = socket.gethostname()
    try:
        seen = Queue(connect(os.environ["PILEUS_REDIS"])).workers()
    except (KeyError, ValueError, RedisError) as error:
        sys.exit(f"PILEUS_REDIS: {error}")
    if not any(worker.alive and worker.host == host for worker in seen):
        sys.exit(f"{host}: no worker of this host lives")


if __name__ == "__main__":
    main()
