"""An upgrade with old and new workers side by side: each takes what it understands, and no frame
mixes the bits of two versions."""

import shutil
import signal
import time
from pathlib import Path
from typing import Any

import pileus_core as core
import pytest
from redis import Redis

import pileus_service
import pileus_worker
from hosts import PILEUS, process, same_images, service, until
from pileus_service.jobs import (
    FORMAT,
    Kind,
    Merged,
    Planned,
    Rendered,
    Replan,
    Result,
    Wish,
    WorkerInfo,
)
from pileus_service.queue import Queue
from pileus_service.shot import Shot

LEASE = 0.5


def worker(name: str, version: str) -> WorkerInfo:
    return WorkerInfo(name=name, host="host", pid=1, threads=1, started=0.0, version=version)


OLD, OTHER_OLD, NEW = worker("old", "1"), worker("other old", "1"), worker("new", "2")


def plan(version: str) -> Planned:
    return Planned(tasks=3, finished=[], total=30, samples=0, version=version)


def planned_by_old(redis: Redis, result: Planned) -> Queue:
    """A queue with one job, whose frame the old worker has planned."""
    queue = Queue(redis, LEASE)
    queue.submit("job", "job", time.time(), 1, Wish())
    task = queue.claim(OLD)
    assert task
    assert queue.complete(task, OLD.name, result)
    return queue


def test_a_worker_leaves_jobs_of_a_newer_format_to_newer_workers(redis: Redis) -> None:
    old, new = Queue(redis, LEASE), Queue(redis, LEASE, FORMAT + 1)
    new.submit("newer", "newer", time.time(), 1, Wish(priority=9))
    old.submit("older", "older", time.time(), 1, Wish())
    task = old.claim(OLD)
    assert task and task.job == "older"
    assert old.claim(OTHER_OLD) is None
    taken = new.claim(NEW)
    assert taken and (taken.job, taken.attempt) == ("newer", 1)
    assert new.complete(taken, NEW.name, plan("2"))
    assert old.claim(OTHER_OLD) is None
    old.hand_back(task, OLD.name)
    jobs: list[str] = []
    while found := new.claim(worker(f"new {len(jobs)}", "2")):
        jobs.append(found.job)
    assert set(jobs) == {"newer", "older"}


def test_a_frame_stays_with_the_version_that_planned_it(redis: Redis) -> None:
    queue = planned_by_old(redis, plan("1"))
    assert queue.claim(NEW) is None
    parts = []
    while task := queue.claim(OTHER_OLD):
        parts.append(task.part)
        result = Rendered(samples=10, taken=10) if task.kind is Kind.RENDER else Merged()
        queue.complete(task, OTHER_OLD.name, result)
    assert parts[:3] == [0, 1, 2]
    seen = queue.job("job")
    assert seen and seen.state == "done"


def test_what_waits_for_one_version_is_bounded_and_keeps_no_other_from_work(redis: Redis) -> None:
    queue = Queue(redis, LEASE)
    queue.submit("job", "job", time.time(), 3, Wish())
    task = queue.claim(NEW)
    assert task and queue.complete(task, NEW.name, plan("2").model_copy(update={"tasks": 5000}))
    others = [worker(f"old {number}", "1") for number in range(6)]
    held = [(info, queue.claim(info)) for info in others]
    for _ in range(50):
        assert queue.claim(others[-1]) is None
    assert redis.xlen("pileus:tasks:5") < 50
    # The two frames that are left are theirs to plan, and what they have planned is theirs.
    [(first, one), (second, two)] = [(info, task) for info, task in held if task]
    assert {one.frame, two.frame} == {1, 2}
    assert queue.complete(one, first.name, plan("1"))
    assert queue.complete(two, second.name, plan("1"))
    mine = queue.claim(first)
    assert mine and mine.kind is Kind.RENDER and mine.frame in (1, 2)
    task = queue.claim(NEW)
    assert task and (task.frame, task.part) == (0, 0)


def test_of_many_tasks_for_others_a_worker_looks_at_some_and_comes_to_all(redis: Redis) -> None:
    queue = planned_by_old(redis, plan("1").model_copy(update={"tasks": 5000}))
    crowd = [worker(f"new {number}", "2") for number in range(150)]
    for info in crowd:
        assert queue.claim(info, able=False) is None
    for info in crowd[:3]:
        assert queue.claim(info) is None
    queue.submit("other", "other", time.time(), 1, Wish())
    task = queue.claim(crowd[0])
    assert task and task.job == "other"
    queue.hand_back(task, crowd[0].name)  # it lies behind all of the others
    assert redis.xpending("pileus:tasks:5", "workers")["pending"] > 300
    for _ in range(4):
        redis.config_resetstat()
        found = queue.claim(NEW)
        assert redis.info("commandstats")["cmdstat_xrange"]["calls"] < 150
        if found:
            break
    assert found and found.entry == task.entry


