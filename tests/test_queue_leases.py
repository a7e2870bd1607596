"""Leases and attempts, against a real Redis: who has a task, and how often it is tried."""

import time
from typing import cast

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from redis import Redis

from pileus_service.jobs import Kind, Merged, Replan, Stale, Task, Waiting, WorkerInfo
from pileus_service.queue import Queue, Verb
from queueing import LEASE, A, B, C, D, do, lapse, submit, take, view, worker


def test_an_expired_lease_goes_to_another_and_the_thawed_worker_cannot_take_it_back(
    queue: Queue,
) -> None:
    submit(queue)
    frozen = take(queue, A)
    assert queue.claim(B) is None
    lapse(queue)
    again = take(queue, B)
    assert (again.entry, again.attempt) == (frozen.entry, 2)
    assert queue.renew(frozen, A) == "lost"
    assert not do(queue, frozen, A)
    assert queue.fail(frozen, "A", "late") == "lost"
    assert queue.renew(again, B) == "held"
    assert do(queue, again, B)


def test_an_absence_of_redis_costs_nobody_an_attempt(redis: Redis) -> None:
    queue = Queue(redis, lease=0.4)
    submit(queue)
    task = take(queue)
    for _ in range(4):
        time.sleep(0.5)  # nobody reaches Redis for more than a lease
        assert queue.claim(B) is None, "A has not had its time to renew"
        task = take(queue)  # A had to drop it
        assert task.attempt == 1
    end = time.monotonic() + 10
    while (again := queue.claim(B)) is None:
        assert time.monotonic() < end
        time.sleep(0.02)
    assert again.attempt == 2, "B was there, and A was not"


def test_a_claim_whose_answer_was_not_heard_costs_no_attempt(queue: Queue) -> None:
    submit(queue, "low", priority=2)
    unheard = take(queue, A)
    submit(queue, "high", priority=8)
    heard = take(queue, A)
    assert heard.job == "high"
    again = take(queue, B)
    assert (again.entry, again.attempt) == (unheard.entry, 1)
    assert do(queue, heard, A)
    assert do(queue, again, B)
    assert "attempts_failed" not in queue.stats()


def test_renewal_keeps_the_lease_and_the_attempt_count(queue: Queue) -> None:
    submit(queue)
    task = take(queue, A)
    for _ in range(3):
        time.sleep(LEASE / 2)
        assert queue.renew(task, A) == "held"
        assert queue.claim(B) is None
    lapse(queue)
    assert take(queue, B).attempt == 2


def test_unwanted_work_is_known_at_renewal(queue: Queue) -> None:
    submit(queue)
    task = take(queue)
    queue.control("job", "cancel")
    assert queue.renew(task, A) == "unwanted"


def test_three_failed_attempts_on_distinct_workers_park_the_task_and_fail_its_frame(
    queue: Queue,
) -> None:
    submit(queue, frames=1)
    for info in (A, B, C, D):
        queue.claim(info)  # makes itself known; A gets the task
    task = Task(
        priority=5, entry=_entry(queue), attempt=1, job="job", frame=0, kind=Kind.PLAN, part=0
    )
    assert queue.fail(task, "A", "no grid") == "released"
    assert queue.claim(A) is None, "the same worker tries again only where no other lives"
    assert take(queue, B).attempt == 2
    assert queue.fail(task, "B", "no grid") == "released"
    assert queue.claim(B) is None
    assert take(queue, C).attempt == 3
    assert queue.fail(task, "C", "no memory") == "parked"
    assert queue.claim(D) is None
    assert view(queue) == ("failed", 0, 1)
    assert queue.failed("job") == {0: "plan failed: A: no grid; B: no grid; C: no memory"}


def _entry(queue: Queue) -> str:
    [pending] = queue.redis.xpending_range("pileus:tasks:5", "workers", "-", "+", 2)
    return str(pending["message_id"])


def test_a_lone_worker_makes_all_three_attempts(queue: Queue) -> None:
    submit(queue, frames=2)
    for outcome in ("released", "released", "parked"):
        task = take(queue)
        assert task.frame == 0
        assert queue.fail(task, "A", "crashed") == outcome
    assert take(queue).frame == 1, "the next frame goes on"


def test_a_worker_lost_three_times_over_parks_the_task_too(queue: Queue) -> None:
    submit(queue)
    for info in (A, B, C):
        take(queue, info)
        lapse(queue)
    assert queue.claim(D) is None
    reason = queue.failed("job")[0]
    assert reason == "plan failed: A: stopped answering; B: stopped answering; C: stopped answering"


def test_a_task_handed_back_counts_no_attempt(queue: Queue) -> None:
    submit(queue)
    for _ in range(5):
        task = take(queue)
        assert task.attempt == 1
        queue.hand_back(task, "A")


def test_completion_counts_once_however_often_a_task_was_done(queue: Queue) -> None:
    submit(queue)
    do(queue, take(queue), tasks=2)
    first = take(queue, A)
    lapse(queue)
    second = take(queue, B)
    assert do(queue, second, B)
    assert not do(queue, first, A)
    assert not do(queue, second, B)
    seen = queue.job("job")
    assert seen is not None
    assert (seen.samples, seen.tasks) == (10, 2)


def test_a_damaged_partial_is_rendered_again_a_bounded_number_of_times(queue: Queue) -> None:
    submit(queue)
    do(queue, take(queue), tasks=3)
    for _ in range(3):
        do(queue, take(queue))
    for _ in range(4):
        merge = take(queue)
        assert merge.kind is Kind.MERGE
        queue.complete(merge, "A", Merged(redo=[1], reason="part 1 is damaged"))
        task = queue.claim(A)
        if task:
            assert (task.kind, task.part) == (Kind.RENDER, 1)
            do(queue, task)
    assert queue.failed("job") == {0: "merge failed: part 1 is damaged"}


