"""The service under load: 10,000 jobs, a farm that works, 500 listeners; cancel and pause.

    PYTHONPATH=tests .venv/bin/python -m farm.service_load

A real service and real workers. `idle_ms` is a request to /healthz in the same run: what this
machine takes to answer at all.
"""

import argparse
import asyncio
import json
import statistics
import tempfile
import time
from collections.abc import MutableSequence
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import httpx
import pileus_core as core

from chaos.farm import Farm, until
from pileus_service.jobs import Job, Wish
from pileus_service.shot import Shot


def make_shot(folder: Path, name: str, samples: int, frames: str = "1-24") -> Shot:
    cache = folder / "cloud.vdb"
    if not cache.exists():
        core.make_cloud(str(cache), frame=1, frames=1, resolution=64)
    return Shot.model_validate(
        {
            "name": name,
            "frames": frames,
            "image": {"width": 320, "height": 180, "output": str(folder / name / "####.exr")},
            "volumes": [{"cache": str(cache), "extinction": 40.0, "anisotropy": 0.8}],
            "camera": {"position": [0.15, 0.12, 1.9], "look_at": [0.0, 0.02, 0.0], "fov": 35.0},
            "lights": [{"type": "dome", "radiance": [0.3, 0.35, 0.4]}],
            "sampling": {"samples": samples},
        }
    )


def fill(farm: Farm, shot: Shot, count: int) -> None:
    """Jobs on disk, a tenth of them still to do: the service takes them up by itself."""
    for number in range(count):
        state = "running" if number % 10 == 0 else "done"
        job = Job(id=f"old-{number:05d}", created=1.0 + number, shot=shot)
        wish = Wish(state=state, priority=0, finished=None if state == "running" else 2.0)
        folder = farm.store.jobs_folder / job.id
        folder.mkdir()
        (folder / "job.json").write_text(job.model_dump_json())
        (folder / "state.json").write_text(wish.model_dump_json())


def ask(farm: Farm, paths: list[str], seconds: float) -> list[float]:
    """Milliseconds that each answer took."""
    took = []
    end = time.monotonic() + seconds
    with httpx.Client(base_url=f"http://{farm.listen}", timeout=30) as http:
        while time.monotonic() < end:
            for path in paths:
                begun = time.perf_counter()
                http.get(path).raise_for_status()
                took.append((time.perf_counter() - begun) * 1000)
                time.sleep(0.005)
    return took


def at(times: list[float]) -> dict[str, float]:
    cuts = statistics.quantiles(times, n=100)
    return {"p50": round(cuts[49], 1), "p99": round(cuts[98], 1), "of": len(times)}


class Listeners:
    """Event streams, read in a process of their own until the end of the block; counts the events
    of each."""

    def __init__(self, farm: Farm, job: str, count: int) -> None:
        context = get_context("spawn")
        self._heard = context.Array("i", count, lock=False)
        self._process = context.Process(target=_listen, args=(farm.listen, job, self._heard))

    @property
    def heard(self) -> list[int]:
        return list(self._heard)

    def __enter__(self) -> "Listeners":
        self._process.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()


def _listen(address: str, job: str, heard: MutableSequence[int]) -> None:
    host, _, port = address.partition(":")
    asked = f"GET /v1/jobs/{job}/events HTTP/1.1\r\nHost: {address}\r\n\r\n".encode()

    async def one(number: int) -> None:
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(asked)
        async for line in reader:
            heard[number] += line.startswith(b"data:")

    async def all_of_them() -> None:
        await asyncio.gather(*map(one, range(len(heard))))

    asyncio.run(all_of_them())


def reach(farm: Farm, verb: str, folder: Path) -> float:
    """Seconds from a request to the moment that no renderer works for the job any more."""
    job = farm.client.submit(make_shot(folder, verb, 1 << 18, "1"), priority=9).job.id

    def renders() -> bool:
        tasks = [worker.task for worker in farm.queue.workers()]
        return any(task.job == job and task.kind == "render" for task in tasks if task)

    until(renders)
    begun = time.monotonic()
    farm.client.control(job, verb)
    until(lambda: not renders())
    took = time.monotonic() - begun
    farm.client.control(job, "cancel")
    return round(took, 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=10_000)
    parser.add_argument("--listeners", type=int, default=500)
    parser.add_argument("--seconds", type=float, default=20)
    asked = parser.parse_args()
    told: dict[str, Any] = {"jobs": asked.jobs}
    with tempfile.TemporaryDirectory(dir="/dev/shm") as name:
        folder = Path(name)
        shot = make_shot(folder, "old", 4)
        with Farm(folder, [folder], 2, task_seconds=1) as farm:
            fill(farm, shot, asked.jobs)
            begun = time.monotonic()
            until(lambda: len(farm.queue.job_ids(asked.jobs)) >= asked.jobs, 300)
            told["taken_up_seconds"] = round(time.monotonic() - begun, 1)
            job = farm.client.submit(make_shot(folder, "now", 64), priority=5).job.id
            until(lambda: any(worker.task for worker in farm.queue.workers()))
            told["idle_ms"] = at(ask(farm, ["/healthz"], asked.seconds / 4))
            told["get_job_ms"] = at(ask(farm, [f"/v1/jobs/{job}"], asked.seconds))
            told["get_old_jobs_ms"] = at(
                ask(farm, [f"/v1/jobs/old-{n * 37 % asked.jobs:05d}" for n in range(97)], 5)
            )
            told["list_jobs_ms"] = at(ask(farm, ["/v1/jobs"], 5))
            with Listeners(farm, job, asked.listeners) as listeners:
                until(lambda: min(listeners.heard) > 0, 60)
                before = listeners.heard
                told["get_job_with_listeners_ms"] = at(ask(farm, [f"/v1/jobs/{job}"], 10))
                events = [now - then for now, then in zip(listeners.heard, before, strict=True)]
                told["events_heard_in_10_s"] = {"least": min(events), "most": max(events)}
            farm.client.control(job, "cancel")
            told["cancel_reaches_the_renderer_seconds"] = reach(farm, "cancel", folder)
            farm.service.process.kill()
            until(lambda: farm.service.process.poll() is None)
            told["service_back_after_seconds"] = round(farm.until_served(), 1)
    print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