def test_a_failed_attempt_is_not_left_waiting_for_workers_of_another_version(redis: Redis) -> None:
    queue = planned_by_old(redis, Planned(tasks=1, finished=[], total=1, samples=0, version="1"))
    for attempt in (1, 2, 3):
        queue.claim(NEW)
        task = queue.claim(OLD)
        assert task and task.attempt == attempt
        queue.fail(task, OLD.name, "no good")
    seen = queue.job("job")
    assert seen and seen.state == "failed"


def test_a_failed_attempt_is_not_left_waiting_for_workers_that_cannot_read_it(
    redis: Redis,
) -> None:
    old, new = Queue(redis, LEASE), Queue(redis, LEASE, FORMAT + 1)
    new.submit("newer", "newer", time.time(), 1, Wish())
    for attempt in (1, 2, 3):
        assert old.claim(OLD) is None
        task = new.claim(NEW)
        assert task and task.attempt == attempt
        new.fail(task, NEW.name, "no good")
    seen = new.job("newer")
    assert seen and seen.state == "failed"


def test_a_frame_whose_version_is_gone_is_planned_anew(redis: Redis) -> None:
    queue = planned_by_old(redis, plan("1"))
    task = queue.claim(OLD)
    assert task
    queue.complete(task, OLD.name, Rendered(samples=10, taken=10))
    left = queue.claim(OLD)
    assert left and left.kind is Kind.RENDER
    queue.leave(OLD.name)
    task = queue.claim(NEW)
    assert task and task.kind is Kind.RENDER
    queue.complete(task, NEW.name, Replan())
    assert not queue.complete(left, "nobody", Rendered(samples=10, taken=10))
    time.sleep(LEASE * 1.2)
    # The lease of the one that left runs out amid the new plan; nothing is lost or counted twice.
    done: list[tuple[str, int]] = []
    while task := queue.claim(NEW):
        done.append((task.kind, task.part))
        results: dict[Kind, Result] = {
            Kind.PLAN: Planned(tasks=1, finished=[], total=10, samples=0, version="2"),
            Kind.RENDER: Rendered(samples=10, taken=10),
            Kind.MERGE: Merged(),
        }
        queue.complete(task, NEW.name, results[task.kind])
    assert done == [("plan", 0), ("render", 0), ("merge", 0)]
    seen = queue.job("job")
    assert seen and (seen.state, seen.frames_done) == ("done", 1)


@pytest.fixture
def former(tmp_path: Path) -> Path:
    """This program as it was: the same code under an older version number."""
    folder = tmp_path / "former"
    for package in (pileus_service, pileus_worker, core):
        source = Path(package.__file__ or "").parent
        shutil.copytree(source, folder / source.name)
        with (folder / source.name / "__init__.py").open("a") as file:
            file.write('\n__version__ = "0.0.1"\n')
    return folder


@pytest.mark.slow
def test_an_upgrade_mixes_no_versions_in_a_frame(
    tmp_path: Path, redis_url: str, redis: Redis, shot: dict[str, Any], former: Path
) -> None:
    cache, data = tmp_path / "cloud.vdb", tmp_path / "data"
    core.make_cloud(str(cache), frame=1, frames=1, resolution=32)
    shot |= {"frames": "1-6", "sampling": {"samples": 400}}
    shot["volumes"][0]["cache"] = str(cache)
    asked = Shot.model_validate(shot)
    command: list[str | Path] = [PILEUS.with_name("python"), "-m", "pileus_worker"]
    command += ["--data", data]
    command += ["--redis", redis_url, "--root", tmp_path, "--threads", "1", "--task-seconds", ".05"]
    seen: dict[int, set[str]] = {}
    with (
        service(data, redis_url, tmp_path) as client,
        process(tmp_path / "old.log", *command, env={"PYTHONPATH": str(former)}) as old,
        process(tmp_path / "new.log", *command),
    ):
        until(lambda: len({each.version for each in client.workers()}) == 2, 180)
        job = client.submit(asked).job.id

        def both_at_work() -> bool:
            for each in client.workers():
                if each.task and each.task.kind in (Kind.RENDER, Kind.MERGE):
                    seen.setdefault(each.task.frame, set()).add(each.version)
            return len(set[str]().union(*seen.values())) == 2

        until(both_at_work, 180)
        for _ in range(10):
            both_at_work()
            time.sleep(0.05)
        assert all(len(versions) == 1 for versions in seen.values())
        # The frame that the old one is amid is planned anew by the new one.
        old.send_signal(signal.SIGKILL)
        until(lambda: client.job(job).state in ("done", "failed"), 300)
        assert client.job(job).state == "done", client.job(job).reason
    same_images(asked, tmp_path)
