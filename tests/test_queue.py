"""The queue's promises, each against a real Redis: leases, attempts, order, pause, cancel, once."""

import time
from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from redis import Redis

from pileus_service.jobs import (
    JobView,
    Kind,
    Merged,
    Planned,
    Rendered,
    Stale,
    Task,
    Waiting,
    Wish,
    WorkerInfo,
)
from pileus_service.queue import Queue

LEASE = 2.0


def worker(name: str) -> WorkerInfo:
    return WorkerInfo(name=name, host="host", pid=1, threads=1, started=1764095323.25)


A, B, C, D = (worker(name) for name in "ABCD")


@pytest.fixture
def queue(redis: Redis) -> Queue:
    return Queue(redis, lease=LEASE)


def submit(queue: Queue, job: str = "job", frames: int = 1, priority: int = 5) -> None:
    assert queue.submit(job, job, time.time(), frames, Wish(priority=priority))


def planned(tasks: int, finished: list[int] | None = None) -> Planned:
    return Planned(tasks=tasks, finished=finished or [], total=tasks * 10, samples=0)


def take(queue: Queue, info: WorkerInfo = A) -> Task:
    task = queue.claim(info)
    assert task is not None
    return task


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


def test_a_job_goes_from_plan_to_done(queue: Queue) -> None:
    submit(queue, frames=2)
    assert view(queue) == ("queued", 0, 0)
    kinds = []
    while task := queue.claim(A):
        kinds.append(task.kind)
        assert do(queue, task)
    assert kinds.count(Kind.PLAN) == 2
    assert kinds.count(Kind.RENDER) == 6
    assert kinds.count(Kind.MERGE) == 2
    assert view(queue) == ("done", 2, 0)


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
        queue.hand_back(task, "A")  # as a worker does that had to drop it
        task = take(queue)
        assert task.attempt == 1
    end = time.monotonic() + 10
    while (again := queue.claim(B)) is None:
        assert time.monotonic() < end
        time.sleep(0.02)
    assert again.attempt == 2, "B was there, and A was not"


def test_renewal_keeps_the_lease_and_the_attempt_count(queue: Queue) -> None:
    submit(queue)
    task = take(queue, A)
    for _ in range(3):
        time.sleep(LEASE / 2)
        assert queue.renew(task, A) == "held"
        assert queue.claim(B) is None
    lapse(queue)
    assert take(queue, B).attempt == 2


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


def test_higher_priority_goes_first_and_a_change_moves_waiting_tasks_once(queue: Queue) -> None:
    submit(queue, "low", frames=4, priority=2)
    submit(queue, "high", frames=1, priority=8)
    assert take(queue).job == "high"
    submit(queue, "middle", frames=1, priority=5)
    for priority in (9, 2, 9):
        queue.control("low", "priority", priority)
    order = [(task.job, task.frame) for task in iter(lambda: queue.claim(A), None)]
    assert order == [("low", 0), ("low", 1), ("middle", 0)]


def test_pause_holds_every_task_and_resume_lets_them_go_once(queue: Queue) -> None:
    submit(queue, frames=3)
    do(queue, take(queue), tasks=3)
    queue.control("job", "pause")
    assert queue.claim(A) is None
    assert view(queue)[0] == "paused"
    queue.control("job", "resume")
    assert (
        len([task for task in iter(lambda: queue.claim(A), None) if task.kind is Kind.RENDER]) == 3
    )


def test_the_time_left_counts_no_time_that_a_job_was_paused(queue: Queue) -> None:
    submit(queue)
    for _ in range(2):
        do(queue, take(queue), tasks=3)
    queue.control("job", "pause")
    for moment in ("started", "paused"):  # as if it had rested for an hour
        queue.redis.hincrby("pileus:job:job", moment, -3_600_000)
    queue.control("job", "resume")
    seen = queue.job("job")
    assert seen and seen.seconds_left is not None
    assert seen.seconds_left < 600


def test_the_time_left_of_a_retried_job_counts_no_time_since_it_failed(queue: Queue) -> None:
    submit(queue, frames=2)
    while not queue.failed("job"):
        queue.fail(take(queue), "A", "no disk")
    while task := queue.claim(A):
        do(queue, task)
    assert view(queue)[0] == "failed"
    for moment in ("started", "finished"):  # as if it had been looked at an hour later
        queue.redis.hincrby("pileus:job:job", moment, -3_600_000)
    queue.control("job", "retry", 1)
    do(queue, take(queue))
    seen = queue.job("job")
    assert seen and seen.seconds_left is not None
    assert seen.seconds_left < 600


def test_cancel_drops_waiting_tasks_and_is_seen_by_running_ones(queue: Queue) -> None:
    submit(queue, frames=3)
    running = take(queue)
    queue.control("job", "cancel")
    assert queue.state("job") == "cancelled"
    assert queue.claim(B) is None
    assert do(queue, running)
    assert view(queue) == ("cancelled", 0, 0)
    assert queue.depths() == {5: (0, 0)}


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


