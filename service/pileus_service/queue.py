"""The queue on Redis Streams: the one class through which service and workers use Redis.

A task is a stream entry; Redis's consumer group is its lease, and the delivery count its attempts.
Each step is one Lua script (lua/), so it happens whole or not at all. Redis holds only what is in
flight: `pileus_service.store` is the truth.
"""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from importlib.resources import files
from typing import Any, Literal, NamedTuple, cast

from redis import Redis
from redis.backoff import ExponentialBackoff
from redis.exceptions import (
    AuthenticationError,
    BusyLoadingError,
    NoPermissionError,
    OutOfMemoryError,
    RedisError,
)
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError
from redis.retry import Retry

from pileus_service.errors import InputError, printable
from pileus_service.jobs import (
    FORMAT,
    JobView,
    Result,
    Task,
    Wish,
    WorkerInfo,
    WorkerView,
)
from pileus_service.views import job_view

LEASE = 10.0
RENEWAL = 2.5
PRIORITIES = range(10)
GROUP = "workers"
RELEASED = "released"  # the consumer that holds what a worker gave up or lost, as common.lua has it
DRAINED = "drained"
SHARED = ("common", "issue", "attempts")
SCRIPTS = ("submit", "claim", "renew", "complete", "release", "control", "views")
VIEWS = 100  # jobs that are looked at in one step, for which all others wait
UNREACHABLE = (RedisConnectionError, RedisTimeoutError)

Verb = Literal["pause", "resume", "cancel", "remove", "priority", "retry"]


class Standing(NamedTuple):
    """What the service compares with its disk."""

    state: str
    priority: int
    life: int


class Line(NamedTuple):
    """The tasks of a priority: how many wait, how many workers hold, and for how many seconds the
    one that is next has waited."""

    waiting: int
    held: int
    wait: float


class Mark(NamedTuple):
    """A point in the history of one Redis process: the count of changes to any job's standing."""

    process: str
    changes: int


def connect(url: str) -> "Redis":
    """A client that rides out a short absence of Redis."""
    try:
        return Redis.from_url(
            url,
            decode_responses=True,
            socket_timeout=2,
            socket_connect_timeout=2,
            retry=Retry(ExponentialBackoff(cap=0.5, base=0.05), retries=1),
            retry_on_error=[*UNREACHABLE],
        )
    except (ValueError, AttributeError) as error:
        # Never the address itself: it may hold a password.
        raise InputError(f"--redis: {error}; write redis://HOST:PORT/0") from None


def trouble(error: RedisError) -> str:
    """What is the matter with Redis, in words of our own: an error's text may hold its address, and
    that a password."""
    if isinstance(error, AuthenticationError | NoPermissionError):
        return "it refuses the farm's user or password"
    if isinstance(error, BusyLoadingError):
        return "it still reads its file"
    if isinstance(error, OutOfMemoryError):
        return "its memory is full"
    if isinstance(error, RedisTimeoutError):
        return "it timed out"
    if isinstance(error, RedisConnectionError):
        cause = error.__cause__ or error.__context__
        refused = isinstance(cause, ConnectionRefusedError | FileNotFoundError)
        return "nothing listens at its address" if refused else "the connection fails"
    return "it refuses the command"


