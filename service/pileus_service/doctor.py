"""`pileus doctor`: looks at a host, its folders, Redis, the clock and the service, and says what to
mend. A check yields findings, and needs nothing to be right that it does not check itself.
"""

import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from email.utils import parsedate_to_datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

import httpx
from pydantic import BaseModel
from redis import Redis
from redis.exceptions import RedisError

from pileus_service import __version__
from pileus_service.queue import Queue
from pileus_service.store import farm_of, write_whole

Level = Literal["ok", "warning", "wrong"]
OPEN_FILES = 1024
FREE_BYTES = 10 << 30
FSYNC_SECONDS = 0.1
PING_SECONDS = 0.01
SKEW_SECONDS = 1.0
OLDEST_REDIS = 7


class Finding(BaseModel):
    """What was found of one thing, and what to do about it where it is not well."""

    level: Level
    what: str
    found: str
    mend: str = ""


def _if(well: bool, otherwise: Level, what: str, found: str, mend: str) -> Finding:
    return Finding(
        level="ok" if well else otherwise, what=what, found=found, mend="" if well else mend
    )


def host() -> Iterator[Finding]:
    """The machine and what is installed on it."""
    try:
        core = version("pileus-core")
    except PackageNotFoundError:
        yield Finding(level="ok", what="renderer", found="not installed: this host can only ask")
    else:
        # In a process of its own: a library that is missing must not end this one.
        asked = [sys.executable, "-c", "import pileus_core"]
        ended = subprocess.run(asked, capture_output=True, text=True, check=False)
        said = ended.stderr.strip().splitlines()[-1:] or [f"ended with {ended.returncode}"]
        yield _if(
            ended.returncode == 0,
            "wrong",
            "renderer",
            core if ended.returncode == 0 else f"{core} does not load: {said[0]}",
            "install what it names and build it again: pip install ./core",
        )
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        cores = len(os.sched_getaffinity(0))
        yield _if(
            memory >= cores << 30,
            "warning",
            "memory",
            f"{memory / (1 << 30):.1f} GiB for {cores} cores",
            "under 1 GiB a core: run fewer workers, or give them --memory",
        )
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    yield _if(
        files >= OPEN_FILES,
        "warning",
        "open files",
        f"{files} allowed",
        f"allow {OPEN_FILES} or more: ulimit -n, or LimitNOFILE= of the unit",
    )


def folders(data: Path | None, roots: list[Path]) -> Iterator[Finding]:
    """The data folder, on which all that the farm promises rests, and the roots."""
    if data is None:
        pass
    elif not data.is_dir():
        yield Finding(
            level="wrong",
            what="data folder",
            found=f"{data} is not there",
            mend="mount it, create it, or name another with --data",
        )
    else:
        yield from _data(data)
    for root in roots:
        modes = os.R_OK | os.W_OK | os.X_OK
        reachable = root.is_dir() and os.access(root, modes)
        yield _if(
            reachable,
            "wrong",
            "root",
            f"{root}{'' if reachable else ' cannot be read and written'}",
            f"mount it, or let user {os.geteuid()} read and write there",
        )


def _data(data: Path) -> Iterator[Finding]:
    probe = data / f".doctor.{os.getpid()}"
    begun = time.perf_counter()
    try:
        # As the farm writes: a file that is synced, linked or renamed, and its folder synced.
        write_whole(probe, b"x", once=True)
        write_whole(probe, b"y")
        took = (time.perf_counter() - begun) / 2
        right = probe.read_bytes() == b"y" and not write_whole(probe, b"z", once=True)
    except OSError as error:
        yield Finding(
            level="wrong",
            what="data folder",
            found=f"{data}: {error.strerror}",
            mend="it must be writable, and its file system must know hard links and renames",
        )
        return
    finally:
        probe.unlink(missing_ok=True)
    yield _if(
        right,
        "wrong",
        "data folder",
        f"{data} {'writes whole files' if right else 'loses or mixes writes'}",
        "its file system does not rename or link atomically: use a local one, or NFS 4",
    )
    yield _if(
        took <= FSYNC_SECONDS,
        "warning",
        "data folder's speed",
        f"{1000 * took:.1f} ms to write a small file for good",
        "it is slow to sync: a faster disk or server makes short tasks cheaper",
    )
    free = shutil.disk_usage(data).free
    yield _if(
        free >= FREE_BYTES,
        "warning",
        "data folder's room",
        f"{free / (1 << 30):.1f} GiB free",
        "make room: `pileus delete` removes what is left of jobs that have ended",
    )


