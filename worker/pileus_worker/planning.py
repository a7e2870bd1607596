"""Plans a frame: which buckets the volume touches, what they cost, how to cut them into tasks."""

import math
import time
from dataclasses import dataclass

import pileus_core as core

from pileus_service.jobs import Bucket, Part

SMALLEST = 32
LARGEST = 512
ADAPTIVE_EDGE = 64
MAX_TASKS = 50_000
PILOT_CELLS = 8
PILOT_EDGE = 16


@dataclass(frozen=True)
class Cost:
    """Measured seconds a pixel sample, over a coarse grid of the image."""

    cell: int
    columns: int
    seconds: list[float]

    def at(self, x: int, y: int) -> float:
        return self.seconds[(y // self.cell) * self.columns + x // self.cell]


def tiles(width: int, height: int, edge: int) -> list[Bucket]:
    """The image cut into squares; what is left over at the far edges is smaller."""
    return [
        (x, y, min(x + edge, width), min(y + edge, height))
        for y in range(0, height, edge)
        for x in range(0, width, edge)
    ]


def measure(
    scene: core.Scene,
    transport: core.Transport,
    size: tuple[int, int],
    *,
    seed: int,
    frame: int,
    threads: int,
    control: core.Control,
) -> Cost:
    """Times one sample of a few pixels amid each cell of a coarse grid: a small part of the
    frame's work, and near enough to cut it into tasks of like length."""
    width, height = size
    cell = math.ceil(max(width, height) / PILOT_CELLS)
    seconds = []
    for x0, y0, x1, y1 in tiles(width, height, cell):
        x, y = max(x0, (x0 + x1 - PILOT_EDGE) // 2), max(y0, (y0 + y1 - PILOT_EDGE) // 2)
        probe = (x, y, min(x + PILOT_EDGE, x1), min(y + PILOT_EDGE, y1))
        begun = time.perf_counter()
        core.render(
            scene,
            transport,
            bucket=probe,
            samples=(0, 1),
            seed=seed,
            frame=frame,
            threads=threads,
            control=control,
        )
        spent = time.perf_counter() - begun
        seconds.append(spent / ((probe[2] - probe[0]) * (probe[3] - probe[1])))
    return Cost(cell, math.ceil(width / cell), seconds)


def cut(
    scene: core.Scene, cost: Cost, size: tuple[int, int], samples: int, seconds: float
) -> tuple[list[Part], list[Bucket]]:
    """Parts of about so many seconds each, and the buckets that no ray of meets the volume."""
    edge = LARGEST
    while True:
        costs = {bucket: _seconds(bucket, cost) * samples for bucket in tiles(*size, edge)}
        # Large buckets and many ranges, but none of so few samples that its image is mostly noise.
        if edge == SMALLEST or max(costs.values()) / seconds <= max(1, samples // 4):
            break
        edge //= 2
    touched = [bucket for bucket in costs if scene.touches(bucket)]
    task = max(seconds, sum(costs[bucket] for bucket in touched) / MAX_TASKS)
    parts = []
    for bucket in touched:
        count = min(samples, max(1, round(costs[bucket] / task)))
        bounds = [samples * i // count for i in range(count + 1)]
        parts += [Part(bucket=bucket, samples=(bounds[i], bounds[i + 1])) for i in range(count)]
    touched_set = set(touched)
    return parts, [bucket for bucket in costs if bucket not in touched_set]


def even(scene: core.Scene, size: tuple[int, int], samples: int) -> tuple[list[Part], list[Bucket]]:
    """Small buckets, each one part, for samples that end when a bucket's own error is met; and the
    buckets that no ray of meets the volume. No timing has a say: the samples depend on them."""
    buckets = tiles(*size, ADAPTIVE_EDGE)
    touched = [bucket for bucket in buckets if scene.touches(bucket)]
    empty = [bucket for bucket in buckets if not scene.touches(bucket)]
    return [Part(bucket=bucket, samples=(0, samples)) for bucket in touched], empty


def _seconds(bucket: Bucket, cost: Cost) -> float:
    """Seconds for one sample of every pixel of the bucket, from the cells it lies in."""
    x0, y0, x1, y1 = bucket
    xs = {*range(x0, x1, cost.cell), x1 - 1}
    ys = {*range(y0, y1, cost.cell), y1 - 1}
    samples = [cost.at(x, y) for x in xs for y in ys]
    return sum(samples) / len(samples) * (x1 - x0) * (y1 - y0)
