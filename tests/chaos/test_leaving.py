"""Workers that leave: told to, and cut off."""

import ipaddress
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from redis import Redis

from chaos.farm import Farm, frozen, until
from pileus_service.jobs import WorkerView
from pileus_service.queue import Queue
from pileus_service.shot import Shot
from pileus_worker.commands.worker import GRACE
from serial_render import same_bits


def with_samples(shot: Shot, samples: int) -> Shot:
    sampling = shot.sampling.model_copy(update={"samples": samples})
    return shot.model_copy(update={"frames": "1", "sampling": sampling})


def at_work(farm: Farm) -> list[WorkerView]:
    return [
        worker
        for worker in farm.queue.workers()
        if worker.alive and worker.task and worker.task.kind == "render"
    ]


def test_sigterm_lets_a_task_finish_within_the_grace(cached_shot: Shot, tmp_path: Path) -> None:
    with Farm(tmp_path, [tmp_path], 1, task_seconds=2, options=("--grace=60",)) as farm:
        job = farm.client.submit(with_samples(cached_shot, 1000)).job.id
        until(lambda: bool(at_work(farm)))
        [leaver] = at_work(farm)
        process = farm.workers[0].process
        process.terminate()
        assert process.wait(60) == 0
        assert farm.queue.stats()["tasks_done"] >= 2, "its plan, and what it had in hand"
        assert farm.queue.stats().get("attempts_failed", 0) == 0
        assert leaver.name not in farm.queue.worker_names()
        *_, view = farm.client.watch(job)
        assert view.state == "done"
        assert farm.queue.stats().get("leases_lost", 0) == 0


def test_sigterm_hands_back_what_takes_longer(cached_shot: Shot, tmp_path: Path) -> None:
    with Farm(tmp_path, [tmp_path], 1, task_seconds=600, options=("--grace=1",)) as farm:
        farm.client.submit(with_samples(cached_shot, 100_000))
        until(lambda: bool(at_work(farm)))
        process = farm.workers[0].process
        begun = time.monotonic()
        process.terminate()
        assert process.wait(20) == 0
        print(f"gone after {time.monotonic() - begun:.1f} s")
        until(lambda: bool(at_work(farm)))
        [worker] = at_work(farm)
        assert worker.task is not None
        assert worker.task.attempt == 1, "a task handed back has not failed"
        assert farm.queue.stats().get("leases_lost", 0) == 0


@pytest.mark.parametrize("has_task", [False, True])
def test_sigterm_is_obeyed_while_redis_does_not_answer(
    cached_shot: Shot, tmp_path: Path, has_task: bool
) -> None:
    with Farm(tmp_path, [tmp_path], 1, task_seconds=600, options=("--grace=1",)) as farm:
        if has_task:
            farm.client.submit(with_samples(cached_shot, 100_000))
            until(lambda: bool(at_work(farm)))
        else:
            farm.until_workers(1)
        process = farm.workers[0].process
        with frozen(farm.redis.pid):
            time.sleep(1)  # by now it waits for an answer
            process.terminate()
            assert process.wait(GRACE) == 0


@pytest.mark.parametrize("verb", ["pause", "cancel"])
def test_a_job_that_is_not_to_run_stops_in_the_renderer(
    cached_shot: Shot, tmp_path: Path, verb: str
) -> None:
    """Its task would take minutes."""
    with Farm(tmp_path, [tmp_path], 1, task_seconds=600) as farm:
        job = farm.client.submit(with_samples(cached_shot, 100_000)).job.id
        until(lambda: bool(at_work(farm)))
        begun = time.monotonic()
        farm.client.control(job, verb)
        until(lambda: not at_work(farm))
        print(f"stopped after {time.monotonic() - begun:.2f} s")
        until(lambda: not any(any(depth) for depth in farm.queue.depths().values()))
        if verb == "pause":
            farm.client.control(job, "resume")
            until(lambda: bool(at_work(farm)))
            [worker] = at_work(farm)
            assert worker.task is not None
            assert worker.task.attempt == 1, "a task that was paused has not failed"
        assert farm.queue.stats().get("attempts_failed", 0) == 0


