"""Workers that claim, do and lose tasks of a queue without rendering anything."""

import time

from pileus_service.jobs import Kind, Merged, Planned, Rendered, Task, Wish, WorkerInfo
from pileus_service.queue import Queue

LEASE = 2.0


def worker(name: str) -> WorkerInfo:
    return WorkerInfo(name=name, host="host", pid=1, threads=1, started=1764095323.25)


A, B, C, D = (worker(name) for name in "ABCD")


def submit(queue: Queue, job: str = "job", frames: int = 1, priority: int = 5) -> None:
    assert queue.submit(job, job, time.time(), frames, Wish(priority=priority))


def planned(tasks: int, finished: list[int] | None = None) -> Planned:
    return Planned(tasks=tasks, finished=finished or [], total=tasks * 10, samples=0)


def take(queue: Queue, info: WorkerInfo = A) -> Task:
    task = queue.claim(info)
    assert task is not None
    return task


def take_all(queue: Queue) -> list[Task]:
    """Every task that there is, each by a worker of its own."""
    tasks: list[Task] = []
    while task := queue.claim(worker(f"W{len(tasks)}")):
        tasks.append(task)
    return tasks


def do(queue: Queue, task: Task, info: WorkerInfo = A, tasks: int = 3) -> bool:
    """Completes a task as a worker would, each plan with so many tasks."""
    results: dict[Kind, Planned | Rendered | Merged] = {
        Kind.PLAN: planned(tasks),
        Kind.RENDER: Rendered(samples=10, taken=10),
        Kind.MERGE: Merged(),
    }
    return queue.complete(task, info.name, results[task.kind])


def view(queue: Queue, job: str = "job") -> tuple[str, int, int]:
    seen = queue.job(job)
    assert seen is not None
    return seen.state, seen.frames_done, seen.frames_failed


def lapse(queue: Queue) -> None:
    """All leases run out, as if nothing had been heard of any worker for their time."""
    for priority in queue.depths():
        stream = f"pileus:tasks:{priority}"
        for held in queue.redis.xpending_range(stream, "workers", "-", "+", 100):
            owner, entry = held["consumer"], held["message_id"]
            old = int(LEASE * 1000) + 1
            queue.redis.execute_command(  # type: ignore[no-untyped-call]
                *("XCLAIM", stream, "workers", owner, 0, entry, "IDLE", old, "JUSTID")
            )
    queue.redis.delete("pileus:alive", "pileus:clock")