def redis_server(redis: "Redis") -> Iterator[Finding]:
    """Redis: that it is there, new and quick enough, and forgets nothing."""
    try:
        info = redis.info()
        begun = time.perf_counter()
        for _ in range(20):
            redis.ping()
        ping = (time.perf_counter() - begun) / 20
        yield from _clock_of_redis(redis)
    except RedisError as error:
        yield Finding(
            level="wrong",
            what="Redis",
            found=str(error),
            mend="start it, or name it with --redis; `pileus up` has one of its own",
        )
        return
    release = str(info["redis_version"])
    yield _if(
        int(release.split(".")[0]) >= OLDEST_REDIS,
        "wrong",
        "Redis",
        f"version {release}",
        f"install version {OLDEST_REDIS} or newer",
    )
    yield _if(
        ping <= PING_SECONDS,
        "warning",
        "way to Redis",
        f"{1000 * ping:.2f} ms there and back",
        "it is far: each task asks it a few times",
    )
    yield _if(
        bool(info.get("aof_enabled")),
        "warning",
        "Redis's memory of itself",
        "append-only file" if info.get("aof_enabled") else "lost with its process",
        "set `appendonly yes`: without it a restart renders again what was in flight",
    )
    policy = str(info.get("maxmemory_policy", "unknown"))
    yield _if(
        policy == "noeviction",
        "wrong",
        "Redis when it is full",
        f"maxmemory-policy {policy}",
        "set `maxmemory-policy noeviction`: any other may throw tasks away",
    )
    limit, used = int(info.get("maxmemory", 0)), int(info["used_memory"])
    yield _if(
        not limit or used < 0.8 * limit,
        "warning",
        "Redis's room",
        f"{used >> 20} MiB used of {limit >> 20 if limit else 'as many as there are'}",
        "raise maxmemory, or delete old jobs",
    )


def one_farm(data: Path, redis: "Redis") -> Iterator[Finding]:
    """Whether data folder and Redis belong together, once a service has begun the farm."""
    try:
        theirs, ours = Queue(redis).farm(), farm_of(data)
    except (RedisError, OSError):
        return  # told already
    if theirs is not None:
        yield _if(
            ours == theirs,
            "wrong",
            "data folder and Redis",
            "of one farm" if ours == theirs else f"{data} is not the folder of Redis's farm",
            "mount the farm's folder there, or name another with --data, or another --redis",
        )


def _clock_of_redis(redis: "Redis") -> Iterator[Finding]:
    before = time.time()
    seconds, micros = redis.time()
    skew = seconds + micros / 1e6 - (before + time.time()) / 2
    yield _if(
        abs(skew) <= SKEW_SECONDS,
        "warning",
        "clock",
        f"{abs(skew):.3f} s {'behind' if skew > 0 else 'ahead of'} Redis's",
        "leases do not mind, logs and times do: run chrony or systemd-timesyncd on both hosts",
    )


def service(server: str, token: str | None) -> Iterator[Finding]:
    """The service: that it answers, is of our version, has its Redis and knows the token."""
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    try:
        with httpx.Client(base_url=server, headers=headers, timeout=5) as http:
            health, ready = http.get("/healthz"), http.get("/readyz")
            listed = http.get("/v1/workers")
            theirs = str(health.json()["version"])
    except (httpx.HTTPError, httpx.InvalidURL, ValueError, KeyError, TypeError) as error:
        yield Finding(
            level="wrong",
            what="service",
            found=f"{server}: {error}",
            mend="start it with `pileus up` or `pileus service`, or name it with --server",
        )
        return
    yield _if(
        theirs == __version__,
        "warning",
        "service",
        f"{server}, version {theirs}, and this is {__version__}",
        "install one version on all hosts",
    )
    yield _if(
        ready.is_success,
        "wrong",
        "service's Redis",
        "answers" if ready.is_success else "does not answer the service",
        "see what `pileus doctor --redis` says on the service's host",
    )
    if "date" in health.headers:
        skew = parsedate_to_datetime(health.headers["date"]).timestamp() - time.time()
        yield _if(
            abs(skew) <= SKEW_SECONDS + 1.0,  # the header has whole seconds
            "warning",
            "service's clock",
            f"within {abs(skew):.0f} s of this one",
            "run chrony or systemd-timesyncd on both hosts",
        )
    if not listed.is_success:
        yield Finding(
            level="wrong",
            what="token",
            found=str(listed.json().get("detail", listed.status_code)),
            mend="give the right one with --token or PILEUS_TOKEN",
        )
        return
    alive = [worker for worker in listed.json() if worker["alive"]]
    yield _if(
        bool(alive),
        "warning",
        "workers",
        f"{len(alive)} alive",
        "start some: `pileus worker --data DIR --redis URL --root DIR`",
    )
