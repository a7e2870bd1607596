"""Workers kept off, against a real Redis: set aside, not able, drained; and how they are shown."""

from pileus_service.queue import Queue
from queueing import A, B, C, do, lapse, submit, take, view, worker


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


def test_a_worker_with_another_data_folder_gets_nothing_and_is_told(queue: Queue) -> None:
    submit(queue)
    assert queue.claim(A, "ours"), "no service has said whose this Redis is"
    assert queue.serves("ours")
    assert not queue.serves("other")
    lapse(queue)
    assert queue.claim(B, None, able=False) is None
    assert [view.aside for view in queue.workers() if view.name == "B"] == [None], "it only starts"
    for farm in ("other", None):
        assert queue.claim(B, farm) is None
    [told] = [view.aside for view in queue.workers() if view.name == "B"]
    assert told is not None
    assert "mounted" in told
    assert queue.claim(C, "ours")


def test_a_drained_worker_gets_nothing_until_it_is_told_otherwise(queue: Queue) -> None:
    submit(queue)
    take(queue, A)
    queue.drain("A")
    queue.drain("B")
    lapse(queue)
    assert queue.claim(B) is None
    assert queue.claim(A) is None
    queue.undrain("B")
    assert take(queue, B).attempt == 2


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
