"""How long a killed worker's task waits until another has it, over many kills.

    PYTHONPATH=tests .venv/bin/python -m farm.takeover --kills 100

A real farm whose workers are all busy with short tasks; a quarter of them are killed at a time,
with SIGKILL, at random moments. A task waits for its lease to run out and then for a worker to be
free, so how long the tasks took is told, too.
"""

import argparse
import json
import os
import random
import signal
import statistics
import tempfile
import time
from pathlib import Path

from chaos.farm import Farm, until
from farm.service_load import make_shot


def holders(farm: Farm) -> dict[str, str]:
    """Who holds each entry in flight."""
    pending = farm.queue.redis.xpending_range("pileus:tasks:5", "workers", "-", "+", 1000)
    return {str(held["message_id"]): str(held["consumer"]) for held in pending}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--workers", type=int, default=8)
    asked = parser.parse_args()
    dice, waits = random.Random(1), list[float]()
    with tempfile.TemporaryDirectory(dir="/dev/shm") as name:
        folder = Path(name)
        with Farm(folder, [folder], asked.workers, task_seconds=0.3) as farm:
            job = farm.client.submit(make_shot(folder, "long", 1 << 13, "1-100")).job.id
            farm.until_workers(asked.workers)
            while len(waits) < asked.kills:
                time.sleep(dice.uniform(2, 5))
                until(lambda: len(holders(farm)) >= asked.workers)
                victims = {part.pid for part in dice.sample(farm.workers, asked.workers // 4)}
                names = {w.name for w in farm.queue.workers() if w.pid in victims and w.alive}
                for pid in victims:
                    os.kill(pid, signal.SIGKILL)
                begun = time.monotonic()
                orphans = {entry for entry, owner in holders(farm).items() if owner in names}
                while orphans:
                    held = holders(farm)
                    taken = {e for e in orphans if held.get(e) not in {*names, "released"}}
                    waits += [time.monotonic() - begun] * len(taken)
                    orphans -= taken
                    time.sleep(0.02)
            farm.client.control(job, "cancel")
        told = map(json.loads, (folder / "workers.log").read_text().splitlines())
        tasks = [line["seconds"] for line in told if line["event"] == "done"]
    cuts = statistics.quantiles(waits, n=100, method="inclusive")  # none beyond the greatest
    figures = {"kills": len(waits), "p50": cuts[49], "p99": cuts[98], "most": max(waits)}
    figures["median_task"] = statistics.median(tasks)
    print(json.dumps({key: round(value, 2) for key, value in figures.items()}))


if __name__ == "__main__":
    main()