class Queue:
    """Submitting, claiming, renewing, completing, releasing and steering tasks."""

    def __init__(self, redis: "Redis", lease: float = LEASE, task_format: int = FORMAT) -> None:
        self.redis = redis
        self.lease = lease
        folder = files("pileus_service") / "lua"
        shared = "".join((folder / f"{name}.lua").read_text() for name in SHARED)
        shared = f"local FORMAT = {task_format}\n{shared}"
        self._scripts = {
            name: redis.register_script(shared + (folder / f"{name}.lua").read_text())
            for name in SCRIPTS
        }

    def _run(self, script: str, *args: str | int) -> Any:
        return self._scripts[script](args=[int(self.lease * 1000), *args])

    # The service's side.

    def serves(self, farm: str) -> bool:
        """Whether this Redis is the farm's; one that is nobody's becomes so."""
        if self.farm() is None:  # no write where none is needed: a full Redis takes none
            self.redis.set("pileus:farm", farm, nx=True)
        return self.farm() == farm

    def farm(self) -> str | None:
        """The farm that this Redis serves; None before a service has begun one."""
        return cast(str | None, self.redis.get("pileus:farm"))

    def submit(
        self, job: str, name: str, created: float, frames: int, wish: Wish, done: Iterable[int] = ()
    ) -> bool:
        """Takes a job in, once; `done` are the frames that a former life of it finished."""
        given = {
            "name": name,
            "state": wish.state,
            "priority": wish.priority,
            "life": wish.life,
            "frames": frames,
            "created": int(created * 1000),
            "finished": wish.finished and int(wish.finished * 1000),
            "done": list(done),
            "failed": wish.failed,
        }
        return bool(self._run("submit", job, json.dumps(given)))

    def control(self, job: str, verb: Verb, number: int = 0) -> str | None:
        """Does what a user asks to a job; returns its state afterwards, None if unknown.

        `number` is the new priority, or the life that a retry begins.
        """
        return cast(str | None, self._run("control", job, verb, number))

    def job_ids(self, limit: int, offset: int = 0) -> list[str]:
        """Newest first."""
        oldest, newest = -(offset + limit), -(offset + 1)
        return cast(list[str], self.redis.zrange("pileus:jobs", oldest, newest))[::-1]

    def job(self, job: str) -> JobView | None:
        """A job with its progress, in-flight samples of the workers included."""
        return self.views([job])[0]

    def views(self, jobs: Sequence[str]) -> list[JobView | None]:
        """Jobs, in one round trip for each hundred of them."""
        views: list[JobView | None] = []
        for at in range(0, len(jobs), VIEWS):
            page = jobs[at : at + VIEWS]
            now, rows = json.loads(self._run("views", *page))
            views += [
                job_view(job, row, now / 1000) if row else None
                for job, row in zip(page, rows, strict=True)
            ]
        return views

    def standings(self, jobs: Sequence[str]) -> list[Standing | None]:
        """Of each job, in one round trip; None where Redis knows none."""
        told = cast(list[str | None], self.redis.hmget("pileus:standing", list(jobs)))
        return [_standing(each) if each else None for each in told]

    def changed(self, since: Mark | None) -> tuple[Mark, list[str] | None]:
        """The jobs whose standing has changed since a mark, and the mark for the next time. None
        in their place where that cannot be known: Redis has been started anew or has lost data,
        a job was removed, or a program that keeps no list of changes has made one."""
        ask = self.redis.pipeline(transaction=False)
        ask.info("server")
        ask.get("pileus:changes")
        ask.zrange("pileus:changed", -1, -1, withscores=True)
        ask.zrangebyscore("pileus:changed", f"({since.changes if since else 0}", "+inf")
        server, count, newest, jobs = ask.execute()
        mark = Mark(server["run_id"], int(count or 0))
        if since is None or mark.process != since.process or mark.changes < since.changes:
            return mark, None
        listed = newest[0][1] if newest else 0
        if mark.changes > since.changes and listed < mark.changes:
            return mark, None
        return mark, jobs

    def state(self, job: str) -> str | None:
        return cast(str | None, self.redis.hget(f"pileus:job:{job}", "state"))

    def failed(self, job: str, frames: Sequence[int] | None = None) -> dict[int, str]:
        """Reason by frame index, of some frames or of all."""
        key = f"pileus:job:{job}:failed"
        if frames is None:
            held = cast(dict[str, str], self.redis.hgetall(key))
            return {int(frame): reason for frame, reason in held.items()}
        ask = list(map(str, frames))
        told = cast(list[str | None], self.redis.hmget(key, ask)) if ask else []
        return {frame: why for frame, why in zip(frames, told, strict=True) if why is not None}

    def failed_frames(self, job: str) -> set[int]:
        """The indices of the frames that have failed."""
        return set(map(int, self.redis.hkeys(f"pileus:job:{job}:failed")))

    def done(self, job: str) -> set[int]:
        """The indices of the frames that are done."""
        ask = cast(Callable[..., bytes | None], self.redis.execute_command)
        return {
            8 * index + bit
            for index, byte in enumerate(
                ask("GET", f"pileus:job:{job}:done", NEVER_DECODE=True) or b""
            )
            for bit in range(8)
            if byte & 0x80 >> bit
        }

    def waiting(self, job: str) -> dict[int, str]:
        """The frames that wait for their caches: reason by frame index."""
        held = cast(dict[str, str], self.redis.hgetall(f"pileus:job:{job}:waiting"))
        return {int(frame): reason for frame, reason in held.items()}

    def workers(self) -> list[WorkerView]:
        """Those seen within a day, the live ones first."""
        ask = self.redis.pipeline(transaction=False)
        ask.time()
        ask.zrange("pileus:alive", 0, -1, withscores=True)
        ask.zrange("pileus:aside", 0, -1, withscores=True)
        ask.hgetall("pileus:aside:why")
        (seconds, micros), seen, aside, why = ask.execute()
        if not seen:
            return []
        now = seconds + micros / 1e6
        kept_off = {name for name, until in aside if until / 1000 > now}
        infos = self.redis.mget([f"pileus:worker:{name}" for name, _ in seen])
        views = [
            WorkerView(
                **dict(WorkerInfo.model_validate_json(info)),
                seen=score / 1000,
                alive=now - score / 1000 <= self.lease,
                aside=why.get(name, "") if name in kept_off else None,
            )
            for (name, score), info in zip(seen, cast(list[str | None], infos), strict=True)
            if info is not None
        ]
        return sorted(views, key=lambda view: (not view.alive, view.name))

    def worker_names(self) -> list[str]:
        return cast(list[str], self.redis.zrange("pileus:alive", 0, -1))

    def drain(self, worker: str) -> None:
        """Gives a worker no more tasks; what it has in hand it finishes."""
        self.redis.zadd("pileus:aside", {worker: "+inf"})
        self.redis.hset("pileus:aside:why", worker, DRAINED)

    def undrain(self, worker: str) -> None:
        """Gives a worker tasks again that was drained or set aside."""
        self.redis.zrem("pileus:aside", worker)
        self.redis.hdel("pileus:aside:why", worker)

    def now(self) -> float:
        seconds, micros = self.redis.time()
        return seconds + micros / 1e6

    def stats(self) -> dict[str, int]:
        held = cast(dict[str, str], self.redis.hgetall("pileus:stats"))
        return {name: int(value) for name, value in held.items()}

    def lines(self) -> dict[int, Line]:
        """What waits and what is held, of each priority that has a stream."""
        ask = self.redis.pipeline(transaction=False)
        ask.time()
        for priority in PRIORITIES:
            ask.exists(f"pileus:tasks:{priority}")
        (seconds, micros), *there = ask.execute()
        streams = {each: f"pileus:tasks:{each}" for each in PRIORITIES if there[each]}
        for stream in streams.values():
            ask.xlen(stream)
            ask.xpending(stream, GROUP)
            ask.xinfo_groups(stream)
        told = ask.execute()
        for stream, [group] in zip(streams.values(), told[2::3], strict=True):
            ask.xrange(stream, f"({group['last-delivered-id']}", "+", 1)
        lines = {}
        each = zip(streams, told[::3], told[1::3], ask.execute(), strict=True)
        for priority, length, pending, ahead in each:
            begun = int(ahead[0][0].split("-")[0]) / 1000 if ahead else math.inf
            wait = max(0.0, seconds + micros / 1e6 - begun)
            owners = pending["consumers"]
            held = sum(owner["pending"] for owner in owners if owner["name"] != RELEASED)
            lines[priority] = Line(length - held, held, wait)
        return lines

    def depths(self) -> dict[int, tuple[int, int]]:
        """Entries waiting and entries held by workers, of each priority that has a stream."""
        return {priority: (line.waiting, line.held) for priority, line in self.lines().items()}

    def forget_dead(self) -> None:
        """Drops workers not seen for a day, so that restarts leave nothing behind."""
        before = (self.now() - 86400) * 1000
        gone = cast(list[str], self.redis.zrangebyscore("pileus:alive", "-inf", before))
        for name in gone:
            self.leave(name)

    # The workers' side.

    def claim(
        self, info: WorkerInfo, farm: str | None = None, *, able: bool = True, trouble: str = ""
    ) -> Task | None:
        """The next task for a worker, or None; says that the worker lives either way.

        One that is not `able` to do a task gets none, and is shown as set aside while it has
        `trouble`, or a data folder (of `farm`) that is not the one this Redis is for.
        """
        reason = printable(trouble)[:500]
        told = info.model_dump_json()
        found = self._run("claim", info.name, told, int(able), reason, farm or "")
        if not found:
            return None
        priority, entry, attempt, job, frame, kind, part = found
        return Task(
            priority=int(priority),
            entry=entry,
            attempt=int(attempt),
            job=job,
            frame=int(frame),
            kind=kind,
            part=int(part),
        )

    def renew(self, task: Task, info: WorkerInfo) -> Literal["held", "unwanted", "lost"]:
        """Renews a lease, unless nobody wants the work any more or another has it now."""
        told = info.model_dump_json()
        answer = self._run("renew", info.name, task.priority, task.entry, told, info.samples)
        return cast(Literal["held", "unwanted", "lost"], answer)

    def complete(self, task: Task, worker: str, result: Result) -> bool:
        """Counts a task done, once; False if the lease was lost."""
        told = result.model_dump_json()
        return bool(self._run("complete", worker, task.priority, task.entry, told))

    def fail(self, task: Task, worker: str, reason: str) -> Literal["released", "parked", "lost"]:
        """Ends an attempt that failed; another worker can take the task at once."""
        outcome = self._run(
            "release", worker, task.priority, task.entry, printable(reason)[:500] or "failed"
        )
        return cast(Literal["released", "parked", "lost"], outcome)

    def hand_back(self, task: Task, worker: str) -> None:
        """Gives a task back untried."""
        self._run("release", worker, task.priority, task.entry, "")

    def leave(self, worker: str) -> None:
        """Says goodbye: a worker that ends in order is not waited for."""
        self.redis.zrem("pileus:alive", worker)
        self.redis.delete(f"pileus:worker:{worker}")
        self.redis.hdel("pileus:versions", worker)
        self.redis.hdel("pileus:formats", worker)
        self.redis.hdel("pileus:strikes", worker)
        self.undrain(worker)
        for priority in PRIORITIES:
            stream = f"pileus:tasks:{priority}"
            if self.redis.exists(stream):
                pending = cast(
                    list[Any], self.redis.xpending_range(stream, GROUP, "-", "+", 1, worker)
                )
                if not pending:
                    self.redis.xgroup_delconsumer(stream, GROUP, worker)


def _standing(told: str) -> Standing:
    state, priority, life = told.split()
    return Standing(state, int(priority), int(life))
