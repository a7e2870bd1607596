"""What this machine has to give."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

OWN_GROUP = Path("/proc/self/cgroup")
GROUPS = Path("/sys/fs/cgroup")


def cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0))


def memory_bytes() -> int:
    """What rendering may take: the rest is the system's."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return int(min([machine, *_limits()]) * 0.8)


def _limits() -> Iterator[int]:
    """What a container's or a unit's control group (cgroup v2) and those around it allow."""
    for line in OWN_GROUP.read_text().splitlines():
        if line.startswith("0::"):
            own = GROUPS / line.removeprefix("0::").lstrip("/")
            for group in (own, *own.parents):
                with contextlib.suppress(OSError, ValueError):  # there is none, or it is "max"
                    yield int((group / "memory.max").read_text())


def cache_bytes(allowed: int | None = None) -> int:
    """What volumes may hold of what rendering may take; images and paths need the rest."""
    return int((allowed or memory_bytes()) * 0.5)
