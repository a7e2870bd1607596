"""The chaos driver: small real renders by the hundred thousand, while SIGKILL falls at random.

    PYTHONPATH=tests .venv/bin/python -m chaos.run --tasks 100000 --workers 10

Render children, workers, the service and Redis are killed with SIGKILL at exponential intervals.
In the end every job is done, each frame equals a serial render bit for bit, and neither Redis nor
the disk holds anything that should have gone.
"""

import argparse
import contextlib
import json
import math
import os
import random
import shutil
import signal
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pileus_core as core

from chaos.farm import Farm
from pileus_service.errors import FarmError
from pileus_service.shot import Shot
from serial_render import plan_of, same_bits

# How often each is hit, in proportion.
TARGETS = {"child": 6, "worker": 4, "service": 1, "redis": 1}


class Killer(threading.Thread):
    """Kills parts of a farm at random until told to stop."""

    def __init__(self, farm: Farm, every: float, seed: int) -> None:
        super().__init__(daemon=True)
        self._farm = farm
        self._every = every
        self._dice = random.Random(seed)
        self.over = threading.Event()
        self.kills: Counter[str] = Counter()

    def run(self) -> None:
        while not self.over.wait(self._dice.expovariate(1 / self._every)):
            [target] = self._dice.choices(list(TARGETS), list(TARGETS.values()))
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._victim(target), signal.SIGKILL)
                self.kills[target] += 1

    def _victim(self, target: str) -> int:
        if target == "redis":
            return self._farm.redis.pid
        if target == "service":
            return self._farm.service.pid
        worker = self._dice.choice(self._farm.workers)
        if target == "child":
            return self._dice.choice(worker.children or [worker.pid])
        return worker.pid


def small_shot(folder: Path, frames: int, name: str, samples: int) -> Shot:
    """Frames of hundreds of tasks, each of which takes milliseconds."""
    cache = folder / "cloud.vdb"
    if not cache.exists():
        core.make_cloud(str(cache), frame=1, frames=1, resolution=32)
    return Shot.model_validate(
        {
            "name": name,
            "frames": f"1-{frames}",
            "image": {"width": 64, "height": 64, "output": str(folder / name / "####.exr")},
            "volumes": [{"cache": str(cache), "extinction": 20.0, "anisotropy": 0.5}],
            "camera": {"position": [0.15, 0.12, 1.9], "look_at": [0.0, 0.02, 0.0], "fov": 35.0},
            "lights": [{"type": "dome", "radiance": [0.3, 0.35, 0.4]}],
            "transport": {"method": "single"},
            "sampling": {"samples": samples, "seed": random.Random(name).randrange(1 << 32)},
        }
    )


def finish(farm: Farm, job: str, seconds: float) -> list[str]:
    """Sees a job through; returns why each of its frames failed that had to be retried."""
    retried: list[str] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            view = farm.client.job(job)
            if view.state == "failed":
                why = [f"{job} {each.reason}" for each in farm.client.frames(job) if each.reason]
                farm.client.control(job, "retry")
                retried += why
            elif view.state == "done":
                return retried
        except FarmError:
            pass  # the service or Redis has just been killed
        time.sleep(0.3)
    raise AssertionError(f"{job} has not ended after {seconds:.0f} s: {farm.client.job(job)}")


def check_frame(told: tuple[str, str, str, int]) -> None:
    shot, data, job, frame = told
    with tempfile.TemporaryDirectory() as scratch:
        same_bits(Shot.model_validate_json(shot), Path(data), job, frame, Path(scratch))


def chaos(
    folder: Path,
    *,
    tasks: int,
    workers: int,
    frames: int,
    kill_every: float,
    seed: int,
    most_seconds: float = math.inf,
) -> dict[str, object]:
    """Renders at least so many tasks under fire, or for so long, checks all that is left; returns
    the figures."""
    jobs: list[tuple[str, Shot]] = []
    retried: list[str] = []
    done = 0
    begun = time.monotonic()
    with Farm(folder, [folder], workers, task_seconds=0.001) as farm:
        farm.until_workers(workers)
        killer = Killer(farm, kill_every, seed)
        killer.start()
        while done < tasks and time.monotonic() - begun < most_seconds:
            # Four buckets a frame, and a task a sample of each.
            samples = min(256, max(8, tasks // frames // 4))
            shot = small_shot(folder, frames, f"shot{len(jobs)}", samples)
            key = f"{folder.name}-{len(jobs)}"
            while True:
                try:
                    job = farm.client.submit(shot, key=key).job.id
                    break
                except FarmError:
                    time.sleep(0.1)
            retried += finish(farm, job, 3600)
            jobs.append((job, shot))
            done += sum(len(plan_of(farm.data, job, n).parts) + 2 for n in shot.frame_numbers)
        killer.over.set()
        killer.join()
        spent = time.monotonic() - begun
        farm.until_served()
        # A worker that lost its task has to learn so, and a child that was late to sweep.
        time.sleep(12)
        left, stats = farm.leftovers(), farm.queue.stats()
        data = str(farm.data)
    left += map(str, folder.glob("shot*/.*"))
    work = [(s.model_dump_json(), data, job, n) for job, s in jobs for n in s.frame_numbers]
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        list(pool.map(check_frame, work, chunksize=4))
    return {
        "tasks": done,
        "seconds": round(spent, 1),
        "frames_equal_to_a_serial_render": len(work),
        "kills": dict(killer.kills),
        "leases_lost": stats.get("leases_lost", 0),
        "attempts_failed": stats.get("attempts_failed", 0),
        "frames_retried": len(retried),
        "why": retried,
        "left_over": left,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--tasks", type=int, default=100_000)
    parser.add_argument("--workers", type=int, default=10)
    parser.add_argument("--frames", type=int, default=40, help="of each job")
    parser.add_argument("--kill-every", type=float, default=1.0, help="seconds, on average")
    parser.add_argument("--most-seconds", type=float, default=math.inf, help="begins no job after")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where; kept. Memory is a good place: /dev/shm")
    asked = parser.parse_args()
    folder = asked.folder or Path(tempfile.mkdtemp(prefix="chaos-"))
    folder.mkdir(parents=True, exist_ok=True)
    figures = chaos(
        folder,
        tasks=asked.tasks,
        workers=asked.workers,
        frames=asked.frames,
        kill_every=asked.kill_every,
        seed=asked.seed,
        most_seconds=asked.most_seconds,
    )
    print(json.dumps(figures, indent=1))
    assert not figures["left_over"]
    if asked.folder is None:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
