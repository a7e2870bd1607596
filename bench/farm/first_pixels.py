"""How soon the first pixels of a job of a million tasks begin, and what it holds in Redis.

    PYTHONPATH=tests .venv/bin/python -m farm.first_pixels

A real farm that has been at work before, as a farm has. Each of the 100 frames is planned into
some 10,000 tasks of a millisecond or two; the clock runs from the request until the first of them
is done, which is as good as begun.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from chaos.farm import Farm, until
from farm.service_load import make_shot
from pileus_service.shot import Shot

SAMPLES = 16


def large(folder: Path, name: str) -> Shot:
    shot = make_shot(folder, name, SAMPLES, "1-100")
    image = shot.image.model_copy(update={"width": 1920, "height": 1080})
    return shot.model_copy(update={"image": image})


def memory(farm: Farm) -> float:
    """MB that Redis holds."""
    told: dict[str, Any] = farm.queue.redis.info("memory")
    return float(told["used_memory"]) / 1e6


def first_pixels(farm: Farm, shot: Shot) -> dict[str, float]:
    """Of a job that is cancelled when it has been at work for a while."""
    before, begun = memory(farm), time.monotonic()
    job = farm.client.submit(shot).job.id
    until(lambda: farm.client.job(job).samples > 0)
    took = time.monotonic() - begun
    tasks = max(frame.tasks for frame in farm.client.job(job).active)
    time.sleep(2)
    held = memory(farm) - before
    farm.client.control(job, "cancel")
    until(lambda: not any(worker.task for worker in farm.queue.workers()))
    return {"seconds": round(took, 2), "tasks_of_a_frame": tasks, "mb_of_redis": round(held, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=5)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(dir="/dev/shm") as name:
        folder = Path(name)
        with Farm(folder, [folder], 2, task_seconds=0.001) as farm:
            warm = farm.client.submit(make_shot(folder, "warm", 1, "1")).job.id
            until(lambda: farm.client.job(warm).state == "done")
            for number in range(asked.repeat):
                print(json.dumps(first_pixels(farm, large(folder, f"long{number}"))), flush=True)


if __name__ == "__main__":
    main()
