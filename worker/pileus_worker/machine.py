"""What this machine has to give."""

import os


def cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0))


def memory_bytes() -> int:
    """What rendering may take: the rest is the system's."""
    return int(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") * 0.8)


def cache_bytes(allowed: int | None = None) -> int:
    """What volumes may hold of what rendering may take; images and paths need the rest."""
    return int((allowed or memory_bytes()) * 0.5)
