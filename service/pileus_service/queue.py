"""The queue on Redis Streams: the one class through which service and workers use Redis.

A task is a stream entry; Redis's consumer group is its lease, and the delivery count its attempts.
Each step is one Lua script (lua/), so it happens whole or not at all. Redis holds only what is in
flight: `pileus_service.store` is the truth.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable
from importlib.resources import files
from typing import Any, Literal, cast

from redis import Redis
from redis.backoff import ExponentialBackoff
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError
from redis.retry import Retry

from pileus_service.errors import InputError, printable
from pileus_service.jobs import (
    FORMAT,
    FrameView,
    JobState,
    JobView,
    Result,
    Task,
    Wish,
    WorkerInfo,
    WorkerView,
)

LEASE = 10.0
RENEWAL = 2.5
PRIORITIES = range(10)
GROUP = "workers"
SCRIPTS = ("submit", "claim", "renew", "complete", "release", "control")
UNREACHABLE = (RedisConnectionError, RedisTimeoutError)

Verb = Literal["pause", "resume", "cancel", "remove", "priority"]
FRAME_STATES: dict[str, Literal["planning", "rendering", "merging"]] = {
    "plan": "planning",
    "render": "rendering",
    "merge": "merging",
}


def connect(url: str) -> "Redis":
    """A client that rides out a short absence of Redis."""
    try:
        return Redis.from_url(
            url,
            decode_responses=True,
            socket_timeout=5,
            socket_connect_timeout=5,
            retry=Retry(ExponentialBackoff(cap=0.5, base=0.05), retries=3),
            retry_on_error=[*UNREACHABLE],
        )
    except (ValueError, AttributeError) as error:
        # Never the address itself: it may hold a password.
        raise InputError(f"--redis: {error}; write redis://HOST:PORT/0") from None


class Queue:
    """Submitting, claiming, renewing, completing, releasing and steering tasks."""

    def __init__(self, redis: "Redis", lease: float = LEASE, task_format: int = FORMAT) -> None:
        self.redis = redis
        self.lease = lease
        folder = files("pileus_service") / "lua"
        common = f"local FORMAT = {task_format}\n" + (folder / "common.lua").read_text()
        self._scripts = {
            name: redis.register_script(common + (folder / f"{name}.lua").read_text())
            for name in SCRIPTS
        }

    def _run(self, script: str, *args: str | int) -> Any:
        return self._scripts[script](args=[int(self.lease * 1000), *args])

    # The service's side.

    def submit(
        self, job: str, name: str, created: float, frames: int, wish: Wish, done: Iterable[int] = ()
    ) -> bool:
        """Takes a job in, once; `done` are the frames that a former life of it finished."""
        given = {
            "name": name,
            "state": wish.state,
            "priority": wish.priority,
            "frames": frames,
            "created": int(created * 1000),
            "finished": wish.finished and int(wish.finished * 1000),
            "done": list(done),
            "failed": wish.failed,
        }
        return bool(self._run("submit", job, json.dumps(given)))

    def control(self, job: str, verb: Verb, priority: int = 0) -> str | None:
        """Does what a user asks to a job; returns its state afterwards, None if unknown."""
        return cast(str | None, self._run("control", job, verb, priority))

    def job_ids(self) -> list[str]:
        return cast(list[str], self.redis.zrange("pileus:jobs", 0, -1))

    def job(self, job: str, workers: list[WorkerView] | None = None) -> JobView | None:
        """A job with its progress, in-flight samples of the workers included."""
        held = cast(dict[str, str], self.redis.hgetall(f"pileus:job:{job}"))
        if not held:
            return None
        failed = self.failed(job)
        frames, done = int(held["frames"]), int(held["done"])
        active = self.active(job, self.workers() if workers is None else workers)
        settled = done + len(failed) + sum(frame.progress for frame in active.values())
        state = JobState(held["state"])
        if state is JobState.RUNNING and "started" not in held:
            state = JobState.QUEUED
        left = None
        gained = settled - int(held["restored"])
        if state is JobState.RUNNING and gained > 0:
            spent = self.now() - int(held["started"]) / 1000
            left = spent * (frames - settled) / gained
        reason = f"frame {min(failed)}: {failed[min(failed)]}" if failed else None
        return JobView(
            id=job,
            name=held["name"],
            state=state,
            priority=int(held["priority"]),
            frames=frames,
            frames_done=done,
            frames_failed=len(failed),
            progress=settled / frames,
            samples=int(held["samples"]),
            tasks=int(held["tasks"]),
            created=int(held["created"]) / 1000,
            started=int(held["started"]) / 1000 if "started" in held else None,
            finished=int(held["finished"]) / 1000 if "finished" in held else None,
            seconds_left=left,
            reason=reason,
            active=list(active.values()),
        )

    def state(self, job: str) -> str | None:
        return cast(str | None, self.redis.hget(f"pileus:job:{job}", "state"))

    def standing(self, job: str) -> tuple[str | None, int]:
        """A job's state (None if unknown) and priority."""
        state, priority = cast(
            list[str | None], self.redis.hmget(f"pileus:job:{job}", "state", "priority")
        )
        return state, int(priority or 0)

    def failed(self, job: str) -> dict[int, str]:
        """Reason by frame index."""
        held = cast(dict[str, str], self.redis.hgetall(f"pileus:job:{job}:failed"))
        return {int(frame): reason for frame, reason in held.items()}

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

    def active(self, job: str, workers: list[WorkerView]) -> dict[int, FrameView]:
        """The frames in flight, by index (which stands in their `frame` too)."""
        in_flight: dict[int, int] = {}
        for worker in workers:
            if worker.alive and worker.task and worker.task.job == job:
                frame = worker.task.frame
                in_flight[frame] = in_flight.get(frame, 0) + worker.samples
        views: dict[int, FrameView] = {}
        for index in cast(list[str], self.redis.zrange(f"pileus:job:{job}:active", 0, -1)):
            held = cast(dict[str, str], self.redis.hgetall(f"pileus:job:{job}:frame:{index}"))
            if not held:
                continue
            total = int(held["total"])
            samples = int(held["samples"]) + in_flight.get(int(index), 0)
            views[int(index)] = FrameView(
                frame=int(index),
                state=FRAME_STATES[held["state"]],
                tasks=int(held["tasks"]),
                tasks_done=int(held["done"]),
                progress=min(1.0, samples / total) if total else 0.0,
            )
        return views

    def workers(self) -> list[WorkerView]:
        """Those seen within a day, the live ones first."""
        seen = cast(
            list[tuple[str, float]], self.redis.zrange("pileus:alive", 0, -1, withscores=True)
        )
        now = self.now()
        views = []
        for name, score in seen:
            info = cast(str | None, self.redis.get(f"pileus:worker:{name}"))
            if info is None:
                continue
            alive = now - score / 1000 <= self.lease
            told = WorkerInfo.model_validate_json(info)
            views.append(WorkerView(**dict(told), seen=score / 1000, alive=alive))
        return sorted(views, key=lambda view: (not view.alive, view.name))

    def now(self) -> float:
        seconds, micros = self.redis.time()
        return seconds + micros / 1e6

    def stats(self) -> dict[str, int]:
        held = cast(dict[str, str], self.redis.hgetall("pileus:stats"))
        return {name: int(value) for name, value in held.items()}

    def depths(self) -> dict[int, tuple[int, int]]:
        """Entries waiting and entries held by workers, of each priority that has a stream."""
        depths = {}
        for priority in PRIORITIES:
            stream = f"pileus:tasks:{priority}"
            if self.redis.exists(stream):
                length = self.redis.xlen(stream)
                held = cast(dict[str, int], self.redis.xpending(stream, GROUP))["pending"]
                depths[priority] = (length - held, held)
        return depths

    def waits(self) -> dict[int, float]:
        """Seconds that the next task of each priority has waited; 0 where none waits."""
        waits = {}
        for priority in PRIORITIES:
            stream = f"pileus:tasks:{priority}"
            if self.redis.exists(stream):
                [group] = cast(list[dict[str, str]], self.redis.xinfo_groups(stream))
                after = f"({group['last-delivered-id']}"
                ahead = cast(list[Any], self.redis.xrange(stream, after, "+", 1))
                begun = int(ahead[0][0].split("-")[0]) / 1000 if ahead else self.now()
                waits[priority] = max(0.0, self.now() - begun)
        return waits

    def jobs_by_state(self) -> dict[JobState, int]:
        """How many jobs there are in each state; those not begun count as running."""
        pipe = self.redis.pipeline(transaction=False)
        for job in self.job_ids():
            pipe.hget(f"pileus:job:{job}", "state")
        found = Counter(pipe.execute())
        return {state: found[state] for state in JobState if state is not JobState.QUEUED}

    def forget_dead(self) -> None:
        """Drops workers not seen for a day, so that restarts leave nothing behind."""
        before = (self.now() - 86400) * 1000
        gone = cast(list[str], self.redis.zrangebyscore("pileus:alive", "-inf", before))
        for name in gone:
            self.leave(name)

    # The workers' side.

    def claim(self, info: WorkerInfo) -> Task | None:
        """The next task for a worker, or None; says that the worker lives either way."""
        found = self._run("claim", info.name, info.model_dump_json())
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

    def renew(self, task: Task, info: WorkerInfo) -> bool:
        """Renews a lease; False if another has it now and the work is to be dropped."""
        told = info.model_dump_json()
        return bool(self._run("renew", info.name, task.priority, task.entry, told))

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
        for priority in PRIORITIES:
            stream = f"pileus:tasks:{priority}"
            if self.redis.exists(stream):
                pending = cast(
                    list[Any], self.redis.xpending_range(stream, GROUP, "-", "+", 1, worker)
                )
                if not pending:
                    self.redis.xgroup_delconsumer(stream, GROUP, worker)