def test_parts_found_on_disk_are_not_issued(queue: Queue) -> None:
    submit(queue)
    queue.complete(take(queue), "A", planned(4, finished=[0, 2, 3]))
    task = take(queue)
    assert (task.kind, task.part) == (Kind.RENDER, 1)
    do(queue, task)
    assert take(queue).kind is Kind.MERGE


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


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(st.tuples(st.sampled_from("ABC"), st.integers(0, 9)), max_size=60))
def test_whatever_happens_every_frame_ends_and_nothing_is_left(
    redis: Redis, steps: list[tuple[str, int]]
) -> None:
    """Workers claim, finish, hand back, freeze and are taken for dead in any order."""
    redis.flushall()
    queue = Queue(redis, lease=0.1)
    submit(queue, "one", frames=3)
    submit(queue, "two", frames=2, priority=7)
    held: dict[str, list[Task]] = {"A": [], "B": [], "C": []}
    actions: dict[int, Callable[[Task, WorkerInfo], object]] = {
        0: lambda task, info: queue.hand_back(task, info.name),
        1: lambda task, info: queue.fail(task, info.name, "crash"),
        2: lambda task, info: time.sleep(0.15),
    }

    def finish(task: Task, info: WorkerInfo) -> object:
        return do(queue, task, info)

    for name, action in steps:
        info = worker(name)
        if action == 9:
            queue.control("one", "pause")
            queue.control("one", "resume")
        elif action == 8:
            queue.control("one", "priority", len(held[name]) % 10)
        elif held[name] and action < 7:
            act = actions.get(action, finish)
            act(held[name].pop(), info)
        elif task := queue.claim(info):
            held[name].append(task)
    deadline = time.monotonic() + 30
    while any(view(queue, job)[0] not in ("done", "failed") for job in ("one", "two")):
        assert time.monotonic() < deadline, "the farm came to a stand"
        if task := queue.claim(D):
            do(queue, task, D)
        else:
            time.sleep(0.005)
    time.sleep(0.15)
    assert queue.claim(D) is None
    assert all(depth == (0, 0) for depth in queue.depths().values())
    for job in ("one", "two"):
        seen = queue.job(job)
        assert seen is not None
        assert seen.frames_done + seen.frames_failed == seen.frames


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
    assert "late" in [take(queue).job for _ in range(8 + 5 + 1)]


def test_what_waits_in_redis_does_not_grow_with_the_jobs(queue: Queue) -> None:
    for number in range(50):
        submit(queue, f"job{number}", frames=1000)
    assert queue.depths()[5] == (8, 0)


def test_a_worker_whose_tasks_go_well_elsewhere_is_set_aside(queue: Queue) -> None:
    submit(queue, frames=8)
    queue.redis.zadd("pileus:aside", {"A": 1})  # not for the first time: that one is long over
    for name in "ABC":
        queue.hand_back(take(queue, worker(name)), name)
    for _ in range(3):
        failed = take(queue, A)
        assert queue.fail(failed, "A", "no such folder") == "released"
        again = take(queue, B)
        assert again.entry == failed.entry
        do(queue, again, B, tasks=0)
    assert queue.claim(A) is None
    [told] = [view.aside for view in queue.workers() if view.name == "A"]
    assert told is not None
    assert "no such folder" in told
    task = take(queue, B)
    queue.fail(task, "B", "bad")
    assert take(queue, C).entry == task.entry
    queue.fail(task, "C", "bad")
    assert take(queue, B).entry == task.entry, "nobody waits for the one set aside"
    queue.undrain("A")
    assert take(queue, A)


def test_a_bad_job_sets_no_worker_aside(queue: Queue) -> None:
    submit(queue, frames=20)
    names = "ABC"
    while view(queue)[0] in ("queued", "running"):
        for name in names:
            if task := queue.claim(worker(name)):
                queue.fail(task, name, "bad cache")
    assert view(queue) == ("failed", 0, 20)
    assert all(seen.aside is None for seen in queue.workers())


def test_a_worker_that_is_not_able_gets_nothing_and_with_trouble_is_not_waited_for(
    queue: Queue,
) -> None:
    submit(queue)
    assert queue.claim(B, able=False) is None
    assert [view.aside for view in queue.workers()] == [None], "it only starts"
    task = take(queue, A)
    assert queue.claim(B, able=False, trouble="no memory") is None
    assert [view.aside for view in queue.workers()] == [None, "no memory"]
    queue.fail(task, "A", "bad")
    assert take(queue, A).entry == task.entry


def test_a_worker_is_shown_at_its_task_from_claim_to_claim(queue: Queue) -> None:
    submit(queue)
    task = take(queue)
    [shown] = queue.workers()
    assert (shown.task, shown.started) == (task, A.started)
    do(queue, task)
    queue.drain(A.name)
    assert queue.claim(A) is None
    [shown] = queue.workers()
    assert shown.task is None


