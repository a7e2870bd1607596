"""Leases rest on Redis's clock alone; and that clock may jump."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from redis import Redis

from pileus_service import doctor
from pileus_service.jobs import Kind, Planned, Wish, WorkerInfo
from pileus_service.queue import Queue, connect
from pileus_worker.private_redis import PrivateRedis

LEASE = 1.0
A, B = (WorkerInfo(name=name, host="host", pid=1, threads=1, started=0.0) for name in "AB")


class Clock:
    """The wall clock of Redis, in seconds beside the true one."""

    def __init__(self, file: Path, redis: Redis) -> None:
        self._file = file
        self.redis = redis
        self.jump(0)

    def jump(self, offset: float) -> None:
        self._file.write_text(str(offset))
        assert abs(self.redis.time()[0] - time.time() - offset) < 2


@pytest.fixture
def clock(tmp_path: Path, faults: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    monkeypatch.setenv("LD_PRELOAD", str(faults))
    monkeypatch.setenv("CLOCK_OFFSET", str(tmp_path / "offset"))
    with PrivateRedis(tmp_path / "redis") as server:
        monkeypatch.delenv("LD_PRELOAD")
        with connect(server.url) as redis:
            yield Clock(tmp_path / "offset", redis)


@pytest.fixture
def queue(clock: Clock) -> Queue:
    queue = Queue(clock.redis, lease=LEASE)
    queue.submit("job", "job", time.time(), 1, Wish())
    return queue


def test_a_clock_set_back_makes_no_lease_last_longer(queue: Queue, clock: Clock) -> None:
    lost = queue.claim(A)
    assert lost is not None
    assert queue.claim(B) is None
    clock.jump(-3600)
    assert queue.claim(B) is None, "A may live, and has a lease more"
    end = time.monotonic() + 3 * LEASE
    while (again := queue.claim(B)) is None:
        assert time.monotonic() < end
        time.sleep(0.05)
    assert again.entry == lost.entry
    assert queue.complete(again, "B", Planned(tasks=1, finished=[], total=1, samples=0))
    alive = {worker.name for worker in queue.workers() if worker.alive}
    assert alive == {"B"}


def test_a_clock_set_forward_takes_no_task_from_the_living(queue: Queue, clock: Clock) -> None:
    task = queue.claim(A)
    assert task is not None
    clock.jump(3600)
    assert queue.claim(B) is None, "A may live, and has a lease more"
    assert queue.renew(task, A) == "held"
    assert queue.complete(task, "A", Planned(tasks=1, finished=[], total=1, samples=0))
    rendering = queue.claim(A)
    assert rendering is not None
    assert rendering.kind is Kind.RENDER
    assert queue.stats().get("attempts_failed", 0) == 0


@pytest.mark.parametrize(
    ("offset", "found"), [(3600, "behind Redis's"), (-3600, "ahead of Redis's")]
)
def test_the_doctor_finds_clocks_that_differ(clock: Clock, offset: float, found: str) -> None:
    clock.jump(offset)
    [told] = [each for each in doctor.redis_server(clock.redis) if each.what == "clock"]
    assert (told.level, found in told.found, bool(told.mend)) == ("warning", True, True)
