"""Workers that only pretend to render, over the real queue code and a real Redis.

    .venv/bin/python -m farm.simulation            # every figure
    .venv/bin/python -m farm.simulation growth     # one of them

`cycles`: claim and complete as fast as it goes, 64 workers. `growth`: 1 to 1,000 workers with tasks
of 4 s, renewed and looked after as real ones are; what Redis spends on them, what they wait.
`memory`: a job of a million tasks. `fairness`: 1,000 jobs of mixed priority.
"""

import heapq
import json
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from pileus_service.jobs import Kind, Merged, Planned, Rendered, Result, Task, Wish, WorkerInfo
from pileus_service.queue import RENEWAL, Queue, connect
from pileus_worker.private_redis import PrivateRedis
from pileus_worker.supervisor import IDLE, LOOK

TASKS = 1000  # of a frame


def worker(number: int) -> WorkerInfo:
    return WorkerInfo(name=f"host-{number:04d}", host="host", pid=number, threads=8, started=0.0)


def result(task: Task, tasks: int = TASKS) -> Result:
    if task.kind is Kind.PLAN:
        return Planned(tasks=tasks, finished=[], total=tasks * 1000, samples=0)
    return Rendered(samples=1000, taken=1000) if task.kind is Kind.RENDER else Merged()


def submit(queue: Queue, job: str, frames: int, priority: int = 5) -> None:
    queue.submit(job, job, time.time(), frames, Wish(priority=priority))


def spin(url: str, first: int, count: int, seconds: float) -> int:
    """Claims and completes without a pause; how often."""
    queue = Queue(connect(url))
    infos = [worker(number) for number in range(first, first + count)]
    cycles, end = 0, time.monotonic() + seconds
    while time.monotonic() < end:
        for info in infos:
            if task := queue.claim(info):
                queue.complete(task, info.name, result(task))
                cycles += 1
    return cycles


def cycles(url: str, processes: int = 2, workers: int = 64, seconds: float = 10) -> dict[str, Any]:
    queue = Queue(connect(url))
    submit(queue, "spin", 100_000)
    before = spent(queue)
    each = workers // processes
    with pool(processes) as others:
        runs = [
            others.submit(spin, url, number * each, each, seconds) for number in range(processes)
        ]
        done = sum(run.result() for run in runs)
    share = (spent(queue) - before) / seconds
    return {
        "workers": workers,
        "cycles_a_second": round(done / seconds),
        "redis_core_share": round(share, 2),
        "cycles_a_second_if_clients_were_free": round(done / seconds / share),
    }


def live(url: str, first: int, count: int, seconds: float, task: float) -> dict[str, list[float]]:
    """Workers as `Supervisor` has them: claim, look, renew, complete. What each took."""
    queue = Queue(connect(url))
    begun = time.monotonic()
    took: dict[str, list[float]] = {
        "claim": [],
        "renew": [],
        "complete": [],
        "late": [],
        "busy": [],
    }
    infos = [worker(number) for number in range(first, first + count)]
    held: dict[int, tuple[Task, float]] = {}
    # Spread over a task's time, as workers that started at different times are.
    due = [(begun + task * n / count, n, "claim") for n in range(count)]
    heapq.heapify(due)

    def timed(name: str, act: Callable[[], Any]) -> Any:
        at = time.perf_counter()
        answer = act()
        took[name].append(time.perf_counter() - at)
        return answer

    while due[0][0] < begun + seconds:
        when, n, what = heapq.heappop(due)
        late = time.monotonic() - when
        if late < 0:
            time.sleep(-late)
        else:
            took["late"].append(late)
        now = time.monotonic()
        if what == "claim":
            given = timed("claim", lambda: queue.claim(infos[n]))  # noqa: B023, called at once
            if given is None:
                heapq.heappush(due, (now + IDLE, n, "claim"))
                continue
            held[n] = given, now + task
            heapq.heappush(due, (now, n, "renew"))
            heapq.heappush(due, (now + LOOK, n, "look"))
            heapq.heappush(due, (now + task, n, "complete"))
        elif what == "complete":
            mine, _ = held.pop(n)
            timed("complete", lambda: queue.complete(mine, infos[n].name, result(mine)))  # noqa: B023
            took["busy"].append(task)
            heapq.heappush(due, (now, n, "claim"))
        elif n in held:
            mine, ends = held[n]
            if what == "renew":
                timed("renew", lambda: queue.renew(mine, infos[n]))  # noqa: B023
            else:
                queue.state(mine.job)
            pause = RENEWAL if what == "renew" else LOOK
            if now + pause < ends:
                heapq.heappush(due, (now + pause, n, what))
    return took


