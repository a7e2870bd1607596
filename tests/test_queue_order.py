"""What comes next, against a real Redis: priorities, equal shares, a bounded window."""

import time

from redis import Redis

from pileus_service.jobs import Kind, Waiting
from pileus_service.queue import Queue
from queueing import A, do, planned, submit, take, take_all, view


def test_higher_priority_goes_first_and_a_change_moves_waiting_tasks_once(queue: Queue) -> None:
    submit(queue, "low", frames=4, priority=2)
    submit(queue, "high", frames=1, priority=8)
    assert take(queue).job == "high"
    submit(queue, "middle", frames=1, priority=5)
    for priority in (9, 2, 9):
        queue.control("low", "priority", priority)
    order = [(task.job, task.frame) for task in take_all(queue)]
    assert order == [("low", 0), ("low", 1), ("middle", 0)]


def test_equal_jobs_take_turns_and_none_waits_for_another_to_end(queue: Queue) -> None:
    for job in "abcde":
        submit(queue, job, frames=50)
    turns = []
    for _ in range(200):
        task = take(queue)
        turns.append(task.job)
        do(queue, task, tasks=5)
    shares = [turns.count(job) for job in "abcde"]
    assert max(shares) - min(shares) <= 7, "more than a frame's tasks apart"
    submit(queue, "late", frames=1)
    # The window of those that wait already, and one turn of each: then it has its first.
    assert "late" in [task.job for task in take_all(queue)[: 8 + 5 + 1]]


def test_parts_found_on_disk_are_not_issued(queue: Queue) -> None:
    submit(queue)
    queue.complete(take(queue), "A", planned(4, finished=[0, 2, 3]))
    task = take(queue)
    assert (task.kind, task.part) == (Kind.RENDER, 1)
    do(queue, task)
    assert take(queue).kind is Kind.MERGE


def test_a_frame_waits_for_its_cache_while_others_go_on(queue: Queue, redis: Redis) -> None:
    submit(queue, frames=2)
    first = take(queue)
    assert queue.complete(first, "A", Waiting(wait="not there yet"))
    while task := queue.claim(A):
        assert task.frame == 1
        do(queue, task)
    assert queue.waiting("job") == {0: "not there yet"}
    assert view(queue) == ("running", 1, 0)
    redis.zadd("pileus:due", {"job 0": 0})  # as if its time had come
    redis.delete("pileus:clock")
    assert take(queue).frame == 0


def test_what_waits_in_redis_does_not_grow_with_the_jobs(queue: Queue) -> None:
    for number in range(50):
        submit(queue, f"job{number}", frames=1000)
    assert queue.depths()[5] == (8, 0)


def test_a_million_tasks_hold_little_in_redis(queue: Queue, redis: Redis) -> None:
    submit(queue, frames=100)
    do(queue, take(queue), tasks=10_000)
    assert queue.depths()[5][0] <= 10
    assert sum(redis.memory_usage(key) or 0 for key in redis.scan_iter()) < 100_000


def test_lag_stays_true_for_scalers(queue: Queue, redis: Redis) -> None:
    submit(queue, frames=4, priority=3)
    do(queue, take(queue))
    queue.control("job", "priority", 6)
    [group] = redis.xinfo_groups("pileus:tasks:6")
    waiting = redis.xlen("pileus:tasks:6")
    assert group["lag"] == waiting > 0


def test_how_long_the_next_task_has_waited(queue: Queue) -> None:
    submit(queue, frames=2)
    time.sleep(0.2)
    submit(queue, "later", priority=7)
    lines = queue.lines()
    assert lines[5].wait >= lines[7].wait + 0.199
    first = take(queue)
    assert (first.job, queue.lines()[7]) == ("later", (0, 1, 0.0))
    queue.hand_back(first, "A")
    assert queue.depths()[7] == (1, 0), "what was given up waits again"