def test_a_drained_worker_gets_nothing_until_it_is_told_otherwise(queue: Queue) -> None:
    submit(queue)
    take(queue, A)
    queue.drain("A")
    queue.drain("B")
    lapse(queue)
    assert queue.claim(A) is None
    assert queue.claim(B) is None
    queue.undrain("B")
    assert take(queue, B).attempt == 2


def test_a_retry_takes_the_failed_frames_only(queue: Queue) -> None:
    submit(queue, frames=3)
    while task := queue.claim(A):
        if task.frame == 1:
            queue.fail(task, "A", "no disk")
        else:
            do(queue, task)
    assert view(queue) == ("failed", 2, 1)
    assert queue.control("job", "retry", 1) == "running"
    frames = set()
    while task := queue.claim(A):
        frames.add(task.frame)
        do(queue, task)
    assert frames == {1}
    assert view(queue) == ("done", 3, 0)
    assert queue.standings(["job"]) == [("done", 5, 1)]


def test_what_changed_is_told_and_a_loss_is_noticed(queue: Queue, redis: Redis) -> None:
    mark, jobs = queue.changed(None)
    assert jobs is None, "at first nothing is known"
    for name in ("one", "two", "three"):
        submit(queue, name)
    mark, jobs = queue.changed(mark)
    assert jobs == ["one", "two", "three"]
    queue.control("two", "pause")
    queue.control("two", "resume")
    mark, jobs = queue.changed(mark)
    assert jobs == ["two"]
    mark, jobs = queue.changed(mark)
    assert jobs == []
    queue.control("two", "remove")
    assert redis.zrange("pileus:changed", 0, -1) == ["one", "three"], "as long as the jobs"
    mark, jobs = queue.changed(mark)
    assert jobs is None, "one has gone"
    redis.incr("pileus:changes")  # as a worker of a version that keeps no list
    mark, jobs = queue.changed(mark)
    assert jobs is None
    redis.flushall()
    submit(queue, "four")
    mark, jobs = queue.changed(mark)
    assert jobs is None, "the count went back"
    assert queue.changed(mark._replace(process="another"))[1] is None


def test_a_retry_while_the_job_runs_begins_no_frame_twice(queue: Queue) -> None:
    submit(queue, frames=6)
    running = take(queue)
    while not queue.failed("job"):
        queue.fail(take(queue), "A", "bad")
    queue.control("job", "retry", 1)
    do(queue, running)
    while task := queue.claim(A):
        do(queue, task)
    assert view(queue) == ("done", 6, 0)


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


def test_a_stale_plan_is_made_anew_a_bounded_number_of_times(queue: Queue) -> None:
    submit(queue)
    for _ in range(4):
        do(queue, take(queue), tasks=2)
        assert queue.complete(take(queue), "A", Stale(stale="cloud.vdb changes"))
    assert queue.failed("job") == {0: "render failed: cloud.vdb changes"}


def test_a_job_tells_the_first_of_its_failed_frames(queue: Queue) -> None:
    submit(queue, frames=12)
    while task := queue.claim(A):
        if task.frame in (9, 10):
            queue.fail(task, "A", f"no cache {task.frame}")
        else:
            do(queue, task)
    seen = queue.job("job")
    assert seen and (seen.frames_done, seen.frames_failed) == (10, 2)
    assert seen.reason == "9: plan failed: A: no cache 9"


def test_many_jobs_are_told_as_each_alone_is(queue: Queue) -> None:
    names = [f"job{number}" for number in range(250)]
    for number, job in enumerate(names):
        submit(queue, job, frames=1 + number % 3, priority=number % 10)
    for _ in range(150):
        do(queue, take(queue))
    running = take(queue)
    queue.renew(running, A.model_copy(update={"samples": 7}))

    def still(view: JobView | None) -> JobView | None:
        return view and view.model_copy(update={"seconds_left": None})

    together = queue.views([*names, "nobody"])
    assert together.pop() is None
    assert [*map(still, together)] == [still(queue.job(job)) for job in names]
    assert len({view.state for view in together if view}) == 3
    [frame] = next(view for view in together if view and view.id == running.job).active
    assert frame.progress > 0


def test_how_long_the_next_task_has_waited(queue: Queue) -> None:
    submit(queue, frames=2)
    time.sleep(0.2)
    submit(queue, "later", priority=7)
    lines = queue.lines()
    assert lines[5].wait >= lines[7].wait + 0.199
    first = take(queue)
    assert (first.job, queue.lines()[7]) == ("later", (0, 1, 0.0))


def test_unwanted_work_is_known_at_renewal(queue: Queue) -> None:
    submit(queue)
    task = take(queue)
    queue.control("job", "cancel")
    assert queue.renew(task, A) == "unwanted"