def test_a_stale_plan_is_made_anew_a_bounded_number_of_times(queue: Queue) -> None:
    submit(queue)
    for _ in range(4):
        do(queue, take(queue), tasks=2)
        assert queue.complete(take(queue), "A", Stale(stale="cloud.vdb changes"))
    assert queue.failed("job") == {0: "render failed: cloud.vdb changes"}


FRAMES = {"one": 3, "two": 2, "three": 1}
STEPS = {
    **dict.fromkeys(("claim", "finish"), 5),
    "fail": 3,
    **dict.fromkeys(("hand back", "wait", "stale", "redo", "replan", "renew"), 1),
    **dict.fromkeys(("lapse", "wake", "drain", "undrain", "leave"), 1),
    **dict.fromkeys(("pause", "resume", "cancel", "retry", "priority", "remove"), 1),
}


@settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([step for step, weight in STEPS.items() for _ in range(weight)]),
            st.sampled_from("ABC"),
            st.sampled_from(list(FRAMES)),
            st.integers(0, 9),
        ),
        min_size=50,  # else most are of a handful
        max_size=150,
    )
)
def test_whatever_happens_every_frame_ends_and_nothing_is_left(
    redis: Redis, steps: list[tuple[str, str, str, int]]
) -> None:
    """Workers claim, finish, hand back, fail, freeze, leave and are taken for dead, while their
    jobs are steered, in any order."""
    redis.flushall()
    queue = Queue(redis, lease=LEASE)
    for job, frames in FRAMES.items():
        submit(queue, job, frames)
    held: dict[str, list[Task]] = {name: [] for name in "ABC"}
    for step, name, job, number in steps:
        if step == "claim":
            if task := queue.claim(worker(name)):
                held[name].append(task)
        elif step in ("lapse", "wake"):
            lapse(queue) if step == "lapse" else wake(queue)
        elif step in ("drain", "undrain", "leave"):
            getattr(queue, step)(name)
        elif step in ("pause", "resume", "cancel", "retry", "priority", "remove"):
            if queue.control(job, cast(Verb, step), number) == "removed" and number:
                submit(queue, job, FRAMES[job])
        elif held[name]:
            task = held[name].pop(number % len(held[name]))
            end_attempt(queue, step, task, worker(name), number)
    jobs = [job for job in FRAMES if queue.control(job, "resume")]
    for name in "ABC":
        queue.undrain(name)
    rounds = 0
    while any(queue.state(job) == "running" for job in jobs):
        if task := queue.claim(D):
            do(queue, task, D)
        else:
            rounds += 1
            assert rounds < 200, "the farm came to a stand"
            wake(queue)
            lapse(queue)
    for name, tasks in held.items():
        for task in tasks:
            do(queue, task, worker(name))
    lapse(queue)
    assert queue.claim(D) is None
    assert all(depth == (0, 0) for depth in queue.depths().values())
    for left in ("frame:*", "held", "ready", "active", "waiting", "flight"):
        assert not list(redis.scan_iter(f"pileus:job:*:{left}"))
    assert not list(redis.scan_iter("pileus:tasks:*:tries:*"))
    assert not list(redis.scan_iter("pileus:ring:*"))
    assert not redis.exists("pileus:due")
    for job in jobs:
        seen = queue.job(job)
        assert seen is not None
        done, failed = queue.done(job), queue.failed_frames(job)
        assert (seen.frames_done, seen.frames_failed) == (len(done), len(failed))
        assert not done & failed
        assert seen.state == "cancelled" or len(done | failed) == seen.frames


def wake(queue: Queue) -> None:
    """The time comes of every frame that waits for its cache."""
    for member in cast(list[str], queue.redis.zrange("pileus:due", 0, -1)):
        queue.redis.zadd("pileus:due", {member: 0})
    queue.redis.delete("pileus:clock")


def end_attempt(queue: Queue, how: str, task: Task, info: WorkerInfo, number: int) -> None:
    """What may come of an attempt; what can come of no task of its kind is done instead."""
    planning, merging = task.kind is Kind.PLAN, task.kind is Kind.MERGE
    if how == "hand back":
        queue.hand_back(task, info.name)
    elif how == "fail":
        queue.fail(task, info.name, "crash")
    elif how == "renew":
        queue.renew(task, info.model_copy(update={"task": task, "samples": number}))
    elif how == "stale":
        queue.complete(task, info.name, Stale(stale="changed"))
    elif how == "wait" and planning:
        queue.complete(task, info.name, Waiting(wait="not there yet"))
    elif how == "replan" and not planning:
        queue.complete(task, info.name, Replan())
    elif how == "redo" and merging:
        tasks = int(queue.redis.hget(f"pileus:job:{task.job}:frame:{task.frame}", "tasks") or 0)
        redo = list(range(number % (tasks + 1)))
        queue.complete(task, info.name, Merged(redo=redo, reason="damaged"))
    else:
        do(queue, task, info, tasks=number % 4)


@pytest.mark.parametrize("how", ["done", "failed", "handed back", "renewed"])
def test_a_task_that_was_taken_out_of_its_stream_is_nobodys(queue: Queue, how: str) -> None:
    """By a keeper who tidies up: its worker must not insist for ever on what cannot be."""
    submit(queue, frames=2)
    task = take(queue)
    queue.redis.xdel("pileus:tasks:5", task.entry)
    if how == "done":
        assert not do(queue, task)
    elif how == "failed":
        assert queue.fail(task, "A", "bad") == "lost"
    elif how == "renewed":
        assert queue.renew(task, A) == "lost"
    else:
        queue.hand_back(task, "A")
    assert take(queue).frame == 1
