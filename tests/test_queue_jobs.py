"""A job's life in the queue, against a real Redis: steered, retried, and told as it is."""

import time

from redis import Redis

from pileus_service.jobs import JobView, Kind, Waiting, Wish
from pileus_service.queue import Queue
from queueing import A, B, do, submit, take, take_all, view


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


def test_pause_holds_every_task_and_resume_lets_them_go_once(queue: Queue) -> None:
    submit(queue, frames=3)
    do(queue, take(queue), tasks=3)
    queue.control("job", "pause")
    assert queue.claim(A) is None
    assert view(queue)[0] == "paused"
    queue.control("job", "resume")
    assert len([task for task in take_all(queue) if task.kind is Kind.RENDER]) == 3


def test_cancel_drops_waiting_tasks_and_is_seen_by_running_ones(queue: Queue) -> None:
    submit(queue, frames=3)
    running = take(queue)
    queue.control("job", "cancel")
    assert queue.state("job") == "cancelled"
    assert queue.claim(B) is None
    assert do(queue, running)
    assert view(queue) == ("cancelled", 0, 0)
    assert queue.depths() == {5: (0, 0)}


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


def test_a_retry_while_the_job_runs_begins_no_frame_twice(queue: Queue) -> None:
    submit(queue, frames=6)
    running = take(queue, B)
    queue.drain("B")  # nobody waits for it to try what fails
    while not queue.failed("job"):
        queue.fail(take(queue), "A", "bad")
    queue.control("job", "retry", 1)
    do(queue, running, B)
    while task := queue.claim(A):
        do(queue, task)
    assert view(queue) == ("done", 6, 0)


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


def test_no_time_left_is_told_where_all_that_remains_waits_for_its_caches(queue: Queue) -> None:
    submit(queue, frames=3)
    for _ in range(2):
        assert queue.complete(take(queue), "A", Waiting(wait="not there yet"))
    do(queue, take(queue), tasks=3)
    do(queue, take(queue))
    seen = queue.job("job")
    assert seen and seen.seconds_left is not None
    while task := queue.claim(A):
        do(queue, task)
    seen = queue.job("job")
    assert seen and (seen.frames_done, seen.seconds_left) == (1, None)


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
    queue.redis.flushall()
    failed = {10: "plan failed: B", 4: "plan failed: A"}
    queue.submit("job", "job", time.time(), 12, Wish(state="failed", failed=failed), range(4))
    seen = queue.job("job")
    assert seen and seen.reason == "4: plan failed: A"
    queue.control("job", "retry", 1)
    seen = queue.job("job")
    assert seen and (seen.frames_failed, seen.reason) == (0, None)
    while not queue.failed("job"):
        queue.fail(take(queue), "A", "anew")
    assert queue.failed("job", [3, 4, 5]) == {4: "plan failed: A: anew"}
    seen = queue.job("job")
    assert seen and seen.reason == "4: plan failed: A: anew"


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