def growth(url: str, seconds: float = 20, task: float = 4.0) -> list[dict[str, Any]]:
    rows = []
    for workers in (1, 10, 100, 300, 1000):
        queue = Queue(connect(url))
        queue.redis.flushall()
        for number in range(10):
            submit(queue, f"job{number}", 1000)
        processes = 1 if workers < 100 else 2
        before, each = spent(queue), workers // processes
        with pool(processes) as others:
            runs = [
                others.submit(live, url, number * each, each, seconds, task)
                for number in range(processes)
            ]
            took: dict[str, list[float]] = {}
            for run in runs:
                for name, times in run.result().items():
                    took.setdefault(name, []).extend(times)
        share = (spent(queue) - before) / seconds
        rows.append(
            {
                "workers": workers,
                "tasks_a_second": round(len(took["complete"]) / seconds, 1),
                "redis_core_share": round(share, 3),
                "claim_ms_p50_p99": percentiles(took["claim"]),
                "complete_ms_p50_p99": percentiles(took["complete"]),
                "renew_ms_p50_p99": percentiles(took["renew"]),
                "simulator_late_ms_p50_p99": percentiles(took["late"]),
                "redis_mb": round(queue.redis.info("memory")["used_memory"] / 1e6, 1),
            }
        )
        print(json.dumps(rows[-1]), flush=True)
    return rows


def memory(url: str) -> dict[str, Any]:
    """100 frames of 10,000 tasks: what they hold at their fullest, with 10 and 1,000 workers."""
    told: dict[str, Any] = {}
    for workers in (10, 1000):
        queue = Queue(connect(url))
        queue.redis.flushall()
        empty = queue.redis.info("memory")["used_memory"]
        infos = [worker(number) for number in range(workers)]
        for info in infos:
            queue.claim(info)
        submit(queue, "million", 100)
        most = 0
        done, round_trips = 0, 0
        held: dict[int, Task] = {}
        while done < 20_000:
            for n, info in enumerate(infos):
                if mine := held.pop(n, None):
                    queue.complete(mine, info.name, result(mine, 10_000))
                    done += 1
                if task := queue.claim(info):
                    held[n] = task
            round_trips += 1
            if round_trips % 5 == 0:
                most = max(most, queue.redis.info("memory")["used_memory"] - empty)
        told[f"mb_with_{workers}_workers"] = round(most / 1e6, 2)
    return told


def fairness(url: str, jobs: int = 1000, frames: int = 3, tasks: int = 8) -> dict[str, Any]:
    """Jobs of priorities 0 to 9; each claim must be of the highest that has any; equals share."""
    queue = Queue(connect(url))
    queue.redis.flushall()
    left = Counter[int]()
    for number in range(jobs):
        submit(queue, f"job{number:04d}", frames, priority=number % 10)
        left[number % 10] += frames
    infos = [worker(number) for number in range(20)]
    out_of_order = 0
    first: dict[str, int] = {}
    at = {priority: Counter[str]() for priority in range(10)}
    spread: dict[int, int] = {}
    done = 0
    while sum(left.values()) > 0:
        for info in infos:
            task = queue.claim(info)
            if task is None:
                continue
            highest = max(priority for priority, frames_left in left.items() if frames_left)
            out_of_order += task.priority < highest
            first.setdefault(task.job, done)
            done += 1
            shares = at[task.priority]
            shares[task.job] += 1
            # The spread of equals midway, when all of them still have work to do.
            if sum(shares.values()) == jobs // 10 * frames * (tasks + 2) // 2:
                spread[task.priority] = max(shares.values()) - min(shares.values())
            queue.complete(task, info.name, result(task, tasks))
            left[task.priority] -= task.kind is Kind.MERGE
    ends = {view.id for view in queue.views(list(first)) if view and view.state == "done"}
    return {
        "jobs": jobs,
        "done": len(ends),
        "tasks": done,
        "claims_while_a_higher_priority_had_work": out_of_order,
        "tasks_between_the_most_and_least_served_equal_midway": max(spread.values()),
        "of_tasks_each": frames * (tasks + 2) // 2,
    }


def spent(queue: Queue) -> float:
    """Seconds of processor time that Redis has used."""
    told = queue.redis.info("cpu")
    return float(told["used_cpu_user"]) + float(told["used_cpu_sys"])


def percentiles(seconds: list[float]) -> tuple[float, float]:
    if len(seconds) < 2:
        return (0.0, 0.0)
    cuts = statistics.quantiles(seconds, n=100)
    return round(cuts[49] * 1000, 2), round(cuts[98] * 1000, 2)


def pool(processes: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(processes, mp_context=get_context("spawn"))


def main() -> None:
    figures: dict[str, Callable[[str], Any]] = {
        "cycles": cycles,
        "growth": growth,
        "memory": memory,
        "fairness": fairness,
    }
    for name in sys.argv[1:] or figures:
        with (
            tempfile.TemporaryDirectory() as folder,
            PrivateRedis(Path(folder)) as redis,
        ):
            print(json.dumps({name: figures[name](redis.url)}), flush=True)


if __name__ == "__main__":
    main()