def test_a_drained_worker_finishes_and_rests(cached_shot: Shot, tmp_path: Path) -> None:
    with Farm(tmp_path, [tmp_path], 2, task_seconds=0.5) as farm:
        farm.until_workers(2)
        name = farm.queue.workers()[0].name
        farm.client.drain(name)
        job = farm.client.submit(with_samples(cached_shot, 100)).job.id
        *_, view = farm.client.watch(job)
        assert view.state == "done"
        told = [json.loads(line) for line in (tmp_path / "workers.log").read_text().splitlines()]
        at_work = {line["worker"] for line in told if line["event"] == "begun"}
        assert at_work
        assert name not in at_work
        [drained] = [worker for worker in farm.queue.workers() if worker.name == name]
        assert drained.aside == "drained"
        farm.client.drain(name, undo=True)
        [again] = [worker for worker in farm.queue.workers() if worker.name == name]
        assert again.aside is None


@pytest.fixture
def cable() -> Iterator[tuple[str, str, str]]:
    """A network namespace for a worker, with a cable to us: its name, our end, our address."""
    pid = os.getpid()
    space, here, there = f"pileus{pid}", f"ph{pid}", f"pt{pid}"
    # A net of four addresses, not that of another run, which may be one that was killed.
    net = ipaddress.ip_network((0x0AE70000 | (pid & 0x3FFF) << 2, 30))
    ours, theirs = net.hosts()

    def ip(*words: str) -> None:
        subprocess.run(["ip", *words], check=True, capture_output=True)

    try:
        ip("netns", "add", space)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no right to make a network namespace, or no ip command")
    try:
        ip("link", "add", here, "type", "veth", "peer", "name", there, "netns", space)
        ip("addr", "add", f"{ours}/30", "dev", here)
        ip("link", "set", here, "up")
        ip("-n", space, "addr", "add", f"{theirs}/30", "dev", there)
        ip("-n", space, "link", "set", there, "up")
        yield space, here, str(ours)
    finally:
        ip("netns", "delete", space)


@pytest.mark.slow
def test_a_worker_cut_off_for_a_minute_drops_its_work_and_comes_back(
    cached_shot: Shot, tmp_path: Path, cable: tuple[str, str, str]
) -> None:
    space, link, address = cable
    shot = with_samples(cached_shot, 5_000)
    with Farm(tmp_path, [tmp_path], 1, task_seconds=8) as farm:
        with farm.queue.redis as local:
            local.config_set("protected-mode", "no")
            local.config_set("bind", address)
            local.config_set("port", "16379")
        far = [
            *("ip", "netns", "exec", space, sys.executable, "-m", "pileus_worker"),
            *("--data", str(farm.data), "--redis", f"redis://{address}:16379/0"),
            *(f"--root={tmp_path}", "--threads=1", "--task-seconds=8"),
        ]
        with (tmp_path / "far.log").open("wb") as log:
            process = subprocess.Popen(far, stdout=log, stderr=log)
        try:
            farm.until_workers(2)
            job = farm.client.submit(shot).job.id
            until(lambda: len(at_work(farm)) == 2)
            [cut] = [worker for worker in at_work(farm) if worker.pid == process.pid]
            subprocess.run(["ip", "link", "set", link, "down"], check=True)
            begun = time.monotonic()
            until(lambda: taken_over(farm.queue, cut))
            print(f"its task was another's after {time.monotonic() - begun:.1f} s")
            time.sleep(60 - (time.monotonic() - begun))
            assert "dropped" in (tmp_path / "far.log").read_text()
            subprocess.run(["ip", "link", "set", link, "up"], check=True)
            begun = time.monotonic()
            until(lambda: process.pid in [w.pid for w in farm.queue.workers() if w.alive])
            print(f"it was back after {time.monotonic() - begun:.1f} s")
            until(lambda: farm.client.job(job).state == "done", 400)
            assert process.poll() is None
            same_bits(shot, farm.data, job, 1, tmp_path)
            assert farm.leftovers() == []
        finally:
            print((tmp_path / "far.log").read_text())
            process.send_signal(signal.SIGTERM)
            process.wait(20)


def taken_over(queue: Queue, cut: WorkerView) -> bool:
    """Whether another worker holds what the one that was cut off had in hand, or it is done."""
    assert cut.task is not None
    redis: Redis = queue.redis
    stream = f"pileus:tasks:{cut.task.priority}"
    entry = cut.task.entry
    pending = redis.xpending_range(stream, "workers", entry, entry, 1)
    return not pending or pending[0]["consumer"] not in (cut.name, "released")
